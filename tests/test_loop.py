"""The loop as a whole: estimator and controller on a plant, and what is measured of a run."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import random_model, same_decision, tank_problem
from mampc import Status
from mampc.loop.estimator import Estimate


def stable_model():
    """Two inputs and outputs that interact, with a feedthrough and an operating point."""
    return mampc.StateSpace(
        [[0.8, 0.1, 0.0], [0.0, 0.7, 0.1], [0.1, 0.0, 0.6]],
        [[0.5, 0.1], [0.0, 0.6], [0.3, 0.2]],
        [[1.0, 0.0, 0.2], [0.1, 1.0, 0.0]],
        [[0.1, 0.0], [0.0, 0.0]],
        2.0,
        [10.0, 20.0],
        [1.0, 2.0],
    )


def integrating_model():
    return mampc.StateSpace([[1.0, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0, [5.0], [3.0])


def regulator(model, disturbance="output", rules=None, **options):
    problem = mampc.TrackingProblem(
        model, **({"prediction_horizon": 15, "control_horizon": 4, "move_weight": 0.1} | options)
    )
    controller = mampc.MPC(problem)
    if rules is not None:
        controller = mampc.MAMPC(problem, rules, method=mampc.Alternating(polish=True, warm_up=0))
    return mampc.Regulator(controller, mampc.KalmanFilter.offset_free(model, disturbance=disturbance))


# Steady offset


@pytest.mark.parametrize("disturbance", ["output", "input"])
@pytest.mark.parametrize("gain", [0.7, 1.0, 1.3])
def test_constant_disturbances_and_a_wrong_gain_leave_no_steady_offset(disturbance, gain):
    model = stable_model()
    plant = replace(model, B=gain * model.B, D=gain * model.D)
    reference = model.y_op + np.array([1.0, -0.5])
    run = mampc.simulate(
        plant, regulator(model, disturbance), reference, steps=150,
        input_disturbance=[0.4, -0.3], output_disturbance=[0.5, 0.2],
    )  # fmt: skip
    assert np.abs(run.y[:5] - reference).max() > 0.1
    np.testing.assert_allclose(run.y[-10:], run.r[-10:], atol=1e-6)


def test_an_integrating_model_has_no_offset_with_disturbances_at_its_inputs():
    model = integrating_model()
    plant = replace(model, B=1.3 * model.B)
    run = mampc.simulate(
        plant, regulator(model, "input"), model.y_op + 2.0, steps=500,
        input_disturbance=[0.3], output_disturbance=[0.2],
    )  # fmt: skip
    np.testing.assert_allclose(run.y[-10:], run.r[-10:], atol=1e-6)


def test_an_integrating_model_is_refused_with_disturbances_at_its_outputs():
    with pytest.raises(mampc.MampcError, match=r"expected.*observable.*received.*disturbance='input'"):
        mampc.KalmanFilter.offset_free(integrating_model(), disturbance="output")


def test_the_estimator_filters_noise_and_forgets_its_start():
    model = stable_model()
    kalman = mampc.KalmanFilter.offset_free(model)
    poles = np.linalg.eigvals(
        (np.eye(5) - kalman.gain @ np.hstack([model.C, np.eye(2)]))
        @ np.block([[model.A, np.zeros((3, 2))], [np.zeros((2, 3)), np.eye(2)]])
    )
    assert np.abs(poles).max() < 1.0


@pytest.mark.parametrize("disturbance", ["output", "input"])
@pytest.mark.parametrize("seed", range(5))
def test_one_product_predicts_and_corrects_as_the_two_steps_do(disturbance, seed):
    model, rng = random_model(seed, n=4, m=3, l=2, feedthrough=True), np.random.default_rng(seed)
    names = mampc.Names(("u1", "u2"), ("y1", "y2"), (), ("load",))
    model = replace(model, u_op=model.u_op[:2], v_op=[3.0], names=names)
    kalman = mampc.KalmanFilter.offset_free(model, disturbance=disturbance)
    last = Estimate(*(rng.standard_normal(size) for size in (4, 2, 2)))
    u, y, v_last, v = (rng.standard_normal(size) for size in (2, 2, 1, 1))
    updated, predicted = kalman.update(last, u, y, v_last, v), kalman.predict(last, u, v_last)
    innovation = kalman.innovation(predicted, u, y, v)
    corrected = kalman.corrected(predicted, innovation)
    for part in ("x", "output_disturbance", "input_disturbance"):
        np.testing.assert_allclose(getattr(updated.estimate, part), getattr(corrected, part), atol=1e-12)
    np.testing.assert_allclose(updated.innovation, innovation, atol=1e-12)
    np.testing.assert_allclose(updated.movement, model.C @ (predicted.x - last.x), atol=1e-12)
    assert kalman.update(last, u, y * np.nan, v_last, v) is None


# The regulator's step


def test_a_regulators_step_is_pure_and_copies_decide_the_same():
    loop = regulator(stable_model(), limits=mampc.Limits(u_min=9.0, u_max=21.0, du_max=0.5))
    state, y, reference = loop.initial_state(), np.array([1.3, 1.8]), np.array([2.0, 3.0])
    kept = copy.deepcopy((state, y, reference))
    first = loop.step(state, y, reference)
    loop.step(first.state, -y, reference)
    assert same_decision(loop.step(state, y, reference), first)
    twin = pickle.loads(pickle.dumps(loop))
    again = twin.step(pickle.loads(pickle.dumps(state)), y, reference)
    assert same_decision(again, first)
    np.testing.assert_allclose(again.state.estimate.x, first.state.estimate.x, atol=1e-14)
    np.testing.assert_array_equal(state.estimate.x, kept[0].estimate.x)
    np.testing.assert_array_equal(state.controller.inputs, kept[0].controller.inputs)
    np.testing.assert_array_equal(y, kept[1])
    np.testing.assert_array_equal(reference, kept[2])


def test_the_estimator_predicts_with_the_inputs_that_were_really_applied():
    model = stable_model()
    loop = regulator(model)
    state, y, u = loop.initial_state(), model.y_op, model.u_op + np.array([1.0, -1.0])
    applied, decided = (loop.step(state, y, y, u_applied=v).state.estimate for v in (u, None))
    predicted = loop.estimator.predict(state.estimate, u)
    by_hand = loop.estimator.corrected(predicted, loop.estimator.innovation(predicted, u, y))
    np.testing.assert_allclose(applied.x, by_hand.x, rtol=1e-12)
    assert not np.allclose(applied.x, decided.x)


def test_moves_are_counted_and_limited_from_the_inputs_that_were_really_applied():
    rules = mampc.MoveRules(max_moves=1, sparsity_horizon=2)
    model = stable_model()
    loop = regulator(model, rules=rules, limits=mampc.Limits(du_max=3.0))
    reference = model.y_op + 1.0
    first = loop.step(loop.initial_state(), model.y_op, reference)
    assert first.moves[0].sum() == 1
    assert not loop.step(first.state, model.y_op, reference).moves.any()
    refused = loop.step(first.state, model.y_op, reference, u_applied=model.u_op)
    assert refused.moves.sum() == 1
    elsewhere = model.u_op + np.array([40.0, 0.0])
    moved = loop.step(loop.initial_state(), model.y_op, reference, u_applied=elsewhere)
    assert (np.abs(moved.u - elsewhere) <= 3.0).all()
    np.testing.assert_array_equal(moved.state.controller.inputs[0], elsewhere)


@pytest.mark.parametrize("unknown", [np.nan, np.inf, -np.inf, 1e300])
def test_applied_inputs_that_are_not_known_are_taken_to_be_those_decided(unknown):
    model = stable_model()
    loop = regulator(model)
    arguments = loop.initial_state(), model.y_op + 0.1, model.y_op
    assert same_decision(loop.step(*arguments, u_applied=[unknown] * 2), loop.step(*arguments))
    assert same_decision(
        loop.step(*arguments, u_applied=[unknown, 1.0]), loop.step(*arguments, u_applied=[model.u_op[0], 1.0])
    )


def test_applied_inputs_far_beyond_any_actuator_are_taken_to_be_those_decided():
    model = stable_model()
    loop = regulator(model, limits=mampc.Limits(u_min=model.u_op - 5.0, u_max=model.u_op + 5.0))
    arguments = loop.initial_state(), model.y_op + 0.1, model.y_op
    assert same_decision(loop.step(*arguments, u_applied=[4e9, -4e9]), loop.step(*arguments))
    by_hand = loop.step(*arguments, u_applied=model.u_op + 30.0)
    assert not np.allclose(by_hand.state.estimate.x, loop.step(*arguments).state.estimate.x)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.filterwarnings("error")
def test_a_bad_measurement_holds_the_inputs_and_the_loop_recovers(bad):
    model = stable_model()
    loop, reference = regulator(model), model.y_op + np.array([1.0, -0.5])
    state, x, u = loop.initial_state(), np.zeros(3), model.u_op
    for k in range(120):
        y = model.y_op + model.C @ x + model.D @ (u - model.u_op)
        spoiled = 3 <= k < 6
        decision = loop.step(state, [bad, bad] if spoiled else y, reference)
        if spoiled:
            assert decision.status is Status.HELD_BAD_MEASUREMENT
            np.testing.assert_array_equal(decision.u, u)
        else:
            assert decision.status is Status.OPTIMAL
        state, u = decision.state, decision.u
        x = model.A @ x + model.B @ (u - model.u_op)
    np.testing.assert_allclose(y, reference, atol=1e-6)


@pytest.mark.parametrize("disturbance", ["output", "input"])
def test_a_start_at_a_known_rest_away_from_the_operating_point_has_no_jump(disturbance):
    model = stable_model()
    u = model.u_op + np.array([3.0, -2.0])
    y = model.y_op + model.C @ model.steady_state(u) + model.D @ (u - model.u_op)
    loop = regulator(model, disturbance)
    np.testing.assert_allclose(loop.step(loop.initial_state(u, y), y, y).u, u, atol=1e-8)


def test_arrays_of_the_wrong_shape_raise():
    model = stable_model()
    loop = regulator(model)
    state, y = loop.initial_state(), model.y_op
    for arguments, options in (
        ((y[:1], y), {}),
        ((y[None], y), {}),
        ((y, y[:1]), {}),
        ((y, np.zeros((3, 2))), {}),
        ((y, y), {"u_applied": [1.0]}),
    ):
        with pytest.raises(mampc.MampcError, match=r"expected.*received"):
            loop.step(state, *arguments, **options)


def test_disturbances_act_where_they_are_said_to():
    model = stable_model()
    loop = regulator(model)
    at_output = np.zeros((6, 2))
    at_output[2:, 1] = 0.7
    run = mampc.simulate(model, loop, model.y_op, steps=6, output_disturbance=at_output)
    np.testing.assert_allclose(run.y[:3] - model.y_op, at_output[:3], atol=1e-9)
    run = mampc.simulate(model, loop, model.y_op, steps=6, input_disturbance=[0.0, 0.5])
    np.testing.assert_allclose(run.y[1], model.y_op + model.C @ model.B @ [0.0, 0.5], atol=1e-9)


@pytest.mark.parametrize(
    "options",
    [
        {"reference": [1.0, 2.0, 3.0]},
        {"reference": np.zeros((5, 3))},
        {"reference": np.empty((0, 2)), "steps": None},
        {"reference": [1.0, np.nan]},
        {"steps": None},
        {"steps": 0},
        {"noise": -0.1},
        {"noise": [0.1, 0.1, 0.1]},
        {"input_disturbance": [1.0, 2.0, 3.0]},
        {"output_disturbance": np.zeros((5, 1))},
        {"u_initial": [1.0]},
        {"plant": integrating_model()},
        {"plant": replace(stable_model(), dt=3.0)},
    ],
    ids=str,
)
def test_arguments_that_do_not_fit_together_are_refused(options):
    arguments = {"plant": stable_model(), "reference": [1.0, 2.0], "steps": 5} | options
    plant, reference = arguments.pop("plant"), arguments.pop("reference")
    with pytest.raises(mampc.MampcError, match=r"expected"):
        mampc.simulate(plant, regulator(stable_model()), reference, **arguments)


def controllers_of_all_kinds():
    problem = tank_problem()
    yield mampc.MPC(problem)
    yield mampc.rivals.DeadBand(mampc.MPC(problem), size=1.0)
    for rules in (mampc.MoveRules(price=1.0), mampc.MoveRules(max_moves=3, sparsity_horizon=3)):
        for method in mampc.METHODS:
            yield mampc.MAMPC(problem, rules, method=method)


@pytest.mark.parametrize("controller", [*controllers_of_all_kinds()])
def test_a_decision_cannot_be_changed_behind_the_loops_back(controller):
    loop, y_op = mampc.Regulator(controller), controller.problem.model.y_op
    decision = loop.step(loop.initial_state(), y_op, y_op + 2.0)
    for array in (
        decision.u, decision.plan, decision.changes, decision.violations, decision.state.controller.inputs,
    ):  # fmt: skip
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 99.0


def test_an_estimate_that_ran_away_starts_again():
    """An unstable model predicts itself out of all numbers while measurements are missing."""
    model = mampc.StateSpace([[1.8]], [[1.0]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=5, control_horizon=2, limits=mampc.Limits(u_min=-1.0, u_max=1.0)
    )
    loop = mampc.Regulator(mampc.MPC(problem))
    state = loop.initial_state()
    for _ in range(1500):
        state = loop.step(state, [np.nan], [0.1]).state
    decision = loop.step(state, [0.0], [0.1])
    assert not decision.held


@pytest.mark.parametrize("integrating", [False, True])
def test_with_disturbances_at_the_inputs_the_first_step_has_no_jump_either(integrating):
    poles = [1.0, 0.7] if integrating else [0.9, 0.7]
    model = mampc.StateSpace(np.diag(poles), np.eye(2), [[1.0, 0.3], [0.2, 1.0]], None, 1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=3)
    loop = mampc.Regulator(mampc.MPC(problem), mampc.KalmanFilter.offset_free(model, disturbance="input"))
    y = np.array([3.0, -2.0])
    decision = loop.step(loop.initial_state([0.5, -0.5], y), y, y)
    np.testing.assert_allclose(decision.changes, 0.0, atol=1e-6)


def test_more_inputs_than_outputs_leave_no_offset_with_disturbances_at_the_inputs():
    model = mampc.StateSpace(
        np.diag([1.0, 0.8, 0.6]), [[1.0, 0.5, 0.2], [0.1, 1.0, 0.3], [0.4, 0.2, 1.0]],
        [[1.0, 0.2, 0.1], [0.1, 1.0, 0.5]], None, 1.0,
    )  # fmt: skip
    problem = mampc.TrackingProblem(model, prediction_horizon=15, control_horizon=4)
    loop = mampc.Regulator(mampc.MPC(problem), mampc.KalmanFilter.offset_free(model, disturbance="input"))
    run = mampc.simulate(model, loop, [1.0, -1.0], steps=300, input_disturbance=[0.3, -0.2, 0.1])
    np.testing.assert_allclose(run.y[-1], [1.0, -1.0], atol=1e-3)


def test_how_far_inputs_move_an_integrating_output_counts_its_feedthrough():
    model = mampc.StateSpace([[1.0]], [[0.01]], [[1.0]], [[5.0]], 1.0)
    limits = mampc.Limits(u_min=-1.0, u_max=1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=5, control_horizon=2, limits=limits)
    loop = mampc.Regulator(mampc.MPC(problem), mampc.KalmanFilter.offset_free(model, disturbance="input"))
    # The inputs move the output by 10.2 soon: a tenth of that is a jump.
    far, near = (loop.step(loop.initial_state(), [y], [0.0]).ignored_outputs for y in (1.1, 0.9))
    assert far == {"y1": mampc.Fault.JUMP}
    assert near == {}


@pytest.mark.parametrize("size", [2, 120])
def test_what_is_shown_of_models_filters_regulators_and_runs_fits_a_line_or_two(size):
    names = mampc.Names(*(tuple(f"{kind}{'x' * 100}{i}" for i in range(size)) for kind in "uyx"))
    model = mampc.StateSpace(0.5 * np.eye(size), np.eye(size), np.eye(size), None, 1.0, names=names)
    problem = mampc.TrackingProblem(model, prediction_horizon=2, control_horizon=1)
    shown = [model, mampc.KalmanFilter.offset_free(model), mampc.Regulator(mampc.MPC(problem))]
    if size == 2:
        shown.append(mampc.simulate(model, shown[-1], model.y_op, steps=3))
        assert "3 optimal" in repr(shown[-1])
    for thing in shown:
        assert len(repr(thing)) < 400
        assert "\n" not in repr(thing)
