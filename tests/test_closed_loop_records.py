"""Unstable plants, recorded under feedback: their poles are kept; those of others are not moved outside."""

import numpy as np
import pytest
from scipy.signal import lfilter

import mampc
from mampc import IOData, n4sid, prbs
from mampc.identification.closed_loop import under_feedback
from mampc.identification.scaling import scaled
from mampc.systems.properties import properties
from seeds import deep, examples, seeds

PLANTS = {  # A, B, C and a feedback that stabilises them
    "one pole": ([[1.05]], [[0.5]], [[1.0]], [[0.4]]),
    "with a lag": ([[1.02, 0.2], [0.0, 0.7]], [[0.0], [0.3]], [[1.0, 0.0]], [[0.4]]),
    "two outputs": (
        [[1.03, 0.05], [0.0, 0.9]],
        [[0.3, 0.1], [0.0, 0.2]],
        np.eye(2),
        [[0.6, 0.0], [0.0, 0.5]],
    ),
    "stable": ([[0.95]], [[0.5]], [[1.0]], [[0.4]]),
    "integrating": ([[1.0, 0.2], [0.0, 0.7]], [[0.0], [0.3]], [[1.0, 0.0]], [[0.3]]),
}


def record_of(name, seed, *, noise=0.05, samples=2000, units=(1.0, 1.0)):
    """A PRBS added to what the feedback does, noise at the outputs and at the states."""
    rng = np.random.default_rng(seed)
    A, B, C, K = map(np.array, PLANTS[name])
    dither = prbs(order=9, hold=6, inputs=B.shape[1], samples=samples, seed=seed)
    x, u, y = np.zeros(len(A)), [], []
    for k in range(samples):
        y.append(C @ x + noise * rng.standard_normal(len(C)))
        u.append(dither[k] - K @ y[-1])
        x = A @ x + B @ u[-1] + 0.02 * rng.standard_normal(len(A))
    return IOData((np.array(u) + 5) * units[0], (np.array(y) + 3) * units[1], 1.0)


@pytest.mark.parametrize("units", [(1e-4, 1e5), *deep((1.0, 1.0))])
@pytest.mark.parametrize("noise", [0.2, *deep(0.02)])
@pytest.mark.parametrize("name", ["one pole", "with a lag", "two outputs"])
def test_unstable_poles_are_kept_where_the_record_shows_them(name, noise, units):
    A, B, C, _ = map(np.array, PLANTS[name])
    for seed in range(examples(2, quick=1)):
        fitted = n4sid(record_of(name, seed, noise=noise, units=units), feedthrough=False)
        assert not fitted.stabilised
        assert np.abs(fitted.model.poles()).max() == pytest.approx(np.max(np.diag(A)), abs=0.01)
        true = np.cumsum([C @ np.linalg.matrix_power(A, k) @ B for k in range(15)], axis=0)
        response = fitted.model.step_response(16)[1:] * units[0] / units[1]
        np.testing.assert_allclose(response, true, atol=0.15 * np.abs(true).max())
        assert "outside the unit circle" in fitted.notes[0]
        assert np.isfinite(fitted.fit).all()
        assert (fitted.fit > 30).all()


@pytest.mark.parametrize("name", ["stable", "integrating"])
def test_poles_of_other_plants_stay_inside(name):
    for seed in range(examples(3, quick=1)):
        fitted = n4sid(record_of(name, seed), feedthrough=False)
        assert np.abs(fitted.model.poles()).max() <= 1.0


def test_unstable_poles_are_mirrored_on_request():
    fitted = n4sid(record_of("one pole", 0), feedthrough=False, unstable="stabilise")
    assert np.abs(fitted.model.poles()).max() <= 1.0


@pytest.mark.parametrize("seed", range(5))
def test_a_record_without_feedback_is_known_as_such(seed):
    rng = np.random.default_rng(seed)
    model = mampc.StateSpace([[0.95]], [[0.1]], [[1.0]], None, 1.0)
    u = prbs(order=9, hold=6, samples=1500, seed=seed)
    y = model.response(u) + 0.1 * rng.standard_normal((1500, 1))
    assert not under_feedback(scaled([IOData(u, y, 1.0)]))
    assert under_feedback(scaled([record_of("with a lag", seed, noise=0.2)]))


@pytest.mark.parametrize("seed", seeds(4, quick=1))
def test_held_test_signals_are_not_taken_for_feedback(seed):
    """Outputs tell of inputs longer ago than their own last values, and so of when a held signal may move."""
    plant = mampc.StateSpace.from_first_order(
        gain=np.ones((3, 2)), time_constant=np.array([[4, 30], [10, 20], [40, 6]]), dead_time=0.0, dt=1.0
    )
    u = prbs(order=10, hold=10, inputs=2, samples=2000, seed=seed)
    noise = lfilter([0.1], [1.0, -0.9], np.random.default_rng(seed).standard_normal((2000, 3)), axis=0)
    assert not under_feedback(scaled([IOData(u, plant.response(u) + noise, 1.0)]))


def test_a_controller_on_the_model_of_an_unstable_plant_holds_it():
    model = n4sid(record_of("with a lag", 0), feedthrough=False).model
    A, B, C, _ = map(np.array, PLANTS["with a lag"])
    plant = mampc.StateSpace(A, B, C, None, 1.0, [5.0], [3.0])
    problem = mampc.TrackingProblem(model, prediction_horizon=30, control_horizon=5, move_weight=0.1)
    run = mampc.simulate(
        plant, mampc.Regulator(mampc.MPC(problem)), [4.0], steps=200, input_disturbance=[0.5], progress=False
    )
    np.testing.assert_allclose(run.y[-10:], 4.0, atol=0.01)


LOADS = {"slow": [1, -0.98], "quick": [1, -0.8], "swinging": [1, -1.9, 0.92]}
PI_GAIN, PI_TIME, LAG, LATE = 0.6, 5.0, 5.0, 2  # times in samples


def under_pi(load, seed, *, samples=2500, units=(1.0, 1.0)):
    """A first-order plant of gain 2 under a PI controller, with loads at its output and a small test at its input."""
    rng = np.random.default_rng(seed)
    size = {"slow": 0.1, "quick": 0.3, "swinging": 0.05}[load]
    loads = lfilter([1.0], LOADS[load], size * rng.standard_normal(samples))
    test = 0.5 * prbs(order=10, hold=8, samples=samples, seed=seed)[:, 0]
    pole, x, total = np.exp(-1 / LAG), 0.0, 0.0
    u, y = np.zeros(samples), np.zeros(samples)
    for k in range(samples):
        y[k] = x + loads[k] + 0.05 * rng.standard_normal()
        total -= PI_GAIN * y[k] / PI_TIME
        u[k] = total - PI_GAIN * y[k] + test[k]
        x = pole * x + 2 * (1 - pole) * (u[k - LATE] if k >= LATE else 0.0)
    return IOData((u + 50) * units[0], (y + 20) * units[1], 60.0)


@pytest.mark.parametrize("seed", seeds(6, quick=1))
@pytest.mark.parametrize("load", LOADS)
def test_gains_of_a_plant_under_control_are_its_own(load, seed):
    fitted = n4sid(under_pi(load, seed), feedthrough=False)
    gain = fitted.model.dc_gain()[0, 0]
    assert fitted.detrend == "whitened"
    assert "past outputs moved the inputs" in " ".join(fitted.notes)
    assert gain == pytest.approx(2.0, rel=0.15)
    assert properties(fitted.model).dead_time == LATE * fitted.model.dt
    response = fitted.model.step_response(30)[:, 0, 0]
    true = np.array([2 * (1 - np.exp(-max(k - LATE, 0) / LAG)) for k in range(30)])
    np.testing.assert_allclose(response, true, atol=0.3)


def test_units_decide_nothing_under_control():
    one, other = (
        n4sid(under_pi("slow", 3, units=units), feedthrough=False) for units in ((1, 1), (1e-7, 1e6))
    )
    assert one.detrend == other.detrend
    np.testing.assert_allclose(other.model.dc_gain() * 1e-13, one.model.dc_gain(), rtol=1e-6)
    np.testing.assert_allclose(
        np.sort_complex(other.model.poles()), np.sort_complex(one.model.poles()), atol=1e-6
    )
