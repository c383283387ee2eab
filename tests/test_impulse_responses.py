"""The rival with impulse responses: found as a Gaussian process would, and taken where few states do not do."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from mampc import IOData, MampcError, StateSpace, n4sid, prbs
from mampc.identification.choices import Choice, estimated
from mampc.identification.estimate import Settings
from mampc.identification.fir import impulse_responses
from mampc.identification.parts import assembled
from mampc.identification.scaling import scaled
from seeds import seeds


def recycling():
    """A first-order lag, a part of whose output comes back 41 samples later."""
    A = np.diag(np.ones(41), -1)
    A[0, 0], A[0, -1] = 0.8, 0.12
    return StateSpace(A, np.eye(42, 1) * 0.2, np.eye(1, 42), None, 1.0)


def spreading():
    """The mean of the inputs 5 to 30 samples ago."""
    return StateSpace(np.diag(np.ones(29), -1), np.eye(30, 1), [[*[0.0] * 5, *[0.04] * 25]], None, 1.0)


PLANTS = {"recycling": recycling(), "spreading": spreading()}


def record(name, seed, *, samples=1500, noise=0.3, units=(1.0, 1.0), hold=6):
    u = prbs(order=10, hold=hold, samples=samples, seed=seed)
    y = PLANTS[name].response(u)
    y = y + noise * y.std() * np.random.default_rng(seed).standard_normal(y.shape)
    return IOData((u + 2.0) * units[0], (y - 1.0) * units[1], 1.0)


@pytest.mark.parametrize("units", [(1e-6, 1e5), pytest.param((1.0, 1.0), marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", seeds(4, quick=1))
@pytest.mark.parametrize("name", PLANTS)
def test_dynamics_that_few_states_do_not_describe_are_found(name, seed, units):
    data = record(name, seed, units=units)
    fitted = n4sid(data, feedthrough=False)
    note = next(note for note in fitted.notes if "poles; they" in note)
    assert note.startswith("FIR poles; they predict held-out data ")
    assert "better than ARX ones" in note
    assert "better than subspace ones" in note
    true = PLANTS[name].step_response(61)[1:]
    units_of_gain = units[1] / units[0]

    def error(poles):
        records = scaled([data])
        choice = Choice("constant", np.zeros((1, 1), dtype=int), poles)
        parts = estimated(records, Settings(None, "cva", 15, False, "auto"), choice)
        found = assembled(parts, records, data).step_response(61)[1:] / units_of_gain
        return np.abs(found - true).max()

    own = np.abs(fitted.model.step_response(61)[1:] / units_of_gain - true).max()
    assert own < 0.1
    assert own < 0.8 * min(error("subspace"), error("ARX"))


def test_impulse_responses_are_those_of_a_gaussian_process():
    """Against the kernel in full, and its likelihood maximised without gradients."""
    rng = np.random.default_rng(0)
    N = 120
    u = rng.standard_normal((N, 1))
    y = StateSpace([[0.7]], [[0.5]], [[1.0]], None, 1.0).response(u) + 0.3 * rng.standard_normal((N, 1))
    records = scaled([IOData(u, y, 1.0)])
    found = impulse_responses(records, -1)[:, 0, 0]
    p = len(found)
    X = np.array([records.u[0][k - p : k, 0][::-1] for k in range(p, N)])
    target = records.y[0][p:, 0]
    lags = np.maximum.outer(np.arange(1, p + 1), np.arange(1, p + 1))

    def covariances(theta):
        noise, amplitude, time = np.exp(theta)
        kernel = amplitude * np.exp(-lags / time)
        return kernel, X @ kernel @ X.T + noise * np.eye(len(X))

    best = minimize(
        lambda theta: -multivariate_normal.logpdf(target, np.zeros(len(X)), covariances(theta)[1]),
        np.log([0.3, 0.1, 3.0]), method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-7, "maxiter": 2000},
    )  # fmt: skip
    kernel, covariance = covariances(best.x)
    np.testing.assert_allclose(found, kernel @ X.T @ np.linalg.solve(covariance, target), atol=1e-3)


def test_units_and_trends_decide_nothing():
    data = record("recycling", 1, samples=500)
    plain = impulse_responses(scaled([data]), 1)
    ramp = np.linspace(0, 7, 500)[:, None] * data.y.std()
    other = IOData(1e7 * data.u, 1e-4 * (data.y + ramp), 1.0)
    ratio = scaled([other]).y_spread / (1e-4 * scaled([data]).y_spread)
    np.testing.assert_allclose(impulse_responses(scaled([other]), 1) * ratio, plain, atol=1e-3)


def test_several_records_make_one_impulse_response():
    whole = record("spreading", 2)
    pieces = scaled([whole[:700], whole[700:710], whole[710:]])
    together, true = impulse_responses(pieces, 0), np.diff(PLANTS["spreading"].step_response(80), axis=0)
    units = pieces.y_spread / pieces.u_spread
    np.testing.assert_allclose(together[:79] * units, true, atol=0.03)


def test_records_too_short_for_impulse_responses_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(MampcError, match="expected records that hold impulse responses"):
        impulse_responses(scaled([IOData(rng.standard_normal(7), rng.standard_normal(7), 1.0)]), 0)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_inputs_that_excite_next_to_nothing_raise_nothing(unit):
    """A sine through an integrator without noise leaves nothing positive definite but for rounding."""
    u = (
        np.sin(0.01 * np.arange(600))[:, None] * [1.0, 0.5]
        + [0.0, 1.0] * np.sin(0.03 * np.arange(600))[:, None]
    )
    y = np.cumsum(u.sum(axis=1, keepdims=True), axis=0)
    responses = impulse_responses(scaled([IOData(unit * u, y / unit, 1.0)]), 0)
    assert np.isfinite(responses).all()
