"""The search tree: its least squares, its bounds, and what it finds beyond the table, against independent ones."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

import mampc
from builders import cost_of, random_model, sample_data
from mampc import Status
from mampc.methods.exact import ranking, tree
from mampc.methods.exact.children import children_of
from mampc.methods.exact.leaves import finished, with_one_more
from mampc.methods.exact.nodes import renewed, root_of
from mampc.methods.exact.relaxation import ROUNDS, Multipliers, Relaxation, SampleRelaxation
from mampc.methods.exact.sample_problem import SampleProblem
from mampc.methods.exact.terms import Squares
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import Incumbent, PatternSolver
from mampc.program.condensing import CondensedQP
from referees import all_patterns, best_on_every_pattern, charge
from seeds import seeds


@pytest.fixture(autouse=True)
def no_table(monkeypatch):
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)


def least_squares(A, b):
    """The least |A x - b|^2 and its x, by Householder's reflections in extended precision."""
    A, b = A.astype(np.longdouble), b.astype(np.longdouble)
    n = A.shape[1]
    for k in range(n):
        v = A[k:, k].copy()
        v[0] += np.copysign(np.sqrt(v @ v), v[0])
        scale = 2 / (v @ v)
        A[k:, k:] -= np.outer(v, scale * (v @ A[k:, k:]))
        b[k:] -= v * (scale * (v @ b[k:]))
    x = np.zeros(n, dtype=np.longdouble)
    for k in range(n - 1, -1, -1):
        x[k] = (b[k] - A[k, k + 1 :] @ x[k + 1 :]) / A[k, k]
    return float(b[n:] @ b[n:]), x.astype(float)


def double_integrator(n_p, **changes):
    model = mampc.StateSpace([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], [[1.0, 0.0]], None, 1.0)
    return mampc.TrackingProblem(model, prediction_horizon=n_p, **{"control_horizon": 5} | changes)


def random_problem(seed, n_c=5, m=2, **changes):
    model = random_model(seed, n=3, m=m, l=2)
    return mampc.TrackingProblem(model, prediction_horizon=n_c + 4, control_horizon=n_c, **changes)


def sample_problem(problem, rules, seed, best=None):
    """One sample as the tree sees it."""
    rng, model = np.random.default_rng(seed), problem.model
    condensed = CondensedQP(problem, bound_every_move=bool(np.any(rules.min_size)))
    admissible = AdmissiblePatterns(rules, model.n_inputs, problem.control_horizon)
    u = model.u_op
    sample = sample_data(
        condensed, u, x=rng.standard_normal(model.n_states),
        reference=model.y_op + 2 * rng.standard_normal(model.n_outputs),
    )  # fmt: skip
    order = np.flatnonzero(admissible.candidates)
    squares = Squares(condensed, order)
    relaxation = Relaxation(condensed, order, squares.L[:, :-1])
    allowance = admissible.allowance(np.tile(u, (rules.memory, 1)))
    return SampleProblem(
        squares, relaxation, admissible, PatternSolver(condensed, admissible), sample, allowance,
        best or Incumbent(), np.inf,
    )  # fmt: skip


def random_multipliers(problem, rng):
    """Multipliers of rows, as many as they may be, and of single moves."""
    moves, v = problem.relaxation._of.moves, problem.squares.condensed.n_violations
    rows = 0.3 * rng.standard_normal(len(problem.relaxation._lower))
    rows[moves] = 0.0
    rows[:v] = 0.0
    rows[(rows > 0) & (problem.relaxation._upper > 1e20)] = 0.0
    rows[(rows < 0) & (problem.relaxation._lower < -1e20)] = 0.0
    pulls = 0.3 * rng.standard_normal(len(problem.order))
    return Multipliers(rows, pulls, np.ones(len(pulls), dtype=bool), pulls)


@pytest.mark.parametrize(
    "problem",
    [random_problem(1), random_problem(2, n_c=8), *(double_integrator(n_p) for n_p in (20, 60, 100, 200))],
    ids=str,
)
def test_nodes_cost_what_dense_least_squares_say_at_any_conditioning(problem):
    rng = np.random.default_rng(0)
    at = sample_problem(problem, mampc.MoveRules(max_moves=4), 3)
    U, target = at.squares.condensed.U, at.sample.target
    nodes = root_of(at.terms, at.allowance, at.admissible)
    for level in range(len(at.order)):
        nodes, _ = children_of(level, nodes, at)
        nodes = nodes.take(rng.permutation(len(nodes.bound))[:3])
        for chosen, d, value in zip(nodes.chosen, nodes.d[:, :, 0], nodes.value[:, 0], strict=True):
            made = chosen[chosen >= 0]
            free = np.concatenate((made, np.arange(level + 1, len(at.order))))
            least, moves = least_squares(U[:, free], target)
            scale = at.sample.cost + least
            assert value == pytest.approx(scale, rel=1e-9)
            np.testing.assert_allclose(d[: len(made)], moves[: len(made)], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("seed", range(6))
def test_multipliers_price_limits_as_the_lagrangian_has_it(seed):
    rng = np.random.default_rng(seed)
    model = random_model(seed, n=3, m=2, l=2)
    limits = mampc.Limits(
        u_min=model.u_op - 1, u_max=model.u_op + 2, y_max=model.y_op + 0.5,
        du_max=0.7 if seed % 2 else None,
    )  # fmt: skip
    at = sample_problem(random_problem(seed, limits=limits), mampc.MoveRules(price=0.1), seed)
    found, terms, condensed = random_multipliers(at, rng), at.terms, at.squares.condensed
    terms.add(found)
    bounded = at.domain.bounded
    v = condensed.n_violations
    rows, A = found.rows[v + len(at.order) :], condensed.bounds.rows
    lower, upper = at.sample.lower[condensed.bounds.n_simple :], at.sample.upper[condensed.bounds.n_simple :]
    w, penalty = condensed.problem.output_limit_weight, np.zeros(v)
    # The best violations of the Lagrangian: w + w a + (A' mu)_a = 0.
    pull = rows @ A[:, :v] + w
    penalty = -pull / w
    for _ in range(5):
        d = rng.standard_normal(len(at.order))
        reached = A @ np.concatenate((penalty, d))
        lagrangian = (
            at.sample.cost + np.sum((condensed.U @ d - at.sample.target) ** 2)
            + w * (penalty.sum() + 0.5 * penalty @ penalty)
            + np.where(rows > 0, rows * (reached - np.where(rows > 0, upper, 0)), 0).sum()
            + np.where(rows < 0, rows * (reached - np.where(rows < 0, lower, 0)), 0).sum()
            + np.where(bounded, found.pulls, 0.0) @ d
        )  # fmt: skip
        term = np.sum((at.squares.L[:, :-1] @ d - terms.c[:, 1]) ** 2) + terms.rest[1]
        assert term == pytest.approx(lagrangian, rel=1e-9)


@pytest.mark.parametrize("counting", ["elementwise", "simultaneous"])
def test_later_moves_add_no_less_than_is_said(counting):
    rng = np.random.default_rng(5)
    model = random_model(7, m=2)
    limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1, du_max=0.5)
    price = 0.2 if counting == "simultaneous" else (0.2, 0.4)
    rules = mampc.MoveRules(price=price, counting=counting)
    at = sample_problem(random_problem(7, n_c=4, limits=limits), rules, 0)
    for _ in range(4):
        at.terms.add(random_multipliers(at, rng))
    n = len(at.order)
    for level, left, paid in product(range(n), (1, 2, n), (False, True)):
        if paid and (counting == "elementwise" or level % 2 == 0):
            continue
        paying = np.array([paid]) if paid else None
        said = [at.terms.later(level, np.array([left]), paying, more)[0] for more in (1, 2)]
        for size in range(1, n - level + 1):
            for made in combinations(range(level, n), size):
                samples = {i // 2 for i in made} - ({level // 2} if paid else set())
                counted = len(samples) if counting == "simultaneous" else size
                if counted > left:
                    continue
                charged = (
                    0.2 * counted if counting == "simultaneous" else sum((0.2, 0.4)[i % 2] for i in made)
                )
                adds = charged - at.terms.support[list(made)].sum(axis=0)
                assert (said[0] <= adds + 1e-12).all()
                if size > 1 and counting == "elementwise":
                    assert (said[1] <= adds + 1e-12).all()


@pytest.mark.parametrize("seed", range(5))
def test_the_last_moves_of_nodes_cost_what_least_squares_say(seed):
    at = sample_problem(random_problem(seed, n_c=6), mampc.MoveRules(max_moves=3), seed)
    nodes = root_of(at.terms, at.allowance, at.admissible)
    for level in range(4):
        nodes, _ = children_of(level, nodes, at)
    leaves, rest = finished(4, nodes, at.squares, at.terms)
    limit = np.full((len(nodes.bound), len(at.order) - 4), np.inf)
    more = with_one_more(4, nodes, rest, at.squares, at.terms, limit)
    U, target = at.squares.condensed.U, at.sample.target
    for row, chosen in enumerate(leaves.chosen):
        made = chosen[chosen >= 0]
        assert leaves.bound[row] == pytest.approx(at.sample.cost + least_squares(U[:, made], target)[0])
        for t in range(4, len(at.order)):
            least = at.sample.cost + least_squares(U[:, [*made, t]], target)[0]
            assert more[row, t - 4] == pytest.approx(least, rel=1e-8)


def test_terms_that_come_later_give_nodes_the_same_columns():
    rng = np.random.default_rng(2)
    model = random_model(3, m=2)
    limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1, du_max=0.5)
    at = sample_problem(random_problem(3, limits=limits), mampc.MoveRules(price=0.1, min_size=0.2), 1)
    at.terms.add(random_multipliers(at, rng))
    nodes = root_of(at.terms, at.allowance, at.admissible)
    for level in range(5):
        nodes, _ = children_of(level, nodes, at)
        nodes = nodes.take(rng.permutation(len(nodes.bound))[:40])
    again = renewed(5, nodes, [1], at.squares, at.terms)
    np.testing.assert_allclose(again.value, nodes.value, rtol=1e-9)
    np.testing.assert_allclose(again.d, nodes.d, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("n_p", [20, 60, 100, 200])
@pytest.mark.parametrize("max_moves", [2, 3])
def test_the_optimum_of_a_double_integrator_is_right_at_any_conditioning(n_p, max_moves):
    problem = double_integrator(n_p)
    controller = mampc.MAMPC(problem, mampc.MoveRules(max_moves=max_moves))
    decision = controller.step(controller.initial_state(np.zeros(1)), np.zeros(2), np.ones(1))
    # Referee: step responses by recursion, and least squares of every pattern in extended precision.
    x, step = np.zeros((2, 5), dtype=np.longdouble), []
    A, B = np.array([[1, 1], [0, 1]], dtype=np.longdouble), np.array([0.5, 1], dtype=np.longdouble)
    for i in range(n_p + 1):
        step.append(x[0].copy())
        x = A @ x + np.outer(B, np.arange(5) <= i)
    W = np.vstack([np.array(step), np.sqrt(np.longdouble(0.1)) * np.eye(5)])
    b = np.concatenate((np.ones(n_p + 1), np.zeros(5)))
    best = min(least_squares(W[:, list(made)], b)[0] for made in combinations(range(5), max_moves))
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(best, rel=1e-7)
    assert decision.lower_bound <= best * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_on_off_inputs_are_as_good_as_the_best_of_all_sequences(seed):
    rng = np.random.default_rng(seed)
    m, n_c = (1, 8) if seed % 2 else (2, 4)
    model = random_model(seed, n=2, m=m, l=1)
    model = replace(model, u_op=np.zeros(m), y_op=np.zeros(1))
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + 2, control_horizon=n_c, limits=mampc.Limits(u_min=0.0, u_max=1.0)
    )
    rules = mampc.MoveRules(min_size=1.0, price=0.05 if seed % 3 else 0.0)
    controller = mampc.MAMPC(problem, rules)
    before = rng.integers(0, 2, m).astype(float)
    x, reference = rng.standard_normal(2), rng.standard_normal(1)
    decision = controller.step(controller.initial_state(before), x, reference)
    assert decision.status is Status.OPTIMAL
    assert np.isin(decision.plan, (0.0, 1.0)).all()

    def value(levels):
        plan = np.array(levels, dtype=float).reshape(n_c, m)
        moved = np.diff(np.vstack([before, plan]), axis=0) != 0
        return cost_of(problem, x, before, reference, plan) + charge(rules, moved)

    best = min(value(levels) for levels in product((0, 1), repeat=n_c * m))
    assert decision.objective == pytest.approx(best, rel=1e-9)


def priced_case(seed, scale_u=1.0, scale_y=1.0, max_moves=None):
    """A problem with move limits and a price, far from its reference; inputs and outputs in other units."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, n=3, m=2, l=2)
    counting = ["elementwise", "simultaneous"][seed % 2 if max_moves is None else 0]
    if max_moves is None and seed % 4 == 3:
        max_moves = 3
    rules = mampc.MoveRules(
        price=0.1 + 0.3 * rng.random(), counting=counting, dwell=1 + seed % 3 // 2,
        max_moves=max_moves, max_moves_per_step=1 if seed % 5 == 4 else None,
    )  # fmt: skip
    scaled = mampc.StateSpace(
        model.A, model.B / scale_u, model.C * scale_y, None, 1.0, model.u_op * scale_u, model.y_op * scale_y
    )
    problem = mampc.TrackingProblem(
        scaled, prediction_horizon=7, control_horizon=4, output_weight=scale_y**-2.0,
        move_weight=0.1 * scale_u**-2.0, output_limit_weight=10.0,
        limits=mampc.Limits(
            du_max=0.3 * scale_u, u_min=(model.u_op - 1) * scale_u,
            y_max=(model.y_op + 1) * scale_y if seed % 3 == 0 else None,
        ),
    )  # fmt: skip
    x, reference = rng.standard_normal(3), (model.y_op + 3 * rng.standard_normal(2)) * scale_y
    return problem, rules, x, reference


def decide(problem, rules, x, reference):
    controller = mampc.MAMPC(problem, rules, method=mampc.Exact(time_limit=60.0))  # on a busy machine
    return controller.step(controller.initial_state(), x, reference)


@pytest.mark.parametrize("max_moves", [None, 1, 2, 3])
@pytest.mark.parametrize("seed", seeds(10, quick=3))
def test_move_limits_and_prices_branch_to_the_optimum_of_brute_force(seed, max_moves, monkeypatch):
    problem, rules, x, reference = priced_case(seed, max_moves=max_moves)
    runs = []
    of_program = tree.Branching
    monkeypatch.setattr(tree, "Branching", lambda at: runs.append(at) or of_program(at))
    decision = decide(problem, rules, x, reference)
    past = np.tile(problem.model.u_op, (rules.memory, 1))
    values = best_on_every_pattern(problem, rules, x, past[-1], reference)
    admissible = AdmissiblePatterns(rules, 2, 4)
    allowance = admissible.allowance(past)
    best = min(
        value + charge(rules, pattern)
        for value, pattern in zip(values, all_patterns(4, 2), strict=True)
        if admissible.allows(pattern.ravel(), allowance)
    )
    assert runs
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize("scale_u", [1e-3, 1e4])
@pytest.mark.parametrize("scale_y", [1e-4, 1e3])
def test_units_decide_nothing(scale_u, scale_y):
    for seed in range(4):
        usual, other = decide(*priced_case(seed)), decide(*priced_case(seed, scale_u, scale_y))
        np.testing.assert_array_equal(usual.moves, other.moves)
        np.testing.assert_allclose(other.plan / scale_u, usual.plan, rtol=1e-6, atol=1e-6)
        assert other.objective == pytest.approx(usual.objective, rel=1e-6)


def test_bounds_of_branching_never_fall():
    """Multipliers of a node may say less than those of the node it comes from."""
    model = mampc.StateSpace(
        [[1, 1, 0.5], [0, 1, 1], [0, 0, 1]], [[1 / 6, 0.3], [0.5, -0.2], [1, 0.4]], [[1, 0, 0]], None, 1.0
    )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=100, control_horizon=15, move_weight=1e-6,
        limits=mampc.Limits(u_min=-1, u_max=1, du_max=0.2),
    )  # fmt: skip
    with pytest.warns(mampc.MampcWarning, match="condition"):
        controller = mampc.MAMPC(problem, mampc.MoveRules(price=0.1), method=mampc.Exact(time_limit=0.2))
    decision = controller.step(controller.initial_state(), np.array([0.06, -0.3, 0.15]), [1.0])
    assert 0 <= decision.lower_bound <= decision.objective


def test_out_of_time_branching_keeps_a_valid_bound():
    model = random_model(11, n=4, m=3, l=3)
    problem = mampc.TrackingProblem(
        model,
        prediction_horizon=24,
        control_horizon=16,
        limits=mampc.Limits(du_max=0.2, u_max=model.u_op + 2),
    )
    x, reference = np.ones(4), model.y_op + np.array([3.0, -2.0, 1.0])
    objectives, bounds = [], []
    for limit in (1e-3, 1e-2, 1e-1):
        controller = mampc.MAMPC(problem, mampc.MoveRules(price=0.3), method=mampc.Exact(time_limit=limit))
        decision = controller.step(controller.initial_state(), x, reference)
        assert decision.lower_bound <= decision.objective
        objectives.append(decision.objective)
        bounds.append(decision.lower_bound)
    assert max(bounds) <= min(objectives) * (1 + 1e-9)


def test_prices_of_moves_that_can_be_large_take_one_relaxed_program(monkeypatch):
    problem = random_problem(3, n_c=8, limits=mampc.Limits(u_min=-1e4, u_max=1e4))
    rounds, solve = [], SampleRelaxation._data
    monkeypatch.setattr(SampleRelaxation, "_data", lambda *of: rounds.append(1) or solve(*of))
    rng = np.random.default_rng(3)
    decision = decide(problem, mampc.MoveRules(price=1.0), rng.standard_normal(3), 2 * rng.standard_normal(2))
    assert decision.status is Status.OPTIMAL
    assert 0 < len(rounds) <= ROUNDS


@pytest.mark.parametrize(("seed", "size"), [*product(range(4), (0.0, 0.05)), (1, 0.2)])
def test_where_a_second_move_does_not_pay_single_moves_are_priced_at_once(seed, size, monkeypatch):
    problem = random_problem(seed, n_c=6)
    x, reference = np.zeros(3), problem.model.y_op + 0.1
    mpc = mampc.MPC(problem)
    free = mpc.step(mpc.initial_state(), x, reference).objective
    hold = decide(problem, mampc.MoveRules(price=1e3), x, reference).objective
    price = 0.55 * (hold - free)
    monkeypatch.setattr(tree, "children_of", lambda *_: pytest.fail("a node was split"))
    decision = decide(problem, mampc.MoveRules(price=price, min_size=size), x, reference)
    one = decide(problem, mampc.MoveRules(max_moves=1, min_size=size), x, reference).objective
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(min(hold, one + price), rel=1e-9)


@pytest.mark.parametrize("reference", np.linspace(0.1, 1.5, 8))
@pytest.mark.parametrize("unit", [1.0, 1e-4])
def test_a_single_move_away_from_a_limit_is_none_or_of_least_size(reference, unit):
    """The least size is more than half of what the input may do, so that its sign is known and its size is not."""
    model = mampc.StateSpace([[0.5]], [[1.0 / unit]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=1, control_horizon=1, limits=mampc.Limits(u_min=0.0, u_max=1.5 * unit)
    )
    decision = decide(problem, mampc.MoveRules(min_size=unit), np.zeros(1), [reference])
    weight = float(problem.move_weight[0, 0]) * unit**2
    moves = np.array([0.0, np.clip(reference / (1 + weight), 1.0, 1.5)])
    best = moves[np.argmin((reference - moves) ** 2 + weight * moves**2)]
    assert decision.status is mampc.Status.OPTIMAL
    np.testing.assert_allclose(decision.changes.ravel(), best * unit, rtol=1e-9, atol=1e-12 * unit)
