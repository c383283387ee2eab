"""Zones: what outputs in and beside them cost, against independent programs, in every method and loop."""

import warnings
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import mampc
from builders import cost_of, distance, predicted, random_model
from mampc import Status
from mampc.base.words import Remark
from mampc.methods import local_search
from mampc.methods.exact import sample_problem, search, zone_search
from mampc.methods.exact.relaxation import Relaxation
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.exact.terms import Squares
from mampc.methods.exact.zone_search import single_moves
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import Incumbent, PatternSolver
from mampc.program import least_distance
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver
from referees import (
    assert_best_of_all_patterns,
    best_on,
    objective_of,
    program_of,
    scip_bounds,
)
from seeds import examples

INF = np.inf
PLAIN = mampc.MoveRules()


def random_problem(seed, **changes):
    """A problem with zones of all kinds, one-sided ones among them, some with limits; a state and a reference."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, m=2, l=2, feedthrough=seed % 5 == 0)
    limits = mampc.Limits()
    if seed % 2:
        limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1)
    if seed % 6 == 1:
        limits = replace(limits, y_max=model.y_op + 1.5)
    settings = {
        "prediction_horizon": 7, "control_horizon": 3, "limits": limits, "output_weight": rng.uniform(0.5, 2, 2),
        "zone_below": [0.5, [0.3, 0.0, INF][seed % 3]], "zone_above": [[0.2, INF][seed % 2], [0.1, 0.0][seed % 2]],
    }  # fmt: skip
    problem = mampc.TrackingProblem(model, **settings | changes)
    return problem, rng.standard_normal(model.n_states), model.y_op + 2 * rng.standard_normal(2), rng


def sampled(problem, x, reference):
    condensed = CondensedQP(problem)
    u = problem.model.u_op
    return condensed, condensed.sample(condensed.parameter.vector(x, u, reference), u)


def by_cvxpy(problem, x, low, high, pattern):
    """The least cost on a pattern (nc, m) from the operating point, as squared distances to zones; without y limits."""
    model, limits, n_c = problem.model, problem.limits, problem.control_horizon
    d, kept, cost = cp.Variable((n_c, model.n_inputs)), [], 0.0
    u = [model.u_op + cp.sum(d[: j + 1], axis=0) for j in range(n_c)]
    for j in range(n_c):
        cost += cp.quad_form(d[j], cp.psd_wrap(problem.move_weight))
        kept += [d[j, a] == 0 for a in np.flatnonzero(~pattern[j])]
        kept += [u[j][a] <= limits.u_max[a] for a in np.flatnonzero(np.isfinite(limits.u_max))]
        kept += [u[j][a] >= limits.u_min[a] for a in np.flatnonzero(np.isfinite(limits.u_min))]
    for i in range(problem.prediction_horizon + 1):
        at = u[min(i, n_c - 1)] - model.u_op
        y = model.y_op + model.C @ x + model.D @ at
        for k, weight in enumerate(np.diag(problem.output_weight)):
            below = low[k] - y[k] if np.isfinite(low[k]) else -1.0
            above = y[k] - high[k] if np.isfinite(high[k]) else -1.0
            cost += weight * cp.square(cp.pos(cp.maximum(below, above)))
        x = model.A @ x + model.B @ at
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return cp.Problem(cp.Minimize(cost), kept).solve(solver=cp.CLARABEL)


@pytest.mark.parametrize("seed", [s for s in range(6) if s % 6 != 1])
def test_the_program_on_a_pattern_is_that_of_squared_distances(seed):
    problem, x, reference, rng = random_problem(seed)
    condensed, sample = sampled(problem, x, reference)
    solver = PatternSolver(condensed, AdmissiblePatterns(PLAIN, 2, 3))
    for _ in range(2):
        pattern = rng.random((3, 2)) < 0.6
        found = solver.solve(sample, pattern.ravel())
        plan = problem.model.u_op + found.moves.reshape(3, 2).cumsum(axis=0)
        cost = cost_of(problem, x, problem.model.u_op, reference, plan)
        assert found.objective == pytest.approx(cost, rel=1e-9, abs=1e-12)
        ends = reference - problem.zone_below, reference + problem.zone_above
        assert found.objective == pytest.approx(by_cvxpy(problem, x, *ends, pattern), rel=1e-6, abs=1e-7)


@pytest.mark.parametrize(
    "rules",
    [
        mampc.MoveRules(price=0.2), mampc.MoveRules(max_moves=2), mampc.MoveRules(price=0.05, counting="simultaneous"),
        mampc.MoveRules(price=0.1, dwell=2, max_moves_per_step=1), mampc.MoveRules(price=0.1, min_size=0.2),
    ],
    ids=str,
)  # fmt: skip
def test_the_exact_optimum_is_that_of_brute_force(rules):
    for seed in range(examples(3 if rules.min_size else 6, quick=2)):
        problem, x, reference, _ = random_problem(seed)
        assert_best_of_all_patterns(problem, rules, x, reference)


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("seed", range(1, 5))
def test_single_moves_cost_at_least_what_is_said_and_without_limits_just_that(seed, limited):
    changes = {} if limited else {"limits": mampc.Limits()}
    problem, x, reference, _ = random_problem(seed, zone_pull=0.1 * (seed % 2), **changes)
    condensed, sample = sampled(problem, x, reference)
    admissible, past = AdmissiblePatterns(mampc.MoveRules(price=0.1), 2, 3), problem.model.u_op[None]
    squares, solver = Squares(condensed, np.arange(6)), PatternSolver(condensed, admissible)
    relaxation = Relaxation(condensed, squares.order, squares.L[:, :-1])
    at = SampleProblem(
        squares, relaxation, admissible, solver, sample, admissible.allowance(past), Incumbent(), np.inf
    )
    best = [solver.solve(sample, row).objective for row in np.eye(6, dtype=bool)]
    said = single_moves(at)
    assert (said <= np.multiply(best, 1 + 1e-9)).all()
    if not limited:
        np.testing.assert_allclose(said, best, rtol=1e-9)


def test_single_moves_are_tried_no_longer_than_there_is_time(monkeypatch):
    problem, x, reference, _ = random_problem(2)
    near = problem.model.y_op + 0.01 * (reference - problem.model.y_op)
    tried, offer = [], SampleProblem.offer
    monkeypatch.setattr(SampleProblem, "offer", lambda *of: tried.append(1) or offer(*of))
    monkeypatch.setattr(zone_search, "single_moves", lambda at: np.zeros(len(at.order)))
    monkeypatch.setattr(SampleProblem, "late", property(lambda _: len(tried) > 3))
    controller = mampc.MAMPC(problem, mampc.MoveRules(price=0.1))
    decision = controller.step(controller.initial_state(), x, near)
    assert decision.status is Status.TIME_LIMIT
    assert decision.lower_bound <= decision.objective
    assert len(tried) == 4


@pytest.mark.parametrize("limit", [1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0])
def test_no_program_begins_after_the_time_limit(limit, monkeypatch):
    """On a clock that each program puts on by one: those in a row check it as often as they are solved."""
    now, bounds, solve_anew = [0.0], [], DaqpSolver.solve_anew

    def solved(*of):
        now[0] += 1.0
        return solve_anew(*of)

    for module in (local_search, least_distance, sample_problem, search):
        monkeypatch.setattr(module, "perf_counter", lambda: now[0])
    monkeypatch.setattr(DaqpSolver, "solve_anew", solved)
    for seed in range(6):
        problem, x, reference, _ = random_problem(seed, control_horizon=6)
        rules = mampc.MoveRules(price=0.05, max_moves=4)
        controller = mampc.MAMPC(problem, rules, method=mampc.Exact(time_limit=limit))
        now[0] = 0.0
        decision = controller.step(controller.initial_state(), x, reference)
        assert now[0] <= limit
        assert decision.lower_bound <= decision.objective
        bounds.append(decision.status is Status.TIME_LIMIT)
    assert any(bounds) or limit > 6


def test_the_exact_optimum_is_that_of_scip():
    problem, x, reference, _ = random_problem(3, control_horizon=4)
    rules = mampc.MoveRules(price=0.2)
    sparse = mampc.MAMPC(problem, rules)
    low, high = scip_bounds(problem, rules, x, problem.model.u_op, reference, 20.0)
    objective = sparse.step(sparse.initial_state(), x, reference).objective
    assert low - 1e-6 <= objective <= high + 1e-6


@pytest.mark.parametrize("method", mampc.METHODS)
def test_every_method_plans_with_zones_and_can_be_certified(method):
    settings = {} if method == "exact" else {"certify": True}
    if method == "alternating":
        settings |= {"warm_up": 0}
    rules = mampc.MoveRules(price=0.1, max_moves=4, sparsity_horizon=2)
    for seed in range(4):
        problem, x, reference, _ = random_problem(seed)
        sparse = mampc.MAMPC(problem, rules, method=method, **settings)
        exact = mampc.MAMPC(problem, rules)
        best = exact.step(exact.initial_state(), x, reference).objective
        decision = sparse.step(sparse.initial_state(), x, reference)
        cost = objective_of(problem, rules, x, sparse.initial_state().inputs, reference, decision.plan)
        assert decision.objective == pytest.approx(cost, rel=1e-8)
        assert decision.lower_bound == pytest.approx(best, rel=1e-8)
        assert decision.objective >= best * (1 - 1e-9)


def test_local_search_is_near_the_optimum():
    gaps = []
    for seed in range(30):
        problem, x, reference, _ = random_problem(seed)
        greedy = mampc.MAMPC(problem, mampc.MoveRules(price=0.2), method="greedy", certify=True)
        gaps.append(greedy.step(greedy.initial_state(), x, reference).gap)
    assert np.median(gaps) < 0.01


def test_a_set_point_is_a_zone_of_width_zero():
    for seed in range(10):
        problem, x, reference, _ = random_problem(seed)
        point = mampc.TrackingProblem(
            problem.model, prediction_horizon=7, control_horizon=3, limits=problem.limits,
            output_weight=problem.output_weight,
        )  # fmt: skip
        expected, zones = mampc.MPC(point), mampc.MPC(problem)
        expected = expected.step(expected.initial_state(), x, reference)
        decision = zones.step(zones.initial_state(), x, mampc.Zone(reference, reference))
        np.testing.assert_allclose(decision.plan, expected.plan, atol=1e-8)
        assert decision.objective == pytest.approx(expected.objective, rel=1e-9)


def test_a_tail_is_nearly_that_of_a_set_point_where_the_zone_has_width_zero():
    for seed in range(6):
        problem, x, reference, _ = random_problem(seed, tail_horizon=9.0)
        point = replace(problem, zone_below=0.0, zone_above=0.0)
        expected, zones = mampc.MPC(point), mampc.MPC(problem)
        expected = expected.step(expected.initial_state(), x, reference)
        decision = zones.step(zones.initial_state(), x, mampc.Zone(reference, reference))
        assert decision.objective == pytest.approx(expected.objective, rel=0.05)


def test_the_tail_counts_means_over_doubling_pieces_of_it():
    for seed in range(6):
        L = 5.0
        problem, x, reference, _ = random_problem(seed, tail_horizon=L)
        mpc = mampc.MPC(problem)
        decision = mpc.step(mpc.initial_state(), x, reference)
        n_p, gamma = problem.prediction_horizon, L / (1 + L)
        y = predicted(problem.model, x, decision.plan, n_p + 400)
        cost = cost_of(problem, x, problem.model.u_op, reference, decision.plan)
        for start, stop in ((1, 2), (2, 4), (4, 8), (8, 16), (16, 32), (32, 390)):
            weights, piece = gamma ** np.arange(start, stop), slice(n_p + start, n_p + stop)
            of_mean = distance(problem, weights @ y[None, piece] / weights.sum(), reference)[0] ** 2
            of_each = weights @ distance(problem, y[piece], reference) ** 2  # as set points count
            each = np.where(problem.zoned, weights.sum() * of_mean, of_each)
            cost += each @ np.diag(problem.output_weight)
        assert decision.objective == pytest.approx(cost, rel=1e-8)


def test_where_no_move_helps_none_is_made_though_none_has_a_price():
    """An output outside its zone comes back by itself at the next sample."""
    problem = mampc.TrackingProblem(
        mampc.StateSpace([[0.5]], [[1.0]], [[1.0]], None, 1.0), prediction_horizon=8, control_horizon=4,
        zone_below=0.6, zone_above=0.6,
    )  # fmt: skip
    controller = mampc.MAMPC(problem, mampc.MoveRules(max_moves=3, sparsity_horizon=1))
    decision = controller.step(controller.initial_state(), [1.0], [0.0])
    assert decision.status is Status.OPTIMAL
    assert not decision.moves.any()


def test_zones_may_move_at_run_time_also_ahead():
    problem, x, reference, rng = random_problem(4)
    mpc, n_p = mampc.MPC(problem), problem.prediction_horizon
    usual = mpc.step(mpc.initial_state(), x, reference)
    same = mampc.Zone(reference - problem.zone_below, reference + problem.zone_above)
    given = mpc.step(mpc.initial_state(), x, same)
    assert given.objective == usual.objective
    np.testing.assert_array_equal(given.plan, usual.plan)
    low = reference + rng.uniform(-1, 0, (n_p + 1, 2))
    ahead = mampc.Zone(low, low + rng.uniform(0, 1, (n_p + 1, 2)))
    decision = mpc.step(mpc.initial_state(), x, ahead)
    cost = cost_of(problem, x, problem.model.u_op, ahead, decision.plan)
    assert decision.objective == pytest.approx(cost, rel=1e-9)
    regulator = mampc.Regulator(mpc)
    assert regulator.step(regulator.initial_state(), problem.model.y_op, same).status is Status.OPTIMAL
    unknown = mampc.Zone([np.nan, 0.0], [1.0, 0.0])
    assert mpc.step(mpc.initial_state(), x, unknown).status is Status.HELD_BAD_MEASUREMENT


def test_limits_of_a_sample_and_inputs_in_manual_go_with_zones():
    for seed in range(6):
        problem, x, reference, _ = random_problem(2 * seed + 1)
        u = problem.model.u_op
        for controller in (mampc.MPC(problem), mampc.MAMPC(problem, mampc.MoveRules(price=0.1))):
            limits = mampc.Limits(u_min=u - 0.3, u_max=u + 0.3)
            decision = controller.step(
                controller.initial_state(), x, reference, limits=limits, manual=[True, False]
            )
            narrow = replace(
                problem, limits=replace(problem.limits, u_min=[u[0], u[1] - 0.3], u_max=[u[0], u[1] + 0.3])
            )
            other = (
                mampc.MPC(narrow)
                if isinstance(controller, mampc.MPC)
                else mampc.MAMPC(narrow, controller.rules)
            )
            expected = other.step(other.initial_state(), x, reference)
            assert decision.objective == pytest.approx(expected.objective, rel=1e-8)
            assert not decision.moves[:, 0].any()


@pytest.mark.parametrize(("u", "y"), [(1e-6, 1e3), (1e5, 1e-5), (1e-4, 1e-4)])
def test_units_decide_nothing(u, y):
    def decided(u, y, seed):
        rng = np.random.default_rng(seed)
        usual = random_model(seed, m=2, l=2)
        model = mampc.StateSpace(
            usual.A, usual.B / u, usual.C * y, usual.D * y / u, 1.0, usual.u_op * u, usual.y_op * y
        )
        problem = mampc.TrackingProblem(
            model, prediction_horizon=8, control_horizon=3, output_weight=1 / y**2, move_weight=0.1 / u**2,
            limits=mampc.Limits(u_min=model.u_op - u, u_max=model.u_op + u), tail_horizon=4.0,
            zone_below=[0.3 * y, INF], zone_above=0.1 * y,
        )  # fmt: skip
        sparse = mampc.MAMPC(problem, mampc.MoveRules(price=0.1))
        x, reference = rng.standard_normal(3), model.y_op + 2 * y * rng.standard_normal(2)
        decision = sparse.step(sparse.initial_state(), x, reference)
        assert decision.status is Status.OPTIMAL
        return decision.changes / u, decision.objective

    for seed in range(6):
        for usual, other in zip(decided(1.0, 1.0, seed), decided(u, y, seed), strict=True):
            np.testing.assert_allclose(other, usual, rtol=1e-6, atol=1e-7)


def test_small_move_weights_leave_the_optimum_what_it_is():
    for seed in range(3):
        for weight in (1e-4, 1e-7):
            problem, x, reference, _ = random_problem(seed, move_weight=weight)
            mpc = mampc.MPC(problem)
            decision = mpc.step(mpc.initial_state(), x, reference)
            program = program_of(problem, x, problem.model.u_op, reference)
            best = best_on(program, np.ones(6, dtype=bool), len(program.f) - 6)
            cost = cost_of(problem, x, problem.model.u_op, reference, decision.plan)
            assert decision.objective == pytest.approx(cost, rel=1e-7, abs=1e-9)
            assert decision.objective <= best * (1 + 1e-6) + 1e-7


@pytest.mark.parametrize("unit", [1e-3, 1e3])
@pytest.mark.parametrize("rate", [-0.1, -1.4])
def test_outputs_that_run_far_away_from_their_zones_leave_the_optimum_what_it_is(rate, unit):
    """A triple integrator: over a long horizon its errors are some 1e5 times what moves cost; with a limit too."""
    model = mampc.StateSpace(
        [[1, 1, 0.5], [0, 1, 1], [0, 0, 1]], [[1 / 6], [0.5], [1]], [[unit, 0, 0]], None, 1.0
    )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=110, control_horizon=4, output_weight=unit**-2, move_weight=1.0,
        limits=mampc.Limits(u_min=-0.1, u_max=0.1, y_min=-0.5 * unit if unit > 1 else None),
        zone_below=0.03 * unit, zone_above=0.03 * unit,
    )  # fmt: skip
    controller, x = mampc.MAMPC(problem, mampc.MoveRules(max_moves=1)), np.array([0.1, -0.35, rate])
    decision = controller.step(controller.initial_state(), x, np.zeros(1))

    def cost(size, sample):
        plan = np.where(np.arange(4) >= sample, size, 0.0)[:, None]
        return cost_of(problem, x, np.zeros(1), np.zeros(1), plan)

    best = min(
        found
        for sample in range(4)
        for found in (
            minimize_scalar(
                cost, bounds=(-0.1, 0.1), method="bounded", args=(sample,), options={"xatol": 1e-12}
            ).fun,
            cost(0.1, sample),
        )
    )
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_plant_that_runs_away_from_its_zone_is_proven_no_further_than_rounding_lets_it(seed):
    rng = np.random.default_rng(seed)
    model = mampc.StateSpace([[1.2, 0], [0, 0.6]], rng.uniform(-1, 1, (2, 2)), [[1.0, 1.0]], None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=105, control_horizon=3, move_weight=1.0, limits=mampc.Limits(du_max=9.0),
        zone_below=0.1, zone_above=0.1,
    )  # fmt: skip
    with pytest.warns(mampc.MampcWarning, match="grow"):
        controller = mampc.MAMPC(problem, mampc.MoveRules(max_moves=2 + seed % 2))
    x = np.zeros(2)
    decision = controller.step(controller.initial_state(), x, np.ones(1))
    state, cost = x.astype(np.longdouble), np.sum(np.square(decision.changes.astype(np.longdouble)))
    for i in range(106):
        y = (model.C.astype(np.longdouble) @ state)[0]
        cost += np.maximum(abs(y - 1) - np.longdouble(0.1), 0) ** 2
        state = model.A.astype(np.longdouble) @ state + model.B @ decision.plan[min(i, 2)].astype(
            np.longdouble
        )
    assert decision.lower_bound <= cost
    assert abs(decision.objective - cost) <= max(decision.gap * cost, 1e-9 * cost)
    assert Remark.ROUNDING in decision.remarks
