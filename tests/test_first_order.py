"""`StateSpace.from_first_order`: exact under zero-order hold, few states, whatever the units."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

import mampc
from mampc import StateSpace

WOOD_BERRY = {
    "gain": [[12.8, -18.9], [6.6, -19.4]],
    "time_constant": [[16.7, 21.0], [10.9, 14.4]],
    "dead_time": [[1.0, 3.0], [7.0, 3.0]],
}


def closed_form(K, tau, theta, t):
    """The unit step response of one channel at times t."""
    late = t - theta
    with np.errstate(divide="ignore", over="ignore"):
        if np.isinf(tau):
            return np.where(late > 0, K * late, 0.0)
        if tau == 0:
            return np.where(late > -1e-9, K, 0.0)
        return np.where(late > 0, -K * np.expm1(-np.maximum(late, 0) / tau), 0.0)


def assert_closed_form(model, K, tau, theta, samples=60):
    K, tau, theta = np.broadcast_arrays(K, tau, theta)
    response = model.step_response(samples)
    t = model.dt * np.arange(samples)
    for i, j in np.ndindex(K.shape):
        expected = closed_form(K[i, j], tau[i, j], theta[i, j], t)
        np.testing.assert_allclose(
            response[:, i, j], expected, atol=1e-11 * np.abs(expected).max(initial=1e-300)
        )


def test_the_wood_berry_column():
    model = StateSpace.from_first_order(**WOOD_BERRY, dt=1.0)
    assert_closed_form(model, *WOOD_BERRY.values())
    np.testing.assert_allclose(model.dc_gain(), WOOD_BERRY["gain"], rtol=1e-12)


def test_a_lag_without_dead_time_is_what_scipy_samples():
    model = StateSpace.from_first_order(gain=[[3.0]], time_constant=20.0, dt=7.0)
    numerator, denominator, _ = scipy.signal.cont2discrete(([3.0], [20.0, 1.0]), 7.0)
    u = np.random.default_rng(0).normal(size=(40, 1))
    expected = scipy.signal.lfilter(numerator.ravel(), denominator, u[:, 0])
    np.testing.assert_allclose(model.response(u)[:, 0], expected, atol=1e-12)


def test_any_input_agrees_with_a_simulation_in_continuous_time():
    import control

    K, tau, theta, dt = 2.0, 9.0, 6.5, 2.0
    u = np.repeat(np.random.default_rng(1).normal(size=30), 20)
    t = np.arange(len(u)) * dt / 20
    late = np.concatenate([np.zeros(65), u])[: len(u)]  # held within steps of 0.1
    expected = control.forced_response(control.c2d(control.tf([K], [tau, 1]), 0.1, "zoh"), t, late).y[0]
    model = StateSpace.from_first_order(gain=[[K]], time_constant=tau, dead_time=theta, dt=dt)
    np.testing.assert_allclose(model.response(u[::20, None])[:, 0], expected.ravel()[::20], atol=1e-10)


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_every_channel_is_its_closed_form(data):
    l, m = data.draw(st.integers(1, 3)), data.draw(st.integers(1, 3))

    def matrix(values):
        row = st.lists(values, min_size=m, max_size=m)
        return np.array(data.draw(st.lists(row, min_size=l, max_size=l)))

    K = matrix(st.sampled_from([0.0, 1e-6, -2.5, 3e7]))
    tau = matrix(st.sampled_from([0.0, 3.0, 3.0, 40.0, np.inf]))
    theta = matrix(st.sampled_from([0.0, 0.3, 1.0, 2.5, 5.0, 11.7]))
    model = StateSpace.from_first_order(gain=K, time_constant=tau, dead_time=theta, dt=0.5)
    assert_closed_form(model, K, tau, theta, samples=40)


def test_as_few_states_as_the_channels_need():
    def states(**channels):
        return StateSpace.from_first_order(dt=1.0, **channels).n_states

    assert states(**WOOD_BERRY) == 4 + 7 + 3
    assert states(gain=np.ones((3, 1)), time_constant=5.0, dead_time=0.0) == 1
    assert states(gain=np.ones((1, 3)), time_constant=[[5.0, 6.0, 7.0]], dead_time=4.0) == 3 + 4
    assert states(gain=np.ones((2, 2)), time_constant=0.0) == 0


@pytest.mark.parametrize("first", [0.0, 30.0])
def test_levels_are_at_exactly_one_and_loops_close_on_them(first):
    model = StateSpace.from_first_order(
        gain=[[0.02, -0.02]], time_constant=np.inf, dead_time=[[first, 70.0]], dt=10.0, u_op=50.0, y_op=5.0,
        names=mampc.Names(inputs=("feed",), outputs=("level",), disturbances=("draw",)),
    )  # fmt: skip
    assert np.sum(np.abs(model.poles() - 1.0) < 1e-12) == 1
    problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=3, move_weight=1e-3)
    run = mampc.simulate(model, mampc.Regulator(mampc.MPC(problem)), [6.0], steps=60)
    assert abs(run.y[-1, 0] - 6.0) < 1e-3


@pytest.mark.parametrize("units", [1e-8, 1e8])
def test_units_do_not_show_in_the_dynamics(units):
    K = np.array(WOOD_BERRY["gain"])
    model = StateSpace.from_first_order(**WOOD_BERRY, dt=1.0)
    scaled = StateSpace.from_first_order(**{**WOOD_BERRY, "gain": units * K * [1.0, 1e3]}, dt=1.0)
    np.testing.assert_allclose(
        scaled.step_response(30), units * model.step_response(30) * [1.0, 1e3], rtol=1e-9, atol=1e-12 * units
    )
    assert np.abs(scaled.A).max() <= 1.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"gain": [1.0, 2.0]}, r"gain: expected a number or a matrix"),
        ({"gain": [[1.0, 2.0]], "time_constant": [[1.0]]}, "matrices of one shape"),
        ({"gain": [[np.nan]]}, "gain: expected finite"),
        ({"gain": np.zeros((0, 2))}, "matrices of one shape"),
        ({"time_constant": -1.0}, "time_constant: expected no negative"),
        ({"time_constant": np.nan}, "time_constant: expected no negative"),
        ({"dead_time": -0.1}, "dead_time: expected no negative"),
        ({"dead_time": np.inf}, "dead_time: expected finite"),
        ({"dead_time": 1e9}, "at most 500 states"),
        ({"dt": 0.0}, "dt: expected a finite number above 0"),
        ({"gain": "much"}, "gain: expected real numbers"),
    ],
)
def test_what_makes_no_model_is_refused(wrong, message):
    arguments = {"gain": [[1.0]], "time_constant": 5.0, "dead_time": 0.0, "dt": 1.0} | wrong
    with pytest.raises(mampc.MampcError, match=message):
        StateSpace.from_first_order(**arguments)
