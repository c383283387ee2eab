"""Reference filters: lags and ramps between what is asked for and what is tracked."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import random_model, same_decision

FILTERS = {
    "lag": mampc.ReferenceFilter(time_constant=4.0),
    "ramp": mampc.ReferenceFilter(rate=0.05),
    "both": mampc.ReferenceFilter(time_constant=(0.0, 3.0), rate=(0.1, np.inf)),
}
each_filter = pytest.mark.parametrize("smooth", FILTERS.values(), ids=FILTERS)


def loop(smooth, rules=None, model=None):
    model = random_model(3) if model is None else model
    limits = mampc.Limits(u_min=model.u_op - 5, u_max=model.u_op + 5)
    problem = mampc.TrackingProblem(model, prediction_horizon=8, control_horizon=3, limits=limits)
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    return mampc.Regulator(controller, reference_filter=smooth)


def test_a_lag_comes_as_near_as_its_time_constant_says():
    course = mampc.ReferenceFilter(time_constant=20.0).fitted(1, 5.0).course(np.zeros(1), np.ones(1), 12)
    np.testing.assert_allclose(course[:, 0], 1 - np.exp(-np.arange(1, 13) * 5.0 / 20.0), rtol=1e-12)


def test_a_ramp_rises_at_its_rate_and_arrives_exactly():
    course = mampc.ReferenceFilter(rate=0.06).fitted(1, 5.0).course(np.zeros(1), np.full(1, 0.7), 5)
    np.testing.assert_allclose(course[:, 0], [0.3, 0.6, 0.7, 0.7, 0.7])
    assert course[2, 0] == 0.7


@each_filter
@pytest.mark.parametrize("preview", [False, True])
def test_what_plans_know_of_the_way_comes_true(smooth, preview):
    fitted, rng = smooth.fitted(2, 1.0), np.random.default_rng(0)
    asked = (
        np.repeat(rng.standard_normal((6, 2)), 5, axis=0)
        if preview
        else np.tile(rng.standard_normal(2), (30, 1))
    )
    last = rng.standard_normal(2)
    first = fitted.course(last, asked if preview else asked[0], 30)
    for k in range(20):
        course = fitted.course(last, asked[k : k + 9] if preview else asked[k], 9)
        np.testing.assert_allclose(course, first[k : k + 9], atol=1e-14)
        last = course[0]


@pytest.mark.parametrize("preview", [False, True])
def test_no_lag_and_no_ramp_change_nothing(preview):
    model, reference = random_model(3), mampc.steps(30, [0.0, 0.0], [(5, [1.0, -1.0])])
    with_none, without = (
        mampc.simulate(model, loop(smooth), reference + model.y_op, noise=0.1, preview=preview)
        for smooth in (mampc.ReferenceFilter(), None)
    )
    np.testing.assert_allclose(with_none.u, without.u, atol=1e-12)


def test_the_way_starts_at_the_outputs():
    regulator = loop(FILTERS["ramp"])
    model = regulator.controller.problem.model
    np.testing.assert_allclose(regulator.initial_state().reference, model.y_op)
    np.testing.assert_array_equal(regulator.initial_state(y=[7.0, 8.0]).reference, [7.0, 8.0])


def test_the_way_starts_anew_where_all_inputs_were_in_manual():
    regulator = loop(FILTERS["ramp"])
    model = regulator.controller.problem.model
    state, u, rng = regulator.initial_state(), model.u_op + 0.2, np.random.default_rng(0)
    y = model.y_op + model.dc_gain() @ (u - model.u_op)
    for _ in range(60):
        measured = y + 1e-6 * rng.standard_normal(2)
        state = regulator.step(state, measured, model.y_op, u_applied=u, manual=[True, True]).state
    np.testing.assert_allclose(state.reference, y - 0.05 * np.sign(y - model.y_op), atol=0.03)
    in_part = regulator.step(state, y, model.y_op, u_applied=u, manual=[True, False]).state
    np.testing.assert_allclose(in_part.reference, state.reference - 0.05 * np.sign(y - model.y_op))


def test_a_reference_that_is_no_number_leaves_the_way_where_it_is():
    regulator = loop(FILTERS["lag"])
    model = regulator.controller.problem.model
    first = regulator.step(regulator.initial_state(), model.y_op, model.y_op + 1.0)
    second = regulator.step(first.state, model.y_op, [np.nan, 1.0])
    assert second.status is mampc.Status.HELD_BAD_MEASUREMENT
    np.testing.assert_array_equal(second.state.reference, first.state.reference)
    third = regulator.step(second.state, model.y_op, [1e308, 1.0])
    assert third.status is mampc.Status.HELD_BAD_MEASUREMENT


@each_filter
def test_units_decide_nothing(smooth):
    model, reference = random_model(3), mampc.steps(40, [0.0, 0.0], [(5, [1.0, -1.0])])
    scale = np.array([1e3, 1e-4])
    scaled = replace(model, C=scale[:, None] * model.C, y_op=scale * model.y_op)
    in_units = mampc.ReferenceFilter(
        time_constant=smooth.time_constant,
        rate=None if smooth.rate is None else scale * np.asarray(smooth.rate),
    )
    runs = []
    for of, weight, own, factor in ((model, 1.0, smooth, 1.0), (scaled, scale**-2, in_units, scale)):
        problem = mampc.TrackingProblem(of, prediction_horizon=8, control_horizon=3, output_weight=weight)
        estimator = mampc.KalmanFilter.offset_free(
            of, measurement_noise=factor * np.ones(2), drift=0.3 * factor * np.ones(2)
        )
        controller = mampc.MAMPC(problem, mampc.MoveRules(price=0.01))
        regulator = mampc.Regulator(controller, estimator, reference_filter=own)
        runs.append(mampc.simulate(of, regulator, of.y_op + factor * reference))
    np.testing.assert_allclose(runs[0].u, runs[1].u, atol=1e-7)


@each_filter
@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=0.01)], ids=["plain", "price"])
@pytest.mark.parametrize("preview", [False, True])
def test_loops_as_arrays_equal_single_ones(smooth, rules, preview):
    model, regulator = random_model(3), loop(smooth, rules)
    reference = mampc.steps(30, model.y_op, [(5, model.y_op + 1.0), (15, model.y_op - 4.0)])
    batch = mampc.simulate_batch(model, regulator, reference, seeds=(0, 1), noise=0.1, preview=preview)
    for s in range(2):
        run = mampc.simulate(model, regulator, reference, seed=s, noise=0.1, preview=preview)
        np.testing.assert_allclose(batch.u[s], run.u, atol=1e-9)


@each_filter
def test_a_run_replays_and_a_state_kept_as_text_leads_to_the_same_decisions(smooth):
    model, regulator = random_model(3), loop(smooth, mampc.MoveRules(price=0.01))
    reference = mampc.steps(30, model.y_op, [(5, model.y_op + 1.0)])
    run = mampc.simulate(model, regulator, reference, noise=0.1)
    state = regulator.initial_state(model.u_op, model.y_op)
    recording = mampc.Recording.of(run)
    assert mampc.replay(loop(smooth, mampc.MoveRules(price=0.01)), state, recording, tolerance=1e-9) is None
    decision = regulator.step(state, model.y_op, reference[10])
    text = decision.state.to_json()
    again = [
        regulator.step(s, model.y_op, reference[10])
        for s in (decision.state, regulator.state_from_json(text))
    ]
    assert same_decision(*again, atol=0)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"time_constant": -1.0}, "time_constant: expected one number at least 0"),
        ({"rate": 0.0}, "rate: expected one number above 0"),
        ({"time_constant": [1.0, 2.0, 3.0]}, "time_constant: expected a scalar or 2"),
        ({"rate": [1.0, 2.0, 3.0]}, "rate: expected a scalar or 2"),
        ({"time_constant": np.inf}, "time_constant"),
        ({"rate": [np.nan, 1.0]}, "rate"),
    ],
)
def test_bad_settings_are_refused(settings, expected):
    with pytest.raises(mampc.MampcError, match=expected):
        loop(mampc.ReferenceFilter(**settings))


def test_a_state_of_a_regulator_without_a_filter_is_refused():
    regulator, other = loop(FILTERS["lag"]), loop(None)
    y = regulator.controller.problem.model.y_op
    with pytest.raises(mampc.MampcError, match="with a reference filter"):
        regulator.step(other.initial_state(), y, y)
    with pytest.raises(mampc.MampcError, match="without a reference filter"):
        other.step(regulator.initial_state(), y, y)
    with pytest.raises(mampc.MampcError, match="expected reference of shape"):
        regulator.state_from_json(other.initial_state().to_json())
