"""Subspace identification against known systems, GNU Octave, SLICOT and nfoursid."""

import os
import subprocess
import sys
import textwrap
from functools import lru_cache

import ctrlsys
import numpy as np
import pandas as pd
import pytest
from nfoursid.nfoursid import NFourSID

import mampc
from identification_records import load_record
from mampc import IOData, MampcError, StateSpace, n4sid, prbs, validate
from mampc.identification.realisation import realise
from mampc.identification.subspace import hankel_factor, observability
from random_systems import markov, noise_free, noisy_record, random_system, system_with
from seeds import deep, examples, seeds

WEIGHTINGS = ("cva", "n4sid", "moesp")
ONE_QUICK = ("cva", *deep(*WEIGHTINGS[1:]))
SIZES = [(2, 1, 1), (4, 2, 2), (5, 2, 3)]  # states, inputs, outputs


def assert_same_dynamics(model, system):
    np.testing.assert_allclose(markov(model), markov(system), atol=1e-6 * np.max(np.abs(markov(system))))


def assert_same_record(fitted, data):
    simulated = fitted.model.response(data.u, fitted.x0)
    np.testing.assert_allclose(simulated, data.y, atol=1e-6 * np.max(np.abs(data.y)))
    np.testing.assert_allclose(fitted.fit, 100, atol=1e-4)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("feedthrough", [True, *deep(False)])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("seed", seeds(3, quick=1))
def test_a_noise_free_record_gives_back_system_order_and_transient(seed, size, feedthrough, weighting):
    system = random_system(seed, *size, feedthrough)
    data = noise_free(system, seed)
    fitted = n4sid(data, weighting=weighting)
    assert fitted.order == system.n_states
    assert not fitted.stabilised
    assert_same_dynamics(fitted.model, system)
    assert_same_record(fitted, data)
    without_transient = fitted.model.response(data.u)
    assert np.max(np.abs(without_transient - data.y)) > 0.1


@pytest.mark.parametrize("feedthrough", [True, *deep(False)])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("seed", seeds(3, quick=1))
def test_a_transient_that_shifts_the_means_disturbs_neither_order_nor_dynamics(seed, size, feedthrough):
    system = random_system(seed, *size, feedthrough)
    fitted = n4sid(noise_free(system, seed, at_rest_on_average=False))
    assert fitted.order == system.n_states
    assert_same_dynamics(fitted.model, system)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_without_feedthrough_D_is_zero(weighting):
    system = random_system(0, 4, 2, 2, False)
    data = noise_free(system, 0)
    fitted = n4sid(data, weighting=weighting, feedthrough=False)
    assert np.array_equal(fitted.model.D, np.zeros((2, 2)))
    assert_same_dynamics(fitted.model, system)
    assert_same_record(fitted, data)


def test_the_result_describes_the_record():
    system = random_system(1, 4, 2, 2, True)
    data = noisy_record(system, 1)[0]
    fitted = n4sid(data, block_rows=8)
    assert (fitted.model.dt, fitted.model.names.inputs) == (data.dt, data.names.inputs)
    assert fitted.singular_values.shape == (16,)
    assert (np.diff(fitted.singular_values) <= 0).all()
    assert (fitted.singular_values <= 1 + 1e-9).all()
    assert fitted.model.n_states == len(fitted.x0) == fitted.order
    np.testing.assert_array_equal(fitted.fit, fitted.validate(data).fit)


@pytest.mark.parametrize("weighting", ONE_QUICK)
@pytest.mark.parametrize("seed", seeds(4, quick=1))
def test_units_decide_nothing(seed, weighting):
    """Every signal in a unit of its own: the same order, poles, fits, hold-out fits and initial state."""
    rng = np.random.default_rng(seed)
    system = random_system(seed, 4, 2, 2, True)
    data, unseen = noisy_record(system, seed)
    u_unit, y_unit = 10.0 ** rng.uniform(-8, 8, (2, 2))
    if seed == 0:
        u_unit, y_unit = np.array([1e-8, 1e8]), np.array([1e8, 1e-8])
    fitted = n4sid(data, weighting=weighting)
    other = n4sid(IOData(data.u * u_unit, data.y * y_unit, data.dt), weighting=weighting)
    assert (other.order, other.integrators, other.stabilised) == (
        fitted.order, fitted.integrators, fitted.stabilised
    )  # fmt: skip
    np.testing.assert_allclose(
        np.sort_complex(other.model.poles()), np.sort_complex(fitted.model.poles()), atol=1e-6
    )
    np.testing.assert_allclose(other.fit, fitted.fit, atol=1e-6)
    np.testing.assert_allclose(
        other.validate(IOData(unseen.u * u_unit, unseen.y * y_unit, data.dt)).fit,
        fitted.validate(unseen).fit, atol=1e-5,
    )  # fmt: skip
    in_own_units = markov(other.model) * u_unit / y_unit[:, None]
    np.testing.assert_allclose(in_own_units, markov(fitted.model), atol=1e-6)


def test_units_of_the_outputs_do_not_matter_to_canonical_correlations():
    data = noisy_record(random_system(1, 4, 2, 2, True), 1)[0]
    scale = np.array([1e-2, 1e2])
    fitted, other = n4sid(data, order=4), n4sid(IOData(data.u, data.y * scale, data.dt), order=4)
    np.testing.assert_allclose(other.singular_values[:4], fitted.singular_values[:4], rtol=1e-9)


@pytest.mark.parametrize("name", ["hair_dryer", "glass_furnace"])
def test_singular_values_and_poles_are_those_of_octave(name):
    """In the units of the record, which decide in SLICOT's method and are scaled away by `n4sid`."""
    record = load_record(name)
    u, y = (signal - signal.mean(axis=0) for signal in (record.estimation.u, record.estimation.y))
    R = hankel_factor([u], [y], record.block_rows, -1)
    gamma, values = observability(R, u.shape[1], y.shape[1], record.block_rows, "n4sid")
    A, _ = realise(gamma[:, : record.order], y.shape[1])
    np.testing.assert_allclose(values, record.singular_values, rtol=1e-6)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(A)), np.sort_complex(record.poles), rtol=1e-6
    )


def test_one_output_has_the_singular_values_and_poles_of_octave_in_all_units():
    record = load_record("hair_dryer")
    fitted = n4sid(
        record.estimation, order=record.order, weighting="n4sid", block_rows=record.block_rows, unstable="refuse"
    )  # fmt: skip
    np.testing.assert_allclose(fitted.singular_values, record.singular_values, rtol=1e-6)
    poles = np.sort_complex(fitted.model.poles())
    np.testing.assert_allclose(poles, np.sort_complex(record.poles), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "margin"), [("hair_dryer", [2]), ("glass_furnace", [2, 2, 2, 15, 15, 15])], ids=lambda v: str(v)
)
@pytest.mark.parametrize(
    ("weighting", "own_block_rows"), [("n4sid", False), ("cva", False), ("n4sid", True), ("cva", True)]
)
def test_unseen_plant_data_is_explained_as_well_as_by_octave(name, margin, weighting, own_block_rows):
    record = load_record(name)
    block_rows = None if own_block_rows else record.block_rows
    fitted = n4sid(record.estimation, order=record.order, weighting=weighting, block_rows=block_rows)
    fit = validate(fitted.model, record.validation).fit
    print(f"\n{name}, {weighting}: {fit.round(1)}, Octave {record.fit.round(1)}")
    assert (fit >= record.fit - margin).all()


def by_slicot(data, order, block_rows):
    """A and C of SLICOT's N4SID, B and D by its least squares on the simulation error."""
    (m, l), F = (data.u.shape[1], data.y.shape[1]), np.asfortranarray
    u, y = data.u - data.u.mean(axis=0), data.y - data.y.mean(axis=0)
    _, R, _, _, info = ctrlsys.ib01ad(
        "N", "C", "N", "O", "N", "N", block_rows, m, l, F(u), F(y), 0.0, -1.0
    )  # fmt: skip
    assert info == 0
    A, C, *_, info = ctrlsys.ib01bd("N", "C", "N", block_rows, order, m, l, len(u), R, 0.0)
    assert info == 0
    B, D = np.zeros((order, m), order="F"), np.zeros((l, m), order="F")
    _, B, D, *_, info = ctrlsys.ib01cd("X", "C", "D", order, m, l, F(A), B, F(C), D, F(u), F(y), 0.0)
    assert info == 0
    return StateSpace(A, B, C, D, data.dt, data.u.mean(axis=0), data.y.mean(axis=0))


def by_nfoursid(data, order, block_rows):
    inputs, outputs = list(data.names.inputs), list(data.names.outputs)
    u, y = data.u - data.u.mean(axis=0), data.y - data.y.mean(axis=0)
    frame = pd.DataFrame(np.hstack([u, y]), columns=inputs + outputs)
    program = NFourSID(frame, outputs, inputs, num_block_rows=block_rows)
    program.subspace_identification()
    model, _ = program.system_identification(rank=order)
    return StateSpace(model.a, model.b, model.c, model.d, data.dt, data.u.mean(axis=0), data.y.mean(axis=0))


SIMULATED = {
    "overdamped": (0.95, 0.85, 0.6, 0.3),
    "one resonance": (0.93 * np.exp(0.4j), 0.8, 0.5),
    "two resonances": (0.95 * np.exp(0.25j), 0.8 * np.exp(1.2j)),
}
METHODS = {
    "default": lambda data: n4sid(data).model,
    "order 4": lambda data: n4sid(data, order=4).model,
    "SLICOT": lambda data: by_slicot(data, 4, 15),
    "nfoursid": lambda data: by_nfoursid(data, 4, 15),
}


@lru_cache
def median_fits(name):
    """Per method, the median over some records of the hold-out fit."""
    system = system_with(SIMULATED[name], seed=100)
    records = [noisy_record(system, seed) for seed in range(examples(6, quick=3))]
    medians = {
        method: float(np.median([validate(identify(data), unseen).fit.mean() for data, unseen in records]))
        for method, identify in METHODS.items()
    }
    print(f"\n{name}:", ", ".join(f"{method} {median:.2f}" for method, median in medians.items()))
    return medians


@pytest.mark.parametrize("method", ["default", "order 4"])
@pytest.mark.parametrize("name", ["overdamped", "two resonances", *deep("one resonance")])
def test_unseen_data_is_explained_better_than_by_other_programs(name, method):
    medians = median_fits(name)
    assert medians[method] >= max(medians["SLICOT"], medians["nfoursid"])


@pytest.mark.parametrize("weighting", ONE_QUICK)
def test_a_record_taken_in_small_parts_gives_the_same_model(monkeypatch, weighting):
    data = noisy_record(random_system(1, 4, 2, 2, True), 1)[0][:700]
    whole = n4sid(data, weighting=weighting)
    monkeypatch.setattr("mampc.identification.subspace._CHUNK", 97)
    monkeypatch.setattr("mampc.identification.simulation_error._ENTRIES", 5000)
    parts = n4sid(data, weighting=weighting)
    np.testing.assert_allclose(parts.singular_values, whole.singular_values, rtol=1e-8)
    np.testing.assert_allclose(markov(parts.model), markov(whole.model), atol=1e-8)


def test_the_initial_state_of_a_long_record_is_fitted_to_all_of_it():
    slow = StateSpace(np.diag([0.9999, 0.5]), [[0.1], [1.0]], [[1.0, 1.0]], None, 1.0)
    rng = np.random.default_rng(0)
    u = rng.standard_normal((5000, 1))
    y = slow.response(u, [2.0, -1.0]) + rng.standard_normal((5000, 1))
    free = np.stack([slow.response(np.zeros((5000, 1)), x0)[:, 0] for x0 in np.eye(2)], axis=1)
    expected = np.linalg.lstsq(free, (y - slow.response(u))[:, 0])[0]
    np.testing.assert_allclose(validate(slow, IOData(u, y, 1.0)).x0, expected, rtol=1e-8)


MEMORY_PROBE = """
    import re
    from pathlib import Path
    import numpy as np
    from scipy.signal import lfilter
    import mampc

    def peak():
        # Not getrusage: its peak is inherited from the process that started this one.
        return int(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1]) / 1024

    def identify(samples):
        model = mampc.StateSpace(np.diag([0.9, 0.7, 0.5, 0.3]), B, C, None, 1.0)
        u = mampc.prbs(order=14, hold=3, inputs=2, samples=samples)
        noise = lfilter([1.0], [1.0, -0.9], rng.standard_normal((samples, 2)), axis=0)
        mampc.n4sid(mampc.IOData(u, model.response(u) + 0.1 * noise, 1.0)).uncertainty(50)
        return peak()

    rng = np.random.default_rng(0)
    B, C = rng.standard_normal((4, 2)), rng.standard_normal((2, 4))
    identify(1000)
    print(peak(), identify(12_500), identify(50_000))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of resident memory is read from /proc")
def test_memory_stays_small_and_grows_at_most_linearly_with_the_record():
    command = [sys.executable, "-c", textwrap.dedent(MEMORY_PROBE)]
    one_thread = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=one_thread)
    before, quarter, whole = map(float, done.stdout.split())
    print(f"\npeak {before:.0f}, {quarter:.0f}, {whole:.0f} MB")
    assert whole < 300
    assert whole - before <= 4 * max(quarter - before, 1)


def growing_record():
    """A slow unstable mode beside a stable one, recorded before it has grown far."""
    system = StateSpace(np.diag([1.004, 0.6]), [[1.0], [1.0]], [[0.2, 1.0]], None, 1.0)
    return mampc.excite(system, prbs(order=9), noise=0.05, seed=3)


def test_an_unstable_model_is_refused_on_request():
    with pytest.raises(MampcError, match=r"expected a stable model, received poles of size \[1\.00"):
        n4sid(growing_record(), order=2, unstable="refuse")


def test_stabilising_mirrors_poles_and_says_so():
    fitted = n4sid(growing_record(), order=2)
    assert fitted.stabilised
    assert fitted.model.is_stable()
    np.testing.assert_allclose(np.abs(fitted.model.poles()).max(), 1 / 1.004, atol=0.002)
    assert np.isfinite(fitted.fit).all()


@pytest.mark.parametrize(
    ("samples", "options", "message"),
    [
        (8, {}, "expected at least 11 samples .* received 8"),
        (40, {"order": 12}, "expected at least 77 samples .* order 12, received 40"),
        (300, {"order": 200}, "expected at least .* received 300"),
        (300, {"order": 0}, "order: expected a whole number of at least 1, received 0"),
        (300, {"order": 2.0}, r"order: expected a whole number .* received 2\.0"),
        (
            300,
            {"order": 12, "block_rows": 5},
            "block_rows: expected a whole number of at least 13, received 5",
        ),
        (300, {"block_rows": 1}, "block_rows: expected a whole number of at least 2, received 1"),
        (300, {"block_rows": 51}, "block_rows: expected at most 50 for 300 samples, received 51"),
        (300, {"weighting": "best"}, "weighting: expected one of .* received 'best'"),
        (
            300,
            {"unstable": "ignore"},
            "unstable: expected one of auto, stabilise, refuse, received 'ignore'",
        ),
    ],
)
def test_impossible_requests_are_refused(samples, options, message):
    rng = np.random.default_rng(0)
    data = IOData(rng.standard_normal(samples), rng.standard_normal(samples), 1.0)
    with pytest.raises(MampcError, match=message):
        n4sid(data, **options)


@lru_cache
def tank_record(seed):
    u = prbs(order=8, amplitude=25, hold=5, mean=[50, 50], seed=seed)
    return mampc.excite(mampc.plants.QuadrupleTank(), u, dt=10, noise=0.1, seed=1)


@pytest.mark.parametrize("weighting", ONE_QUICK)
@pytest.mark.parametrize("seed", seeds(3, quick=1))
def test_the_order_of_the_tank_is_four(seed, weighting):
    fitted = n4sid(tank_record(seed), weighting=weighting)
    assert fitted.order == 4
    assert (fitted.fit > 85).all()


def test_noise_is_told_from_what_a_linear_model_lacks_of_a_nonlinear_plant():
    """The tank's own curvature is smooth; what is left of the measurements' noise is not."""
    plant = mampc.plants.QuadrupleTank()
    u = mampc.prbs(order=8, amplitude=25.0, hold=5, mean=plant.u_op)
    record = mampc.excite(plant, u, dt=10.0, noise=0.1, seed=1)
    found = mampc.n4sid(record, order=4, feedthrough=False).model.noise.output
    np.testing.assert_allclose(found, 0.1, rtol=0.2)


@pytest.mark.parametrize("order", [3, 4, 6])
def test_a_model_has_the_order_asked_for_though_the_disturbance_has_a_colour(order):
    u = mampc.prbs(order=8, amplitude=25.0, hold=5, mean=[50.0, 50.0])
    data = mampc.excite(mampc.plants.QuadrupleTank(), u, dt=10.0, noise=0.1, seed=1)
    assert mampc.n4sid(data, order=order, feedthrough=False).model.n_states == order


def test_a_plant_that_is_not_linear_gets_states_enough():
    """Residuals of a real furnace are correlated: a criterion that counts them loses a fifth of the fit."""
    record = load_record("glass_furnace")
    fitted = n4sid(record.estimation, feedthrough=False)
    assert fitted.detrend == "constant"
    assert fitted.validate(record.validation).fit[:3].min() > 50
