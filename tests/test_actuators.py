"""Position feedback that is a little off, and time limits of plain MPC."""

import numpy as np
import pytest

import mampc
from builders import identified_tank, random_model, tank_problem
from mampc import Remark, Status


@pytest.mark.parametrize("rules", [{"max_moves": 2, "sparsity_horizon": 4}, {"dwell": 5}, {"price": 0.5}])
def test_position_feedback_that_is_a_little_off_costs_no_moves(rules):
    problem = tank_problem(identified_tank(), prediction_horizon=20)
    model, rng = problem.model, np.random.default_rng(0)
    regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(**rules)))
    state, x, u, commands = regulator.initial_state(), np.zeros(4), model.u_op, []
    reference = model.y_op + np.array([1.0, -1.0])
    for _ in range(150):
        y = model.y_op + model.C @ x
        decision = regulator.step(state, y, reference, u_applied=u + 0.02 * rng.standard_normal(2))
        assert Remark.BUDGET_EXCEEDED not in decision.remarks
        state, u = decision.state, decision.u
        commands.append(u)
        x = model.A @ x + model.B @ (u - model.u_op)
    np.testing.assert_allclose(y, reference, atol=0.3)
    moved = np.diff(commands, axis=0) != 0
    if "price" in rules:
        assert moved.mean() < 0.1
    if "max_moves" in rules:
        assert max(moved[k : k + 4].sum() for k in range(len(moved))) <= 2


def test_how_far_position_feedback_may_be_off_can_be_said():
    model = identified_tank()
    mpc = mampc.MPC(tank_problem(model))
    y, told = model.y_op, model.u_op + 0.5
    for tolerance, counts in ((None, True), (1.0, False), ([0.0, 0.0], True)):
        regulator = mampc.Regulator(mpc, applied_tolerance=tolerance)
        estimate = regulator.step(regulator.initial_state(), y, y, u_applied=told).state.estimate
        usual = regulator.step(regulator.initial_state(), y, y).state.estimate
        assert (estimate.x != usual.x).any() == counts
    with pytest.raises(mampc.MampcError, match=r"applied_tolerance: expected.*received"):
        mampc.Regulator(mpc, applied_tolerance=-1.0)


@pytest.mark.parametrize("manual", [None, [True, False, False, False]])
def test_out_of_time_plain_mpc_holds_and_says_so(manual):
    model = random_model(0, n=6, m=4, l=4)
    limits = mampc.Limits(u_min=model.u_op - 0.1, u_max=model.u_op + 0.1)
    problem = mampc.TrackingProblem(model, prediction_horizon=60, control_horizon=40, limits=limits)
    hurried = mampc.MPC(problem, time_limit=1e-9)
    decision = hurried.step(hurried.initial_state(), np.ones(6), model.y_op + 5.0, manual=manual)
    assert decision.status is Status.HELD_SOLVER_FAILED
    np.testing.assert_array_equal(decision.u, model.u_op)


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, True, "x"])
def test_a_time_limit_that_makes_no_sense_is_refused(limit):
    with pytest.raises(mampc.MampcError, match=r"time_limit: expected.*received"):
        mampc.MPC(tank_problem(), time_limit=limit)
