"""Limits told at run time, actuators that do as they like, manual mode, emergency moves."""

import cvxpy as cp
import numpy as np
import pytest

import mampc
from builders import fading, identified_tank, predicted, random_model, tank_problem, violation_scale
from mampc import Remark, Status
from seeds import seeds

EITHER = pytest.mark.usefixtures("either_estimator")

METHODS = ["mpc", *mampc.METHODS]
UPPER = mampc.Limits(u_min=0.0, u_max=100.0)


def controller_of(method, problem, rules=None, **settings):
    if method == "mpc":
        return mampc.MPC(problem)
    if method == "alternating":
        settings = {"warm_up": 0, **settings}
    return mampc.MAMPC(problem, rules or mampc.MoveRules(price=0.1, max_moves=6), method=method, **settings)


# Limits of one sample


def random_limits(rng, problem, low=0.05):
    """Limits of one sample, varying over the horizon, that leave room around the operating point."""
    model, n_c, n_p = problem.model, problem.control_horizon, problem.prediction_horizon
    l, m = model.n_outputs, model.n_inputs
    return mampc.Limits(
        u_min=model.u_op - rng.uniform(low, 0.5, (n_c, m)),
        u_max=model.u_op + rng.uniform(low, 0.5, (n_c, m)),
        du_max=rng.uniform(0.1, 0.4, (n_c, m)),
        y_min=model.y_op - rng.uniform(0.0, 1.0, (n_p, l)),
        y_max=model.y_op + rng.uniform(0.0, 1.0, (n_p, l)),
    )


def random_problem(seed):
    model = random_model(seed, n=3, m=2, l=2)
    limits = mampc.Limits(
        u_min=model.u_op - 1, u_max=model.u_op + 1, du_max=0.8, y_min=model.y_op - 5, y_max=model.y_op + 5
    )
    return mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=3, limits=limits)


def best_by_cvxpy(problem, limits, x, u_previous, reference, pattern):
    """The least cost within limits that vary over the horizon, moves off the pattern being zero."""
    model, n_p, n_c = problem.model, problem.prediction_horizon, problem.control_horizon
    u, e = cp.Variable((n_c, model.n_inputs)), cp.Variable(model.n_outputs, nonneg=True)
    outputs, state = [], x
    for i in range(n_p + 1):
        now = u[min(i, n_c - 1)] - model.u_op
        outputs.append(model.y_op + model.C @ state + model.D @ now)
        state = model.A @ state + model.B @ now
    changes = u - cp.vstack([u_previous[None], u[:-1]])
    cost = sum(cp.sum_squares(reference - y) for y in outputs) + 0.1 * cp.sum_squares(changes)
    scaled = cp.multiply(violation_scale(problem), e)
    cost += problem.output_limit_weight * (cp.sum(scaled) + cp.sum_squares(scaled) / 2)
    constraints = [u >= limits.u_min, u <= limits.u_max, cp.abs(changes) <= limits.du_max]
    rho = fading(n_p)
    constraints += [outputs[i + 1] <= limits.y_max[i] + rho[i] * e for i in range(n_p)]
    constraints += [outputs[i + 1] >= limits.y_min[i] - rho[i] * e for i in range(n_p)]
    constraints += [changes[~pattern] == 0] if (~pattern).any() else []
    problem_ = cp.Problem(cp.Minimize(cost), constraints)
    problem_.solve(solver=cp.CLARABEL)
    return problem_.value if problem_.status == "optimal" else np.inf


@pytest.mark.parametrize("seed", seeds(12, quick=1))
def test_limits_that_vary_over_the_horizon_are_those_of_the_optimum(seed):
    """Every pattern with at most two moves by an independent solver against the exact search; and plain MPC."""
    rng, problem = np.random.default_rng(seed), random_problem(seed)
    model, limits = problem.model, random_limits(rng, problem)
    x, reference = 0.5 * rng.standard_normal(3), model.y_op + rng.standard_normal(2)
    exact = controller_of("exact", problem, mampc.MoveRules(max_moves=2, price=0.02))
    decision = exact.step(exact.initial_state(), x, reference, limits=limits)
    mpc = mampc.MPC(problem)
    free = mpc.step(mpc.initial_state(), x, reference, limits=limits)
    all_free = np.ones((3, 2), dtype=bool)
    best = best_by_cvxpy(problem, limits, x, model.u_op, reference, all_free)
    assert free.objective == pytest.approx(best, rel=1e-6)
    values = []
    for chosen in [(), *((i,) for i in range(6)), *((i, j) for i in range(6) for j in range(i))]:
        pattern = np.zeros(6, dtype=bool)
        pattern[list(chosen)] = True
        pattern = pattern.reshape(3, 2)
        cost = best_by_cvxpy(problem, limits, x, model.u_op, reference, pattern)
        values.append(cost + 0.02 * pattern.sum())
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(min(values), rel=1e-6)
    for plan in (decision.plan, free.plan):
        assert (plan >= limits.u_min - 1e-9).all()
        assert (plan <= limits.u_max + 1e-9).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", seeds(3, quick=1))
def test_every_method_keeps_limits_told_at_run_time(method, seed):
    rng, problem = np.random.default_rng(seed), random_problem(seed)
    controller, model = controller_of(method, problem), problem.model
    state, x, u = controller.initial_state(), np.zeros(3), model.u_op
    for _ in range(25):
        limits = random_limits(rng, problem)
        decision = controller.step(state, x, model.y_op + 2 * rng.standard_normal(2), limits=limits)
        assert (decision.u >= limits.u_min[0]).all()
        assert (decision.u <= limits.u_max[0]).all()
        if Remark.BACK_INSIDE not in decision.remarks:
            assert (np.abs(decision.u - u) <= limits.du_max[0] + 1e-9).all()
        state, u = decision.state, decision.u
        x = model.A @ x + model.B @ (u - model.u_op)


@pytest.mark.parametrize("method", METHODS)
def test_limits_that_contradict_one_another_hold_the_inputs_and_spoil_nothing(method):
    problem = tank_problem(identified_tank())
    controller = controller_of(method, problem)
    state, x, r = controller.initial_state(), np.array([0.3, -0.2, 0.1, 0.0]), problem.model.y_op + 2.0
    before = controller.step(state, x, r)
    crossed = controller.step(state, x, r, limits=mampc.Limits(u_min=[60.0, 0.0], u_max=[40.0, 100.0]))
    assert crossed.status is Status.HELD_INFEASIBLE
    np.testing.assert_array_equal(crossed.u, state.inputs[-1])
    after = controller.step(state, x, r)
    np.testing.assert_array_equal(after.plan, before.plan)
    assert after.objective == before.objective


def test_an_input_whose_limits_contradict_one_another_leaves_the_others_within_theirs():
    problem = tank_problem(identified_tank())
    controller = mampc.MPC(problem)
    state = controller.initial_state([50.0, 70.0])
    limits = mampc.Limits(u_min=[60.0, 0.0], u_max=[40.0, 65.0])
    held = controller.step(state, np.zeros(4), problem.model.y_op, limits=limits)
    assert held.status is Status.HELD_INFEASIBLE
    np.testing.assert_array_equal(held.u, [50.0, 65.0])
    manual = controller.step(state, np.zeros(4), problem.model.y_op, limits=limits, manual=[True, False])
    assert not manual.held
    assert (manual.plan[:, 0] == 50.0).all()
    assert (manual.plan[:, 1] <= 65.0).all()


def test_limits_that_are_no_numbers_stay_as_the_problem_has_them():
    controller = mampc.MPC(tank_problem())
    state, r = controller.initial_state(), controller.problem.model.y_op + 60.0
    usual = controller.step(state, np.zeros(4), r)
    told = controller.step(state, np.zeros(4), r, limits=mampc.Limits(u_max=[np.nan, np.inf], u_min=np.nan))
    np.testing.assert_allclose(told.plan, usual.plan, atol=1e-9)


def test_run_time_limits_of_inputs_never_widen_those_of_the_problem_and_those_of_outputs_may():
    model = identified_tank()
    limits = mampc.Limits(u_min=0.0, u_max=60.0, y_max=model.y_op + 1.0)
    controller = mampc.MPC(tank_problem(model, limits=limits))
    state, r = controller.initial_state(), model.y_op + 20.0
    wide = mampc.Limits(u_max=90.0, y_max=model.y_op + 50.0)
    assert controller.step(state, np.zeros(4), r, limits=wide).u.max() == 60.0
    narrow = controller.step(state, np.zeros(4), r)
    y = predicted(model, np.zeros(4), narrow.plan, 11)
    assert (y <= model.y_op + 1.0 + 1e-6).all()
    y = predicted(model, np.zeros(4), controller.step(state, np.zeros(4), r, limits=wide).plan, 11)
    assert (y > model.y_op + 1.1).any()


def test_a_limit_that_the_problem_does_not_have_is_refused_at_run_time():
    controller = mampc.MPC(tank_problem())
    for limits in (mampc.Limits(y_max=30.0), mampc.Limits(du_max=1.0), mampc.Limits(u_max=np.zeros((3, 3)))):
        with pytest.raises(mampc.MampcError, match=r"limits: expected.*received"):
            controller.step(
                controller.initial_state(), np.zeros(4), controller.problem.model.y_op, limits=limits
            )


@pytest.mark.parametrize("method", METHODS)
def test_a_plant_outside_its_output_limits_is_brought_back_and_the_violation_is_told(method):
    model = identified_tank()
    high = model.y_op + np.array([-2.0, 5.0])
    limits = mampc.Limits(u_min=0.0, u_max=100.0, du_max=10.0, y_max=high)
    problem = tank_problem(model, prediction_horizon=20, limits=limits)
    controller = controller_of(method, problem)
    state, x, told = controller.initial_state(), np.zeros(4), []
    for _ in range(40):
        decision = controller.step(state, x, model.y_op + np.array([-3.0, 0.0]))
        assert not decision.held
        told.append(decision.violations)
        y = predicted(model, x, decision.plan, 21)[1:]
        np.testing.assert_allclose(told[-1], np.maximum(0, (y - high).max(axis=0)), atol=1e-6)
        state = decision.state
        x = model.A @ x + model.B @ (decision.u - model.u_op)
    assert told[0][0] > 0.5
    np.testing.assert_allclose(told[-1], 0.0, atol=1e-6)


@EITHER
@pytest.mark.parametrize(("low", "high"), [([40, 35], [45, 40]), ([36, 31], [41, 36])])
@pytest.mark.parametrize(
    "rules",
    [
        {"sparsity_horizon": 4, "max_moves": 3},
        {"sparsity_horizon": 4, "max_moves": 2},
        {"sparsity_horizon": 8, "max_moves": 3},
    ],
)
def test_a_budget_does_not_keep_outputs_outside_their_limits(low, high, rules):
    """On the way back one output passes through more violation for a while."""
    limits = mampc.Limits(u_min=0.0, u_max=100.0, y_min=low, y_max=high)
    controller = mampc.MAMPC(tank_problem(identified_tank(), limits=limits), mampc.MoveRules(**rules))
    middle = (np.array(low) + high) / 2
    run = mampc.simulate(
        mampc.plants.QuadrupleTank(), mampc.Regulator(controller), middle, steps=200, progress=False
    )
    assert run.decisions[0].violations.max() > 1.0
    np.testing.assert_allclose(run.y[-1], middle, atol=0.3)
    np.testing.assert_array_equal(run.decisions[-1].violations, 0.0)


# Actuators and manual mode


@pytest.mark.parametrize("method", METHODS)
def test_an_input_in_manual_stays_where_it_is_and_the_other_does_the_work(method):
    problem = tank_problem(identified_tank(), prediction_horizon=20)
    controller = controller_of(method, problem, mampc.MoveRules(max_moves=4))
    decision = controller.step(
        controller.initial_state([40.0, 55.0]), np.zeros(4), problem.model.y_op + 3.0, manual=[True, False]
    )
    np.testing.assert_array_equal(decision.plan[:, 0], 40.0)
    assert decision.moves[:, 1].any()
    everything = controller.step(
        controller.initial_state([40.0, 55.0]), np.zeros(4), problem.model.y_op + 3.0, manual=[True, True]
    )
    np.testing.assert_array_equal(everything.plan, np.tile([40.0, 55.0], (5, 1)))


@EITHER
@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=0.5, max_moves=3, sparsity_horizon=3)])
def test_back_from_manual_there_is_no_bump(rules):
    """An operator takes the plant elsewhere and leaves it at rest there, at the reference."""
    problem = tank_problem(identified_tank(), prediction_horizon=20)
    controller, model = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules), problem.model
    regulator = mampc.Regulator(controller)
    state, x, u = regulator.initial_state(), np.zeros(4), model.u_op
    by_hand = model.u_op + np.array([4.0, -3.0])
    goal = model.y_op + model.dc_gain() @ (by_hand - model.u_op)
    for k in range(220):
        decision = regulator.step(
            state, model.y_op + model.C @ x, goal, u_applied=u, manual=[k < 200, k < 200]
        )
        state = decision.state
        u = by_hand if k < 200 else decision.u
        x = model.A @ x + model.B @ (u - model.u_op)
        if k >= 200:
            np.testing.assert_allclose(u, by_hand, atol=1e-3)


@pytest.mark.parametrize("error", [ZeroDivisionError, np.linalg.LinAlgError])
def test_a_plan_that_fails_in_its_arithmetic_holds_the_inputs_and_the_loop_goes_on(error, monkeypatch):
    controller = mampc.MPC(tank_problem())
    x, y = np.zeros(controller.problem.model.n_states), controller.problem.model.y_op + 1.0
    state = controller.initial_state()
    usual = controller.step(state, x, y)

    def fails(*_):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(mampc.MPC, "plan", fails)
        decision = controller.step(state, x, y)
    assert decision.status is mampc.Status.HELD_SOLVER_FAILED
    np.testing.assert_array_equal(decision.u, state.inputs[-1])
    np.testing.assert_array_equal(controller.step(decision.state, x, y).u, usual.u)


@EITHER
@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=0.01)])
@pytest.mark.parametrize("told", [None, mampc.Limits(u_max=60.0)])
def test_an_input_held_outside_its_limits_by_hand_is_predicted_where_it_is(rules, told):
    """u1 is held at 70 by hand: its limit, of the problem or of this sample, is not where it is."""
    limits = mampc.Limits(u_min=0.0, u_max=65.0 if told is None else 100.0)
    problem = tank_problem(identified_tank(), prediction_horizon=30, limits=limits, tail_horizon=500.0)
    controller, model = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules), problem.model
    regulator, u = mampc.Regulator(controller), np.array([70.0, 40.0])
    x, state = model.steady_state(u), regulator.initial_state(u)
    wanted = model.y_op + model.dc_gain() @ (np.array([70.0, 37.0]) - model.u_op)
    for _ in range(120):
        decision = regulator.step(
            state, model.y_op + model.C @ x, wanted, u_applied=u, manual=[True, False], limits=told
        )
        assert decision.u[0] == (65.0 if told is None else 60.0)
        assert not decision.remarks
        state, u = decision.state, np.array([70.0, decision.u[1]])
        x = model.A @ x + model.B @ (u - model.u_op)
    np.testing.assert_allclose(u[1], 37.0, atol=1e-3 if rules is None else 0.5)


@pytest.mark.parametrize("method", METHODS)
def test_an_input_held_outside_its_limits_by_hand_is_not_planned_back_with_the_others(method):
    problem = random_problem(3)
    last = problem.model.u_op + np.array([1.7, -3.0])
    controller = controller_of(method, problem)
    decision = controller.step(
        controller.initial_state(last), np.ones(3), problem.model.y_op + 3, manual=[False, True]
    )
    assert not decision.changes[:, 1].any()
    np.testing.assert_array_equal(decision.plan[:, 1], last[1])
    assert decision.u[1] == problem.limits.u_min[1]


@pytest.mark.parametrize("method", METHODS)
def test_inputs_held_outside_limits_that_came_at_run_time_go_inside_and_that_is_said(method):
    """But for those in manual, which somebody else moves: they are only told to be there."""
    problem = random_problem(3)
    u_op, controller = problem.model.u_op, controller_of(method, problem)
    tighter, y = mampc.Limits(u_min=u_op + 0.9), problem.model.y_op
    state = controller.initial_state(u_op)
    by_hand = controller.step(state, np.zeros(3), y, limits=tighter, manual=[True, True])
    blind = controller.step(state, np.full(3, np.nan), y, limits=tighter)
    for decision in (by_hand, blind):
        np.testing.assert_array_equal(decision.u, u_op + 0.9)  # further than du_max
    assert blind.remarks == (Remark.BACK_INSIDE,)
    assert by_hand.remarks == ()
    usual = controller.step(state, np.full(3, np.nan), y)
    assert usual.remarks == ()


@pytest.mark.parametrize("method", METHODS)
def test_the_way_back_inside_is_all_that_an_input_moves_by_where_moves_are_limited(method):
    model = mampc.StateSpace([[0.9]], [[0.5]], [[1.0]], None, 1.0)
    limits = mampc.Limits(u_min=0.0, u_max=10.0, du_max=2.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=4, limits=limits)
    controller = controller_of(method, problem)
    decision = controller.step(controller.initial_state([-1.0]), [0.0], [20.0])
    assert 0.0 <= decision.u[0] <= 1.0
    np.testing.assert_allclose(decision.plan[:, 0] - [-1.0, *decision.plan[:-1, 0]], decision.changes[:, 0])


@EITHER
def test_moves_made_by_hand_count_in_the_window():
    problem = tank_problem(identified_tank())
    rules = mampc.MoveRules(max_moves=2, sparsity_horizon=4)
    regulator = mampc.Regulator(mampc.MAMPC(problem, rules))
    state, y = regulator.initial_state(), problem.model.y_op
    for u in ([51.0, 50.0], [51.0, 52.0]):
        state = regulator.step(state, y, y, u_applied=u, manual=[True, True]).state
    decision = regulator.step(state, y, y + 5.0, u_applied=[51.0, 52.0])
    assert not decision.moves.any()


@EITHER
@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=0.2)])
@pytest.mark.parametrize("fault", ["saturated", "stuck", "late"])
def test_what_the_actuators_really_did_is_told_and_leaves_no_offset(rules, fault):
    problem = tank_problem(identified_tank(), prediction_horizon=20)
    model = problem.model
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    regulator = mampc.Regulator(controller)
    state, x, applied, wanted = regulator.initial_state(), np.zeros(4), model.u_op, model.u_op
    reference, y = model.y_op + np.array([1.0, -1.0]), model.y_op
    for k in range(300):
        y = model.y_op + model.C @ x
        decision = regulator.step(state, y, reference, u_applied=applied)
        state, last, wanted = decision.state, wanted, decision.u
        applied = wanted
        if fault == "saturated" and k < 100:
            applied = np.minimum(wanted, model.u_op + 0.5)
        if fault == "stuck" and 5 <= k < 100:
            applied = np.array([model.u_op[0], wanted[1]])
        if fault == "late":
            applied = last
        x = model.A @ x + model.B @ (applied - model.u_op)
    error = np.abs(y - reference)
    assert (error < (1e-3 if rules is None else 0.5)).all()
