"""Plain MPC: the optimum of the tracking problem, and a step that survives any data."""

import copy
import pickle
from collections import Counter
from functools import cache

import cvxpy as cp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import mampc
from builders import (
    cost_of,
    fading,
    predicted,
    random_model,
    random_weight,
    same_decision,
    tank_problem,
    violation_scale,
)
from mampc import Status
from seeds import seeds

SEEDS = range(200)
TIGHT = {"tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12, "tol_feas": 1e-12}


@cache
def random_case(seed):
    """A problem whose limits are often active, and one sample's data."""
    rng = np.random.default_rng(seed)
    n, m, l = (int(size) for size in rng.integers(1, (5, 4, 4)))
    n_p = int(rng.integers(1, 9))
    model = random_model(seed, n, m, l, feedthrough=rng.random() < 0.4, radius=rng.choice([0.5, 0.9, 1.05]))
    u_previous = model.u_op + rng.uniform(-0.5, 0.5, m)
    limits = mampc.Limits(
        u_min=u_previous - rng.uniform(0.1, 1, m) if rng.random() < 0.7 else None,
        u_max=u_previous + rng.uniform(0.1, 1, m) if rng.random() < 0.7 else None,
        du_max=rng.uniform(0.05, 0.5, m) if rng.random() < 0.5 else None,
        y_min=model.y_op - rng.uniform(0.3, 2, l) if rng.random() < 0.4 else None,
        y_max=model.y_op + np.where(rng.random(l) < 0.7, rng.uniform(0.3, 2, l), np.inf)
        if rng.random() < 0.4
        else None,
    )
    problem = mampc.TrackingProblem(
        model,
        prediction_horizon=n_p,
        control_horizon=int(rng.integers(1, n_p + 1)),
        output_weight=random_weight(rng, l),
        move_weight=random_weight(rng, m, low=0.05),
        limits=limits,
        output_limit_weight=float(rng.uniform(1, 50)),
    )
    disturbed = rng.random() < 0.5
    return problem, {
        "x": rng.standard_normal(n),
        "u_previous": u_previous,
        "reference": model.y_op + rng.standard_normal((n_p + 1, l) if rng.random() < 0.5 else l),
        "input_disturbance": rng.uniform(-0.3, 0.3, m) if disturbed else np.zeros(m),
        "output_disturbance": rng.uniform(-0.3, 0.3, l) if disturbed else np.zeros(l),
    }


def decide(problem, sample):
    mpc = mampc.MPC(problem)
    arguments = {name: value for name, value in sample.items() if name != "u_previous"}
    return mpc.step(mpc.initial_state(sample["u_previous"]), **arguments)


def by_cvxpy(problem, x, u_previous, reference, input_disturbance, output_disturbance):
    """The plan and its cost, from the problem as `TrackingProblem` states it, states as variables."""
    model, limits = problem.model, problem.limits
    n_p, n_c = problem.prediction_horizon, problem.control_horizon
    U = cp.Variable((n_c, model.n_inputs))
    X = cp.Variable((n_p + 1, model.n_states))
    e = cp.Variable(model.n_outputs, nonneg=True)
    held = np.eye(n_c)[np.minimum(np.arange(n_p + 1), n_c - 1)]
    V = held @ U + np.tile(input_disturbance - model.u_op, (n_p + 1, 1))
    Y = X @ model.C.T + V @ model.D.T + np.tile(model.y_op + output_disturbance, (n_p + 1, 1))
    change = np.eye(n_c) - np.eye(n_c, k=-1)
    dU = change @ U - np.outer(np.eye(n_c)[0], u_previous)
    error = np.broadcast_to(reference, (n_p + 1, model.n_outputs)) - Y
    cost = cp.sum_squares(error @ np.linalg.cholesky(problem.output_weight))
    cost += cp.sum_squares(dU @ np.linalg.cholesky(problem.move_weight))
    constraints = [
        X[0] == x,
        X[1:] == X[:-1] @ model.A.T + V[:-1] @ model.B.T,
        *within(U, limits.u_min, limits.u_max),
        *within(dU, -limits.du_max, limits.du_max),
        *within(
            Y[1:], limits.y_min, limits.y_max, fading(n_p)[:, None] @ cp.reshape(e, (1, e.size), order="C")
        ),
    ]
    scaled = cp.multiply(violation_scale(problem), e)
    cost += problem.output_limit_weight * (cp.sum(scaled) + cp.sum_squares(scaled) / 2)
    program = cp.Problem(cp.Minimize(cost), constraints)
    program.solve(solver=cp.CLARABEL, **TIGHT)
    return U.value, program.value


def within(rows, low, high, slack=0.0):
    """Constraints low - slack <= rows <= high + slack for the finite limits per column."""
    for sign, limit in ((-1, low), (1, high)):
        finite = np.flatnonzero(np.isfinite(limit))
        if finite.size:
            limits = np.tile(np.where(np.isfinite(limit), limit, 0.0), (rows.shape[0], 1))
            yield (sign * (rows - limits) - slack)[:, finite] <= 0


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("seed", seeds(200, quick=25))
def test_the_decision_is_the_optimum_found_by_an_independent_solver(seed):
    problem, sample = random_case(seed)
    decision = decide(problem, sample)
    plan, objective = by_cvxpy(problem, **sample)
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(objective, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(decision.plan, plan, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", seeds(200, quick=25))
def test_a_decision_certifies_itself_and_keeps_its_limits(seed):
    problem, sample = random_case(seed)
    decision, limits = decide(problem, sample), problem.limits
    assert decision.objective == decision.lower_bound
    assert decision.gap == 0.0
    assert decision.objective == pytest.approx(cost_of(problem, plan=decision.plan, **sample), rel=1e-8)
    np.testing.assert_array_equal(decision.u, decision.plan[0])
    assert (decision.plan >= limits.u_min).all()
    assert (decision.plan <= limits.u_max).all()
    changes = np.diff(np.vstack([sample["u_previous"], decision.plan]), axis=0)
    np.testing.assert_allclose(decision.changes, changes, atol=1e-8)
    assert (np.abs(changes) <= limits.du_max + 1e-8).all()


def test_the_random_cases_meet_every_kind_of_limit_often():
    met = Counter()
    for seed in SEEDS:
        problem, sample = random_case(seed)
        decision, limits = decide(problem, sample), problem.limits
        disturbances = sample["input_disturbance"], sample["output_disturbance"]
        y = predicted(
            problem.model, sample["x"], decision.plan, problem.prediction_horizon + 1, *disturbances
        )
        y_margin = np.minimum(limits.y_max - y, y - limits.y_min)[1:].min()
        met["u"] += np.minimum(limits.u_max - decision.plan, decision.plan - limits.u_min).min() < 1e-7
        met["du"] += (limits.du_max - np.abs(decision.changes)).min() < 1e-7
        met["y kept"] += abs(y_margin) < 1e-7
        met["y violated"] += y_margin < -1e-5
        met["none"] += decision.iterations == 0
    assert min(met.values()) >= 15, met
    assert len(met) == 5


@pytest.mark.parametrize("feedthrough", [False, True])
def test_without_limits_and_with_long_horizons_the_first_move_is_that_of_the_infinite_horizon(feedthrough):
    Q, R = np.diag([1.0, 0.5]), np.diag([0.2, 0.4])
    model = random_model(8, n=4, feedthrough=feedthrough)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=80, control_horizon=80, output_weight=Q, move_weight=R
    )
    x, u_previous = np.array([1.0, -2.0, 0.5, 1.5]), model.u_op + np.array([0.5, -1.0])
    reference = model.y_op + np.array([2.0, 1.0])
    mpc = mampc.MPC(problem)
    u = mpc.step(mpc.initial_state(u_previous), x, reference).u

    u_rest = np.linalg.solve(model.dc_gain(), reference - model.y_op)
    x_rest = np.linalg.solve(np.eye(4) - model.A, model.B @ u_rest)
    A = np.block([[model.A, model.B], [np.zeros((2, 4)), np.eye(2)]])  # of (x - x_rest, u_prev - u_rest)
    B = np.vstack([model.B, np.eye(2)])
    C, D = np.hstack([model.C, model.D]), model.D
    H, cross = D.T @ Q @ D + R, C.T @ Q @ D
    P = solve_discrete_are(A, B, C.T @ Q @ C, H, s=cross)
    move = -np.linalg.solve(B.T @ P @ B + H, B.T @ P @ A + cross.T) @ np.concatenate(
        [x - x_rest, u_previous - model.u_op - u_rest]
    )
    np.testing.assert_allclose(u, u_previous + move, rtol=0, atol=1e-6)


@pytest.fixture
def limited():
    """A controller of the tank whose limits are active, and arguments for its step."""
    problem = tank_problem(limits=mampc.Limits(u_min=0.0, u_max=52.0, du_max=1.5, y_max=33.0))
    return mampc.MPC(problem), (np.array([0.1, -0.2, 0.05, 0.1]), problem.model.y_op + np.array([1.0, 0.5]))


def test_a_step_is_pure(limited):
    mpc, (x, reference) = limited
    state = mpc.initial_state()
    kept = copy.deepcopy((state, x, reference))
    first = mpc.step(state, x, reference)
    mpc.step(first.state, -x, reference - 3.0)
    assert same_decision(first, mpc.step(state, x, reference))
    np.testing.assert_array_equal(state.inputs, kept[0].inputs)
    assert state.samples == kept[0].samples
    np.testing.assert_array_equal(x, kept[1])
    np.testing.assert_array_equal(reference, kept[2])


def test_a_decision_does_not_change_when_later_ones_are_made(limited):
    mpc, (x, reference) = limited
    decision = mpc.step(mpc.initial_state(), x, reference)
    kept = copy.deepcopy(decision)
    for scale in (-1.0, 0.0, 5.0):
        mpc.step(decision.state, scale * x, reference)
    assert same_decision(decision, kept)
    np.testing.assert_array_equal(decision.state.inputs, kept.state.inputs)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_a_copied_controller_decides_the_same(limited, duplicate):
    mpc, arguments = limited
    decision = mpc.step(mpc.initial_state(), *arguments)
    twin = duplicate(mpc)
    copied = twin.step(duplicate(mpc.initial_state()), *arguments)
    np.testing.assert_allclose(copied.plan, decision.plan, atol=1e-12)
    assert copied.status is decision.status
    assert same_decision(duplicate(decision), decision)


def with_entry(array, value):
    changed = array.copy()
    changed.flat[-1] = value
    return changed


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["x", "reference", "preview"])
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_numbers_that_are_not_finite_hold_the_inputs_and_the_next_step_is_right(limited, where, bad):
    mpc, (x, reference) = limited
    state = mpc.initial_state([40.0, 51.0])
    expected = mpc.step(state, x, reference)
    preview = np.tile(reference, (11, 1))
    arguments = {
        "x": (with_entry(x, bad), reference),
        "reference": (x, with_entry(reference, bad)),
        "preview": (x, with_entry(preview, bad)),
    }[where]
    held = mpc.step(state, *arguments)
    assert held.status is Status.HELD_BAD_MEASUREMENT
    assert held.held
    np.testing.assert_array_equal(held.plan, np.tile([40.0, 51.0], (5, 1)))
    assert not held.moves.any()
    assert np.isnan(held.objective)
    assert held.lower_bound == -np.inf
    after = mpc.step(held.state, x, reference)
    np.testing.assert_allclose(after.plan, expected.plan, atol=1e-9)
    assert after.status is Status.OPTIMAL


@pytest.mark.parametrize("limits", [mampc.Limits(u_min=0, u_max=100), mampc.Limits(du_max=3.0, y_max=40.0)])
@pytest.mark.parametrize("size", [5e-324, 1e-310, 1e15, 1e30, 1e60, 1e100, 1e149, 1e155, 1e200, 1e290])
@pytest.mark.filterwarnings("error")
def test_tiny_and_huge_numbers_never_give_inputs_that_are_not_finite_or_out_of_range(limits, size):
    mpc = mampc.MPC(tank_problem(limits=limits))
    rest, reference, limits = np.zeros(4), mpc.problem.model.y_op, mpc.problem.limits
    state = mpc.initial_state()
    for x, r in ((size, reference), (-size, reference), (0.0, reference + size), (0.0, reference - size)):
        decision = mpc.step(state, rest + x, r)
        assert np.isfinite(decision.plan).all()
        assert (decision.plan >= limits.u_min).all()
        assert (decision.plan <= limits.u_max).all()
        np.testing.assert_allclose(mpc.step(state, rest, reference).plan, 50.0, atol=1e-9)


@pytest.mark.parametrize("u_previous", [[120.0, 50.0], [-30.0, 130.0]])
def test_move_limits_that_contradict_the_input_range_still_give_inputs_within_the_range(u_previous):
    mpc = mampc.MPC(tank_problem(limits=mampc.Limits(u_min=0.0, u_max=100.0, du_max=1.0)))
    model = mpc.problem.model
    decision = mpc.step(mpc.initial_state(u_previous), np.zeros(4), model.y_op)
    assert decision.status is Status.FEASIBLE
    assert (decision.plan >= 0.0).all()
    assert (decision.plan <= 100.0).all()
    inputs = np.vstack([u_previous, decision.plan])
    np.testing.assert_allclose(decision.changes, np.diff(inputs, axis=0), atol=1e-9)
    expected = cost_of(mpc.problem, np.zeros(4), u_previous, model.y_op, decision.plan)
    assert decision.objective == pytest.approx(expected, rel=1e-9)
    after = mpc.step(decision.state, np.zeros(4), model.y_op)
    assert after.status is Status.OPTIMAL
    assert (np.abs(after.changes) <= 1.0 + 1e-9).all()


def test_inputs_outside_their_range_come_back_at_once_without_move_limits():
    mpc = mampc.MPC(tank_problem())
    decision = mpc.step(mpc.initial_state([120.0, -5.0]), np.zeros(4), mpc.problem.model.y_op)
    assert decision.status is Status.OPTIMAL
    assert (decision.plan >= 0.0).all()
    assert (decision.plan <= 100.0).all()
    np.testing.assert_allclose(decision.changes[0], decision.u - [120.0, -5.0], atol=1e-9)


@pytest.mark.parametrize("x", [np.zeros(3), np.zeros((1, 4)), 0.0])
def test_a_state_of_the_wrong_shape_raises(limited, x):
    mpc, (_, reference) = limited
    with pytest.raises(mampc.MampcError, match=r"x: expected shape.*received"):
        mpc.step(mpc.initial_state(), x, reference)


@pytest.mark.parametrize("name", ["input_disturbance", "output_disturbance"])
@pytest.mark.parametrize("value", [np.zeros(3), np.zeros((2, 2)), "load"], ids=str)
def test_a_disturbance_of_the_wrong_shape_raises(limited, name, value):
    mpc, arguments = limited
    with pytest.raises(mampc.MampcError, match=r"expected.*received"):
        mpc.step(mpc.initial_state(), *arguments, **{name: value})


@pytest.mark.parametrize("shape", [(3,), (10, 2), (1, 2), ()])
def test_a_reference_of_the_wrong_shape_raises(limited, shape):
    mpc, (x, _) = limited
    with pytest.raises(mampc.MampcError, match=r"reference: expected shape.*received"):
        mpc.step(mpc.initial_state(), x, np.zeros(shape))


@pytest.mark.parametrize("excess", [1e-3, 1e-6, 1e-8])
def test_an_optimum_that_breaks_a_limit_ever_so_slightly_is_not_taken(excess):
    free = mampc.MPC(tank_problem(limits=mampc.Limits()))
    x, reference = np.zeros(4), free.problem.model.y_op + np.array([2.0, 1.0])
    u_max = free.step(free.initial_state(), x, reference).plan.max(axis=0) - excess
    mpc = mampc.MPC(tank_problem(limits=mampc.Limits(u_max=u_max)))
    decision = mpc.step(mpc.initial_state(), x, reference)
    assert decision.iterations > 0
    np.testing.assert_allclose(decision.plan.max(axis=0), u_max, rtol=0, atol=1e-10)
    np.testing.assert_allclose(50.0 + np.cumsum(decision.changes, axis=0), decision.plan, rtol=0, atol=1e-10)


def test_where_no_limit_is_active_a_step_repeats_to_the_last_bit():
    mpc = mampc.MPC(tank_problem())
    state, x, reference = mpc.initial_state(), np.array([0.3, -0.2, 0.1, 0.4]), mpc.problem.model.y_op + 1.0
    first = mpc.step(state, x, reference)
    mpc.step(state, 100 * x, reference)
    assert same_decision(first, mpc.step(state, x, reference), atol=0.0)
