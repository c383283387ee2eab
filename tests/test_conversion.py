"""`StateSpace.from_any` on transfer functions with many inputs and outputs, without slycot."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mampc
from mampc import StateSpace


def assert_same_response(model, numerators, denominators, dt=None, points=(0.03j, 0.4 + 0.1j, 7.0j)):
    for s in points:
        at = np.exp(s * dt) if dt else s
        expected = [
            [np.polyval(num, at) / np.polyval(den, at) for num, den in zip(*row, strict=True)]
            for row in zip(numerators, denominators, strict=True)
        ]
        found = model.C @ np.linalg.solve(at * np.eye(model.n_states) - model.A, model.B) + model.D
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())


def test_wood_and_berry_without_its_dead_times():
    num = [[[12.8], [-18.9]], [[6.6], [-19.4]]]
    den = [[[16.7, 1], [21.0, 1]], [[10.9, 1], [14.4, 1]]]
    G = control.tf(num, den)
    model = StateSpace.from_any(G, 1.0)
    np.testing.assert_allclose(model.dc_gain(), [[12.8, -18.9], [6.6, -19.4]], rtol=1e-10)
    assert model.n_states == 4
    assert_same_response(StateSpace.from_any(G), num, den)
    sampled = StateSpace.from_first_order(
        gain=[[12.8, -18.9], [6.6, -19.4]], time_constant=[[16.7, 21.0], [10.9, 14.4]], dt=1.0
    )
    np.testing.assert_allclose(model.step_response(50), sampled.step_response(50), atol=1e-10)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.booleans())
def test_any_proper_transfer_functions_are_realised(seed, shared):
    rng = np.random.default_rng(seed)
    l, m = rng.integers(1, 4, 2)
    common = np.poly(-rng.uniform(0.1, 3.0, 2))
    orders = rng.integers(0, 4, (l, m))
    den = [
        [np.atleast_1d(common if shared else np.poly(-rng.uniform(0.1, 3.0, n))) for n in row]
        for row in orders
    ]
    num = [[rng.normal(size=rng.integers(1, len(d) + 1)) for d in row] for row in den]
    model = StateSpace.from_any(control.tf(num, den, 0))
    assert_same_response(model, num, den)
    if shared:
        assert model.n_states <= 2 * min(l, m)


def test_one_integrator_in_all_channels_of_an_output_is_one_state():
    s = [1.0, 0.0]
    den = [[np.polymul(s, [2.0, 1.0]), np.polymul(s, [5.0, 1.0])]]
    num = [[[1.0], [3.0]]]
    model = StateSpace.from_any(control.tf(num, den), 0.5)
    assert np.sum(np.abs(model.poles() - 1) < 1e-9) == 1
    mampc.KalmanFilter.offset_free(model)  # could not tell two of them apart


@pytest.mark.parametrize("stretch", [1e-6, 1.0, 1e6])
def test_time_constants_far_apart_and_any_unit_of_time(stretch):
    den = [[np.polymul([1e4 * stretch, 1.0], [1e-2 * stretch, 1.0]), [3.0 * stretch, 1.0]]]
    num = [[[1e-6], [1e6]]]
    model = StateSpace.from_any(control.tf(num, den))
    assert model.n_states == 3
    assert_same_response(model, num, den, points=np.array([1e-5j, 0.1j, 300j]) / stretch)


def test_discrete_transfer_functions_keep_their_sample_time():
    num, den = [[[0.1], [0.2, 0.1]]], [[[1.0, -0.9], [1.0, -0.5]]]
    model = StateSpace.from_any(control.tf(num, den, 2.0))
    assert model.dt == 2.0
    assert_same_response(model, num, den, dt=2.0)


def test_an_improper_channel_is_refused():
    with pytest.raises(mampc.MampcError, match="improper"):
        StateSpace.from_any(control.tf([[[1.0, 0.0, 0.0], [1.0]]], [[[1.0, 1.0], [1.0, 1.0]]]))


def test_a_channel_that_is_zero_takes_no_state():
    model = StateSpace.from_any(control.tf([[[0.0], [1.0]], [[1.0], [0.0]]], [[[1.0], [2.0, 1.0]]] * 2))
    assert model.n_states == 1 + 0
    np.testing.assert_allclose(model.D, [[0.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize("dt", ["fast", [1.0, 2.0], float("nan")])
def test_a_sample_time_that_is_no_number_is_refused(dt):
    with pytest.raises(mampc.MampcError, match="dt: expected a finite number"):
        mampc.StateSpace.from_any(([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), dt=dt)
