"""`StateSpace.from_step_response`: few states, every coefficient to its accuracy, sensible beyond the record."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mampc
from mampc import StateSpace


def column(seed, outputs=12, inputs=5, samples=61):
    """Step responses of lags with dead times, all settled within the samples."""
    rng = np.random.default_rng(seed)
    shape = (outputs, inputs)
    truth = StateSpace.from_first_order(
        gain=rng.normal(size=shape) * 10.0 ** rng.uniform(-2, 1, shape),
        time_constant=rng.uniform(60, 600, shape),
        dead_time=rng.uniform(0, 600, shape),
        dt=60.0,
    )
    return truth.step_response(samples)


def worst(model, S):
    """The largest error of any coefficient, in shares of the largest of its channel."""
    size = np.abs(S).max(axis=0)
    return (np.abs(model.step_response(len(S)) - S) / np.where(size > 0, size, 1.0)).max()


def test_twelve_outputs_and_five_inputs_take_few_states():
    S = column(0)
    model = StateSpace.from_step_response(S, dt=60.0)
    assert worst(model, S) <= 0.01
    assert model.n_states < 150  # of the 300 of a shift register
    assert model.is_stable()
    beyond = model.step_response(400)[-1]
    assert (np.abs(beyond - S[-1]) <= 0.03 * np.abs(S).max(axis=0)).all()


@pytest.mark.parametrize("absent", [[(0, 1)], [(1, 0)], [(0, 1), (1, 0)], [(0, 0), (0, 1)]])
def test_what_an_input_does_not_move_stays_exactly_still_and_costs_no_states(absent):
    gain = np.array([[12.8, -18.9], [6.6, -19.4]])
    whole = StateSpace.from_first_order(
        gain=gain, time_constant=[[1002, 1260], [654, 864]], dead_time=[[60, 180], [420, 180]], dt=60.0
    ).step_response(120)
    S = whole.copy()
    for i, j in absent:
        S[:, i, j] = 0.0
    model = StateSpace.from_step_response(S, dt=60.0)
    assert worst(model, S) <= 0.01
    assert not model.step_response(300)[:, [i for i, _ in absent], [j for _, j in absent]].any()
    assert model.n_states <= StateSpace.from_step_response(whole, dt=60.0).n_states + 4


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.1, 0.01, 1e-4]))
def test_any_coefficients_are_met_to_the_accuracy_asked(seed, accuracy):
    rng = np.random.default_rng(seed)
    S = rng.normal(size=(rng.integers(2, 20), rng.integers(1, 4), rng.integers(1, 4)))
    if seed % 2:
        S = np.cumsum(S, axis=0)
    assert worst(StateSpace.from_step_response(S, dt=1.0, accuracy=accuracy), S) <= accuracy * (1 + 1e-6)


@pytest.mark.parametrize("l", [1, 2, 7])
@pytest.mark.parametrize("m", [1, 3])
def test_units_decide_nothing(l, m):
    S = column(1, l, m)
    model = StateSpace.from_step_response(S, dt=60.0)
    rng = np.random.default_rng(2)
    rows, columns = 10.0 ** rng.uniform(-8, 8, (l, 1)), 10.0 ** rng.uniform(-8, 8, m)
    scaled = StateSpace.from_step_response(rows * S * columns, dt=60.0)
    assert worst(scaled, rows * S * columns) <= 0.01
    assert abs(scaled.n_states - model.n_states) <= 0.3 * model.n_states + 2


def test_a_level_integrates_at_exactly_one():
    slopes = np.array([[0.5, -0.25], [5.0, -2.5]])  # one vessel, measured in two units
    S = np.arange(60.0)[:, None, None] * slopes + column(3, 2, 2, 60) / 100
    model = StateSpace.from_step_response(S, dt=60.0)
    assert worst(model, S) <= 0.01
    assert np.sum(model.poles() == 1.0) == 1
    late = model.step_response(1000)
    np.testing.assert_allclose(late[-1] - late[-2], slopes, rtol=0.02)
    # A controller can be built on it, and its loop closes.
    model = StateSpace.from_step_response(S[:, :1], dt=60.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=40, control_horizon=3, move_weight=1.0)
    run = mampc.simulate(model, mampc.Regulator(mampc.MPC(problem)), [1.0], steps=150)
    assert abs(run.y[-1, 0] - 1.0) < 0.01


def test_a_response_that_has_not_settled_goes_on_to_where_it_leads():
    truth = StateSpace.from_first_order(gain=[[4.0]], time_constant=25.0, dead_time=3.0, dt=1.0)
    model = StateSpace.from_step_response(truth.step_response(60), dt=1.0)
    assert np.isclose(model.dc_gain()[0, 0], 4.0, rtol=0.02)
    slow = StateSpace.from_first_order(gain=[[4.0]], time_constant=600.0, dt=1.0)
    assert (StateSpace.from_step_response(slow.step_response(60), dt=1.0).poles() == 1.0).any()


def test_noise_on_a_settled_response_is_no_integrator():
    rng = np.random.default_rng(4)
    for _ in range(20):
        S = column(5, 2, 2)
        S = S + 0.05 * np.abs(S).max(axis=0) * rng.normal(size=S.shape)
        assert StateSpace.from_step_response(S, dt=60.0).is_stable()


def test_what_acts_at_once_is_D():
    S = np.ones((5, 1, 1)) * 2.0
    model = StateSpace.from_step_response(S, dt=1.0)
    assert (model.n_states, model.D.item()) == (0, 2.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.ones(60), "shape"),
        (np.ones((60, 2)), "shape"),
        (np.ones((1, 2, 2)), "shape"),
        (np.ones((60, 0, 2)), "shape"),
        (np.zeros((60, 2, 2)), "zeros alone"),
        (np.full((60, 2, 2), np.nan), "finite"),
        ({}, "real numbers"),
        ("steps.csv", "real numbers"),
        ([[[1.0], [2.0]], [[1.0]]], "real numbers"),
        (np.ones((2001, 1, 1)), "shape"),
        (np.ones((1500, 2, 2)), "leave out samples"),
    ],
)
def test_what_is_no_step_response_is_refused_in_one_sentence(wrong, message):
    with pytest.raises(mampc.MampcError, match=message) as caught:
        StateSpace.from_step_response(wrong, dt=60.0)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("setting", [{"accuracy": 0.0}, {"accuracy": 1.0}, {"accuracy": None}, {"dt": 0.0}])
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(mampc.MampcError, match=next(iter(setting))):
        StateSpace.from_step_response(np.ones((5, 1, 1)), **{"dt": 1.0} | setting)


def test_models_of_some_hundred_states_are_saved_loaded_and_controlled_with(tmp_path):
    rng = np.random.default_rng(6)
    model = StateSpace.from_first_order(
        gain=rng.normal(size=(12, 5)), time_constant=rng.uniform(300, 3000, (12, 5)),
        dead_time=rng.uniform(0, 88 * 60, (12, 5)), dt=60.0,
    )  # fmt: skip
    assert model.n_states > 450
    model.save(tmp_path / "large.json")
    loaded = StateSpace.load(tmp_path / "large.json")
    assert np.array_equal(loaded.A, model.A)
    problem = mampc.TrackingProblem(loaded, prediction_horizon=10, control_horizon=3)
    regulator = mampc.Regulator(mampc.MPC(problem))
    assert regulator.step(regulator.initial_state(), np.zeros(12), np.ones(12)).status.name == "OPTIMAL"
