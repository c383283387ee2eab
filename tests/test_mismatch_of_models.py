"""Plants that differ from their model by given shares."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mampc
from builders import random_model
from random_systems import system_with


def lag_with_delay(gain, time_constant, delay, dt=1.0):
    """A first-order lag behind whole samples of dead time."""
    pole, n = np.exp(-dt / time_constant), delay + 1
    A, B = np.eye(n, k=-1), np.zeros((n, 1))
    A[-1, -1], B[0, 0] = pole, 1.0
    if delay:
        A[-1, -2] = 1.0
    return mampc.StateSpace(A, B, gain * (1 - pole) * np.eye(1, n, n - 1), None, dt, [3.0], [2.0])


def response(model, samples=400):
    return model.step_response(samples)[:, 0, 0]


@given(st.integers(0, 10_000), st.integers(1, 5), st.booleans())
@settings(max_examples=30, deadline=None)
def test_without_shares_nothing_changes(seed, n, feedthrough):
    model = random_model(seed, n=n, feedthrough=feedthrough)
    same = mampc.Mismatch().drawn(model, seed)
    size = np.abs(model.step_response(60)).max()
    np.testing.assert_allclose(same.step_response(60), model.step_response(60), atol=1e-7 * size)
    np.testing.assert_array_equal(same.u_op, model.u_op)
    np.testing.assert_array_equal(same.y_op, model.y_op)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_gains_are_off_by_no_more_than_their_share(seed):
    model = random_model(1, radius=0.8)
    ratio = mampc.Mismatch(gain=0.2).drawn(model, seed).dc_gain() / model.dc_gain()
    assert (np.abs(ratio - 1) <= 0.2 + 1e-9).all()
    assert np.ptp(ratio) > 1e-3


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("delay", [0, 3])
def test_a_lag_off_by_a_share_is_a_lag_with_another_time_constant(seed, delay):
    model = lag_with_delay(2.0, 10.0, delay)
    off = mampc.Mismatch(lag=0.3).drawn(model, seed)
    pole = max(off.poles().real)
    time_constant = -1 / np.log(pole)
    assert 7.0 - 1e-6 <= time_constant <= 13.0 + 1e-6
    np.testing.assert_allclose(response(off), response(lag_with_delay(2.0, time_constant, delay)), atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_dead_time_off_by_a_share_shifts_the_response_by_parts_of_samples(seed):
    model = lag_with_delay(2.0, 10.0, 4)
    off = response(mampc.Mismatch(dead_time=0.5).drawn(model, seed))
    late = 1 + np.interp(0.5, off, np.arange(len(off))) - np.interp(0.5, response(model), np.arange(len(off)))
    assert -1.0 - 0.1 <= late <= 3.1
    began = int(np.argmax(off > 1e-9))
    # From its second sample on it is the lag's own response, shifted.
    shift = 10.0 * np.log((2 - off[began + 1]) / (2 - response(model)[began + 1]))
    exact = 2 * (1 - np.exp(-(np.arange(len(off)) - 4 - shift) / 10.0))
    np.testing.assert_allclose(off[began + 1 :], exact[began + 1 :], atol=1e-6)


def test_an_integrator_stays_one_and_poles_without_a_lag_stay_where_they_are():
    integrator = mampc.StateSpace([[1.0, 0.2], [0.0, 0.7]], [[0.0], [1.0]], [[1.0, 0.0]], None, 1.0)
    off = mampc.Mismatch(gain=0.1, lag=0.2, dead_time=0.2).drawn(integrator, 3)
    assert np.abs(off.poles() - 1).min() < 1e-6
    model = system_with([0.8, -0.5], 0, m=1, l=1, feedthrough=False)
    poles = mampc.Mismatch(lag=0.2).drawn(model, 0).poles()
    assert np.abs(poles + 0.5).min() < 1e-6
    assert np.abs(poles - 0.8).min() > 1e-3


def test_equal_seeds_give_equal_plants_that_serve_in_a_batch():
    model = random_model(3, radius=0.8)
    off = mampc.Mismatch(gain=0.15, lag=0.1, dead_time=0.2)
    plants = [off.drawn(model, seed) for seed in range(3)]
    np.testing.assert_array_equal(off.drawn(model, 2).A, plants[2].A)
    assert not np.allclose(plants[0].dc_gain(), plants[1].dc_gain())
    problem = mampc.TrackingProblem(model, prediction_horizon=15, control_horizon=3)
    runs = mampc.simulate_batch(
        plants, mampc.Regulator(mampc.MPC(problem)), model.y_op + 1.0, steps=150, seeds=range(3)
    )
    np.testing.assert_allclose(runs.y[:, -1], np.tile(model.y_op + 1.0, (3, 1)), atol=1e-3)


def test_units_of_the_signals_decide_nothing():
    model = random_model(2)
    scaled = mampc.StateSpace(model.A, 1e5 * model.B, 1e-3 * model.C, 1e2 * model.D, model.dt)
    off = mampc.Mismatch(gain=0.15, lag=0.1, dead_time=0.2)
    np.testing.assert_allclose(
        off.drawn(scaled, 1).step_response(50),
        1e2 * off.drawn(model, 1).step_response(50),
        rtol=1e-6,
        atol=1e-6,
    )


@pytest.mark.parametrize("shares", [{"gain": 1.0}, {"lag": -0.1}, {"dead_time": np.nan}, {"gain": "much"}])
def test_shares_out_of_range_are_refused(shares):
    with pytest.raises(mampc.MampcError, match=f"{next(iter(shares))}: expected"):
        mampc.Mismatch(**shares)


def test_a_continuous_model_is_refused():
    with pytest.raises(mampc.MampcError, match="expected a discrete model"):
        mampc.Mismatch().drawn(mampc.linearise(mampc.plants.QuadrupleTank()), 0)
