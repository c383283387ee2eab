"""What is proven holds at any conditioning: against brute force in 120 digits."""

import warnings

import numpy as np
import pytest

import mampc
from conditioned import MPMATH, Referee, case_of
from mampc import Status
from mampc.base.words import Remark
from mampc.methods.exact import ranking
from mampc.program import refinement
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver, active_bounds
from mampc.program.least_distance import LeastDistance, Nearest, ViolationCost
from mampc.program.qp import QPSolution, QPStatus
from mampc.program.refinement import refined
from referees import charge
from seeds import seeds


def decided(case, method="exact", **settings):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mampc.MampcWarning)
        controller = mampc.MAMPC(case.problem, case.rules, method=method, **settings)
    return controller.step(controller.initial_state(case.past), case.x, case.reference)


@pytest.mark.parametrize(
    ("seed", "moves_limited"),
    [*((seed, False) for seed in (*range(30), 1106, 2425)), *((seed, True) for seed in range(10))],
)
def test_proven_optima_are_those_of_brute_force_in_120_digits(seed, moves_limited):
    holds(case_of(seed, moves_limited=moves_limited))


@pytest.mark.parametrize("seed", [237, 432, 452, 527, *seeds(400, quick=10)])
def test_the_tree_proves_no_more_than_the_table(seed, monkeypatch):
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)
    holds(case_of(seed))


# Conditions of 7e7 to 1e11; in some the relaxed programs of the tree have active limits and no digits to spare.
@pytest.mark.parametrize("seed", [20287, 40355, 41311, 20031, 20072, 20391])
def test_the_tree_proves_what_the_table_proves_where_normal_equations_have_no_digits(seed, monkeypatch):
    case = case_of(seed, moves_limited=seed % 4 == 3)
    assert decided(case).status is Status.OPTIMAL
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)
    assert decided(case).status is Status.OPTIMAL
    holds(case)


@pytest.mark.slow
@pytest.mark.parametrize("moves_limited", [False, True])
@pytest.mark.parametrize("seed", range(30, 400))
def test_more_proven_optima_are_those_of_brute_force_in_120_digits(seed, moves_limited):
    holds(case_of(seed, moves_limited=moves_limited))


def holds(case):
    """What a decision promises about objective and bound, against the referee."""
    try:
        decision, referee = decided(case), Referee(case)
    except mampc.MampcError as error:  # said when the problem is made
        if "condition" not in str(error):
            raise
        return
    optimum = referee.optimum()
    if decision.status is Status.HELD_INFEASIBLE:
        assert optimum == np.inf
        return
    assert decision.lower_bound <= optimum * (1 + 1e-9)
    assert (decision.gap == 0) == (decision.status is Status.OPTIMAL)
    if decision.status is Status.OPTIMAL:
        assert abs(decision.objective - optimum) <= 1e-7 * optimum
        own = referee.cost(decision.plan) + charge(case.rules, decision.moves)
        assert abs(own - optimum) <= 1e-7 * optimum


@pytest.mark.parametrize("seed", seeds(10, quick=2))
def test_the_referee_finds_the_same_optimum_in_other_digits(seed):
    case = case_of(seed + 1)
    assert Referee(case).optimum() == Referee(case, MPMATH).optimum()


def double_integrator(n_p):
    model = mampc.StateSpace([[1, 1], [0, 1]], [[0.5], [1]], [[1, 0]], None, 1.0)
    return mampc.TrackingProblem(model, prediction_horizon=n_p, control_horizon=5)


@pytest.mark.parametrize(
    ("n_p", "objective"), [(50, 1.621156), (60, 1.622130), (100, 1.624228), (200, 1.625941)]
)
def test_a_long_horizon_on_a_double_integrator_costs_little_more(n_p, objective, monkeypatch):
    problem, rules = double_integrator(n_p), mampc.MoveRules(max_moves=3)
    for largest in (ranking.LARGEST_TABLE, 0):
        monkeypatch.setattr(ranking, "LARGEST_TABLE", largest)
        controller = mampc.MAMPC(problem, rules)
        decision = controller.step(controller.initial_state(), np.zeros(2), [1.0])
        assert decision.status is Status.OPTIMAL
        assert decision.objective == pytest.approx(objective, abs=1e-6)


def unstable(n_p, nc=3):
    model = mampc.StateSpace([[1.8, 0], [0, 0.6]], [[1.0], [0.5]], [[1.0, 1.0]], None, 1.0)
    return mampc.TrackingProblem(model, prediction_horizon=n_p, control_horizon=nc)


def test_a_prediction_that_enlarges_rounding_says_so_when_made_and_in_every_decision():
    with pytest.warns(mampc.MampcWarning, match="condition"):
        controller = mampc.MAMPC(unstable(40), mampc.MoveRules(max_moves=2))
    decision = controller.step(controller.initial_state(), [1.0, 1.0], [1.0])
    assert Remark.ROUNDING in decision.remarks
    assert decision.status is Status.FEASIBLE
    assert decision.gap > 0


@pytest.mark.parametrize("n_p", [20, 50, 200])
def test_an_ordinary_problem_has_no_warning_and_no_remark(n_p):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        controller = mampc.MAMPC(double_integrator(n_p), mampc.MoveRules(max_moves=2))
    decision = controller.step(controller.initial_state(), [0.1, 0.0], [1.0])
    assert not decision.remarks


@pytest.mark.parametrize("seed", [537, 1077])
def test_moves_that_rounding_cannot_tell_apart_do_not_end_a_search(seed):
    decision = decided(case_of(seed))
    assert np.isfinite(decision.u).all()
    assert decision.gap > 0 or decision.status is Status.OPTIMAL


def test_moves_that_nothing_determines_are_refused():
    with pytest.raises(mampc.MampcError, match="condition"):
        CondensedQP(unstable(200))


def test_a_refinement_takes_up_as_many_bounds_as_there_are():
    """Zones of many outputs over a long horizon have more of them active than other programs."""
    count = 130
    found = refined(
        np.eye(count), np.full(count, 3.0), np.eye(count), np.zeros(count), np.ones(count), np.zeros(count)
    )
    assert found is not None
    np.testing.assert_allclose(found.z, 1.0)


@pytest.mark.parametrize("seed", range(60))
def test_refined_programs_are_optimal_whatever_bounds_they_start_from(seed):
    """Random ill-conditioned least squares within bounds, rows that repeat others among them."""
    rng = np.random.default_rng(seed)
    k = int(rng.integers(1, 4))
    F = np.triu(rng.standard_normal((k, k))) @ np.diag(10.0 ** rng.uniform(-4, 4, k)) + 1e-3 * np.eye(k)
    A = np.vstack([np.eye(k), np.tri(k), rng.standard_normal((2, k))])
    feasible = rng.standard_normal(k)
    low, high = A @ feasible - rng.uniform(0, 1, len(A)), A @ feasible + rng.uniform(0, 1, len(A))
    c = F @ (feasible + 3 * rng.standard_normal(k))
    costs = []
    for pull in (np.zeros(len(A)), rng.choice([-1.0, 0.0, 1.0], len(A))):
        found = refined(F, c, A, low, high, pull)
        rows, slack = A @ found.z, 1e-9 * (1 + np.abs(A) @ np.abs(found.z))
        assert (rows >= low - slack).all()
        assert (rows <= high + slack).all()
        gradient = 2 * F.T @ (F @ found.z - c)
        balance = gradient + A.T @ found.multipliers
        assert np.abs(balance).max() <= 1e-7 * (1 + np.abs(F.T) @ np.abs(c)).max()
        at = np.where(found.multipliers > 0, high, low)
        assert (np.abs(rows - at)[found.multipliers != 0] <= slack[found.multipliers != 0]).all()
        costs.append(np.sum((F @ found.z - c) ** 2))
    assert costs[0] == pytest.approx(costs[1], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", [30622, 31397])
def test_a_step_finds_a_plan_where_rounding_hides_the_multipliers(seed):
    decision = decided(case_of(seed, moves_limited=seed % 4 == 3))
    assert not decision.held
    assert decision.gap > 0 or decision.status is Status.OPTIMAL


def test_bounds_that_nothing_keeps_have_no_optimum():
    A = np.array([[1.0, 0.0], [1.0, 0.0]])
    low, high = np.array([1.0, -3.0]), np.array([2.0, -1.0])
    assert refined(np.eye(2), np.zeros(2), A, low, high, np.zeros(2)) is None


@pytest.mark.parametrize("largest", [ranking.LARGEST_TABLE, 0], ids=["table", "tree"])
@pytest.mark.parametrize("seed", [3, 8, 9, 13, 14, 19])
def test_programs_without_an_answer_leave_a_gap_and_a_remark(seed, largest, monkeypatch):
    """Plans that rounding leaves unproven are told of, and what bounds these is kept."""
    monkeypatch.setattr(ranking, "LARGEST_TABLE", largest)
    case = case_of(seed)
    optimum = decided(case)
    solve, asked = LeastDistance.solve, []

    def now_and_then(self, *arguments):
        asked.append(self)
        nearest = solve(self, *arguments)
        if nearest.iterations and len(asked) % 2:
            return Nearest(None, np.inf, None, QPStatus.FAILED, nearest.iterations)
        return nearest

    monkeypatch.setattr(LeastDistance, "solve", now_and_then)
    decision = decided(case)
    if decision.held:
        assert decision.status is not Status.OPTIMAL
        return
    assert decision.lower_bound <= optimum.objective * (1 + 1e-9)
    if decision.status is Status.OPTIMAL:
        assert decision.objective == pytest.approx(optimum.objective, rel=1e-7)
    else:
        assert Remark.ROUNDING in decision.remarks
        assert decision.gap > 0
        assert decision.lower_bound > 0


@pytest.mark.parametrize("k", [0, 3])
def test_programs_far_from_zones_are_made_exact_in_few_rounds(k, monkeypatch):
    """Where the solver gives up, every value is outside its zone: such bounds are guessed at once."""
    rng, values, rounds = np.random.default_rng(k), 60, []
    rows = rng.standard_normal((values + k, k))
    rows[:k] = np.eye(k)
    violations = np.vstack([np.zeros((k, values)), -np.eye(values)])
    cost = ViolationCost(np.zeros(values), rng.uniform(0.5, 2.0, values))
    program = LeastDistance(np.triu(rng.uniform(1.0, 2.0, (k, k))), rows, violations, cost, n_simple=k)
    zone = np.sort(rng.choice([-1.0, 1.0], values) + rng.uniform(100.0, 101.0, (2, values)), axis=0)
    lower, upper = (
        np.concatenate([np.full(values, sign * np.inf), np.full(k, sign), end])
        for sign, end in ((-1.0, zone[0]), (1.0, zone[1]))
    )
    optimum = rng.uniform(-1.0, 1.0, k)
    expected = program.solve(optimum, lower, upper)
    failed, at = QPSolution(None, None, QPStatus.FAILED, 1), refinement._at
    monkeypatch.setattr(DaqpSolver, "solve_anew", lambda *data: failed)
    monkeypatch.setattr(refinement, "_at", lambda *data: rounds.append(0) or at(*data))
    found = program.solve(optimum, lower, upper)
    assert expected.status is found.status is QPStatus.OPTIMAL
    assert found.excess == pytest.approx(expected.excess, rel=1e-9)
    assert np.allclose(found.moves, expected.moves, atol=1e-6)
    assert len(rounds) <= 10


@pytest.mark.parametrize("seed", range(6))
def test_programs_solved_together_are_those_solved_one_by_one(seed):
    """Near and far, without an answer, and none after the deadline."""
    rng = np.random.default_rng(seed)
    k, v, b, K = 4, 1, 9, 7
    rows = np.vstack([np.eye(k), rng.standard_normal((b - k, k))])
    violations = np.vstack([np.zeros((b - 2, v)), -np.ones((2, v))])
    cost = ViolationCost(np.full(v, 10.0 * (seed % 2)), np.ones(v))
    program = LeastDistance(np.triu(rng.uniform(1, 2, (k, k))), rows, violations, cost, n_simple=k)
    optima = rng.standard_normal((K, k)) * 10.0 ** rng.uniform(-4, 4, (K, 1))
    high = rng.uniform(0.1, 1.0, (K, v + b))
    low = -high - np.where(np.arange(K)[:, None] == 3, 1.2, 0.0) * (np.arange(v + b) == v + 4)
    high[3, v + 4] = low[3, v + 4] + 1e-3  # out of reach of bounded moves, now and then
    low[:, :v], high[:, :v] = 0.0, np.inf
    bounds = np.hstack([low, high])
    distances = np.array([program.distances(*data) for data in zip(optima, bounds, strict=True)])
    alone = [program.solve_at(*data) for data in zip(optima, distances, bounds, strict=True)]
    active = [None if one.multipliers is None else active_bounds(one.multipliers) for one in alone]
    for starts in ([None] * K, active):
        found = program.solve_each(optima, distances, bounds, starts, np.inf)
        assert found.status == [one.status for one in alone]
        for moves, multipliers, one in zip(found.moves, found.multipliers, alone, strict=True):
            if one.moves is not None:
                np.testing.assert_allclose(moves, one.moves, rtol=1e-9, atol=1e-12)
                np.testing.assert_allclose(
                    multipliers, one.multipliers, rtol=1e-6, atol=1e-9 * np.abs(one.multipliers).max()
                )
    late = program.solve_each(optima, distances, bounds, active, -np.inf)
    assert set(late.status) == {QPStatus.TIME_LIMIT}
