"""The exact method finds the best plan of all admissible patterns: against brute force, SCIP and limits of theory."""

import sys
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

import mampc
from builders import cost_of, predicted, random_model, sample_data
from mampc import Status
from mampc.methods.exact import ranking
from mampc.methods.exact.open_patterns import OpenPatterns
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import PatternSolver
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from referees import all_patterns, best_on_every_pattern, charge, keeps_rules, objective_of, scip_bounds
from seeds import deep, examples, seeds

SEEDS = range(300)
LAST_LOOKS = 20  # at the clock, until a search that is out of time has ended
RULES = ("max_moves", "price", "min_size", "dwell", "max_moves_per_step", "blocks")


class Case(NamedTuple):
    problem: mampc.TrackingProblem
    rules: mampc.MoveRules
    past: np.ndarray
    x: np.ndarray
    reference: np.ndarray


@cache
def random_case(seed):
    """A small problem whose limits are near, rules in turn alone and combined, and one sample's data."""
    rng = np.random.default_rng(seed)
    n_c, m = [(3, 2), (5, 1), (2, 3), (2, 2), (6, 1), (4, 1)][rng.integers(6)]
    l = int(rng.integers(1, 3))
    model = random_model(seed, n=3, m=m, l=l, feedthrough=seed % 4 == 0)
    used = {RULES[seed % 6], *(name for name in RULES if rng.random() < 0.35)}
    if used == {"max_moves_per_step"} and m == 1:  # no rule at all, so plain MPC
        used = {"max_moves"}
    counting = str(rng.choice(["elementwise", "simultaneous"]))
    price = 10 ** rng.uniform(-2, 0, m if counting == "elementwise" else None)
    options = {
        "max_moves": int(rng.integers(1, n_c * m)),
        "price": tuple(price) if np.ndim(price) else float(price),
        "min_size": tuple(rng.uniform(0.1, 0.5, m)),
        "dwell": int(rng.integers(2, 4)),
        "max_moves_per_step": 1,
        "blocks": (1, n_c - 1),
    }
    rules = mampc.MoveRules(
        counting=counting, sparsity_horizon=int(rng.integers(1, 4)), **{name: options[name] for name in used}
    )
    changes = 0.3 * rng.standard_normal((rules.memory, m)) * (rng.random((rules.memory, m)) < 0.25)
    past = model.u_op + np.cumsum(changes, axis=0)
    x, reference = rng.standard_normal(3), model.y_op + 2 * rng.standard_normal(l)
    limits = {}
    if rng.random() < 0.6:
        limits["u_min"], limits["u_max"] = past[-1] - rng.uniform(0, 1, m), past[-1] + rng.uniform(0.5, 1, m)
    if rng.random() < 0.5:
        limits["du_max"] = rng.uniform(0.5, 1, m)
    if rng.random() < 0.6:
        limits["y_max"] = np.maximum(model.y_op, reference) - rng.uniform(-0.2, 0.5, l)
        limits["y_min"] = limits["y_max"] - rng.uniform(1, 4, l)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + int(rng.integers(0, 4)), control_horizon=n_c,
        output_weight=rng.uniform(0.5, 2, l), move_weight=0.1, limits=mampc.Limits(**limits),
        output_limit_weight=float(10 ** rng.uniform(0, 3)),
    )  # fmt: skip
    return Case(problem, rules, past, x, reference)


@cache
def values(seed):
    problem, rules, past, x, reference = random_case(seed)
    return best_on_every_pattern(problem, rules, x, past[-1], reference)


def best_value(seed, rules):
    """The least objective under rules with the case's own least sizes, by trying every pattern."""
    problem, _, past, _, _ = random_case(seed)
    patterns = all_patterns(problem.control_horizon, problem.model.n_inputs)
    return min(
        value + charge(rules, pattern)
        for value, pattern in zip(values(seed), patterns, strict=True)
        if keeps_rules(rules, past, pattern)
    )


def decide(case, method="exact", **settings):
    if method == "exact":
        settings = {"time_limit": 60.0} | settings  # a busy machine is not out of time
    controller = mampc.MAMPC(case.problem, case.rules, method=method, **settings)
    return controller.step(controller.initial_state(case.past), case.x, case.reference)


def both_bookkeepings(monkeypatch):
    """The names of the two searches, each in force while the loop is at it."""
    for name, largest in (("ranking", ranking.LARGEST_TABLE), ("tree", 0)):
        monkeypatch.setattr(ranking, "LARGEST_TABLE", largest)
        yield name


@pytest.mark.parametrize("seed", seeds(300, quick=10))
def test_the_optimum_is_that_of_brute_force_with_both_bookkeepings(seed, monkeypatch):
    case = random_case(seed)
    problem, rules, past, x, reference = case
    best = best_value(seed, rules)
    for name in both_bookkeepings(monkeypatch):
        decision = decide(case)
        assert decision.status is Status.OPTIMAL, name
        assert decision.gap == 0.0
        assert decision.objective == pytest.approx(best, rel=1e-6), name
        assert objective_of(problem, rules, x, past, reference, decision.plan) == pytest.approx(
            best, rel=1e-6
        )
        assert_keeps_limits_and_rules(case, decision)


def assert_keeps_limits_and_rules(case, decision):
    limits, (_, rules, past, _, _) = case.problem.limits, case
    changes = np.diff(np.vstack([past[-1:], decision.plan]), axis=0)
    moves = np.abs(changes) > 1e-9
    np.testing.assert_array_equal(decision.moves, moves)
    np.testing.assert_allclose(decision.changes, changes, atol=1e-12)
    assert (decision.plan >= limits.u_min).all()
    assert (decision.plan <= limits.u_max).all()
    assert (np.abs(changes) <= limits.du_max + 1e-9).all()
    assert (~moves | (np.abs(changes) >= np.asarray(rules.min_size) - 1e-9)).all()
    assert keeps_rules(rules, past, moves)


@pytest.mark.slow
def test_the_random_cases_often_have_each_limit_active_and_each_rule_binding():
    active = dict.fromkeys(("u", "du_max", "min_size", "output", "violation"), 0)
    binding = dict.fromkeys(RULES, 0)
    for seed in SEEDS:
        problem, rules, _, x, _ = random_case(seed)
        decision, limits = decide(random_case(seed)), problem.limits
        size = np.abs(decision.changes[decision.moves])
        at = np.nonzero(decision.moves)[1]
        y = predicted(problem.model, x, decision.plan, problem.prediction_horizon + 1)[1:]
        margin = np.minimum(limits.y_max - y, y - limits.y_min).min(axis=0)
        to_limit = np.minimum(limits.u_max - decision.plan, decision.plan - limits.u_min)
        active["u"] += (to_limit[decision.moves] < 1e-6).any()
        active["du_max"] += (size > limits.du_max[at] - 1e-6).any()
        active["min_size"] += (size < np.broadcast_to(rules.min_size, len(limits.u_min))[at] + 1e-6).any()
        active["output"] += (np.abs(margin) < 1e-6).any()
        active["violation"] += (margin < -1e-3).any()
        best = best_value(seed, rules)
        for name in ("max_moves", "price", "dwell", "max_moves_per_step", "blocks"):
            without = replace(rules, **{name: getattr(mampc.MoveRules(), name)})
            binding[name] += best_value(seed, without) < best - 1e-6 * best
        binding["min_size"] = active["min_size"]
    assert min(active.values()) >= 20, active
    assert min(binding.values()) >= 20, binding


def test_each_bookkeeping_is_what_it_says_and_inputs_of_a_few_levels_are_searched_as_a_tree(monkeypatch):
    model, names = random_model(0, n=3, m=2, l=2), []
    problem = mampc.TrackingProblem(
        model, prediction_horizon=6, control_horizon=4,
        limits=mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1),
    )  # fmt: skip
    condensed = CondensedQP(problem, bound_every_move=True)
    for name in both_bookkeepings(monkeypatch):
        for least_size in (0.0, 0.9, 1.1):
            rules = mampc.MoveRules(max_moves=2, min_size=least_size)
            names.append((name, least_size, mampc.Exact().prepare(condensed, rules)._ranking is None))
    assert names == [
        ("ranking", 0.0, False), ("ranking", 0.9, False), ("ranking", 1.1, True),
        ("tree", 0.0, True), ("tree", 0.9, True), ("tree", 1.1, True),
    ]  # fmt: skip


def larger_case(seed):
    """16 to 24 moves within limits of all kinds, from rest."""
    rng = np.random.default_rng(seed)
    n_c, m = [(8, 2), (20, 1), (7, 3), (12, 2)][seed % 4]
    model = random_model(seed, n=4, m=m, l=m, radius=rng.uniform(0.6, 0.95))
    rules = mampc.MoveRules(
        price=float(10 ** rng.uniform(-1, 1)) if seed % 3 != 1 else 0.0,
        max_moves=int(rng.integers(2, 5)) if seed % 3 != 0 else None,
        counting=["elementwise", "simultaneous"][seed // 2 % 2],
        dwell=int(rng.integers(1, 4)),
    )
    limits = mampc.Limits(
        u_min=model.u_op - 1.5, u_max=model.u_op + 1.5, du_max=rng.uniform(1, 2, m),
        y_max=model.y_op + rng.uniform(1, 4, m),
    )  # fmt: skip
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + 4, control_horizon=n_c, limits=limits, output_limit_weight=10.0
    )
    past = np.tile(model.u_op, (rules.memory, 1))
    return Case(problem, rules, past, rng.standard_normal(4), model.y_op + 2 * rng.standard_normal(m))


@pytest.mark.slow
def test_scip_brackets_the_optimum_of_larger_problems():
    both = 0
    for seed in range(40):
        problem, rules, past, x, reference = case = larger_case(seed)
        decision = decide(case)
        low, high = scip_bounds(problem, rules, x, past[-1], reference, seconds=0.3)
        tolerance = 1e-6 * abs(decision.objective)
        assert decision.lower_bound <= high + tolerance, seed
        assert decision.objective >= low - tolerance, seed
        if decision.status is Status.OPTIMAL:
            assert decision.objective <= high + tolerance, seed
            both += high - low <= tolerance
        assert_keeps_limits_and_rules(case, decision)
    assert both >= 3  # both sides proven: SCIP has little time


class Clock:
    """A clock that goes on by a millisecond whenever a search looks at it, in place of the one on the wall."""

    def __init__(self, monkeypatch):
        self.looks = 0
        for name, module in list(sys.modules.items()):
            if name.startswith(("mampc.methods", "mampc.moves")) and hasattr(module, "perf_counter"):
                monkeypatch.setattr(module, "perf_counter", self)

    def __call__(self):
        self.looks += 1
        return 1e-3 * self.looks


@pytest.mark.parametrize("seed", seeds(10, quick=2))
@pytest.mark.parametrize("table", [0, 3_000_000])
def test_out_of_time_the_best_plan_so_far_comes_with_a_valid_bound(seed, table, monkeypatch):
    monkeypatch.setattr(ranking, "LARGEST_TABLE", table)
    case = larger_case(seed + 1)
    optimum = decide(case, time_limit=20.0)
    assert optimum.status is Status.OPTIMAL
    limits, clock = (1e-6, 1e-3, 3e-3, 1e-2), Clock(monkeypatch)
    decisions, looks = [], []
    for limit in limits:
        before = clock.looks
        decisions.append(decide(case, time_limit=limit))
        looks.append(clock.looks - before)
    assert decisions[0].status in (Status.TIME_LIMIT, Status.OPTIMAL)
    for decision, limit, count in zip(decisions, limits, looks, strict=True):
        tolerance = 1e-9 * optimum.objective
        assert decision.lower_bound <= optimum.objective + tolerance
        assert decision.objective >= optimum.objective - tolerance
        assert (decision.status is Status.OPTIMAL) == (decision.gap == 0)
        assert count <= limit / 1e-3 + LAST_LOOKS
        assert_keeps_limits_and_rules(case, decision)


@pytest.mark.parametrize("least_size", [0.3, *deep(0.0)])
def test_the_time_limit_is_kept_where_the_proof_is_out_of_reach(least_size, monkeypatch):
    model = random_model(3, n=4, m=4, l=4)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=44, control_horizon=40, output_limit_weight=10.0,
        limits=mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1, y_max=model.y_op + 0.5),
    )  # fmt: skip
    rules = mampc.MoveRules(price=0.3, dwell=3, min_size=least_size)
    case = Case(problem, rules, np.tile(model.u_op, (3, 1)), np.ones(4), model.y_op + 1.0)
    clock = Clock(monkeypatch)
    decision = decide(case, time_limit=0.3)
    assert decision.status is Status.TIME_LIMIT
    assert clock.looks <= 300 + LAST_LOOKS
    assert np.isfinite(decision.lower_bound)
    assert decision.lower_bound < decision.objective
    assert_keeps_limits_and_rules(case, decision)


@pytest.mark.parametrize("seed", seeds(40, quick=6))
def test_rules_that_forbid_nothing_give_plain_mpc_and_those_that_forbid_all_hold(seed, monkeypatch):
    problem, _, past, x, reference = random_case(seed)
    plain = mampc.MPC(problem)
    dense = plain.step(plain.initial_state(past), x, reference)
    for _ in both_bookkeepings(monkeypatch):
        free = decide(Case(problem, mampc.MoveRules(max_moves=100), past, x, reference))
        np.testing.assert_allclose(free.plan, dense.plan, atol=1e-6)
        assert free.objective == pytest.approx(dense.objective, rel=1e-9)
        for rules in (
            {"max_moves": 0}, {"max_moves": 0, "counting": "simultaneous", "dwell": 2}, {"price": 1e9},
            {"price": 1e9, "counting": "simultaneous"}, {"min_size": 0.01, "price": 1e9},
        ):  # fmt: skip
            held = decide(Case(problem, mampc.MoveRules(**rules), past, x, reference))
            assert held.status is Status.OPTIMAL
            assert not held.moves.any()
            assert (held.plan == past[-1]).all()
            assert held.objective == pytest.approx(cost_of(problem, x, past[-1], reference, held.plan))


@pytest.mark.parametrize("method", [name for name in mampc.METHODS if name != "exact"])
def test_other_methods_certified_report_a_valid_bound_and_an_objective_as_planned(method):
    settings = {"warm_up": 0, "polish": True} if method == "alternating" else {}
    proven = 0
    for seed in range(0, examples(300, quick=24), 4):
        problem, rules, past, x, reference = case = random_case(seed)
        best = best_value(seed, rules)
        plain, certified = decide(case, method, **settings), decide(case, method, certify=True, **settings)
        assert plain.lower_bound == -np.inf
        np.testing.assert_allclose(plain.plan, certified.plan, atol=1e-9)
        assert certified.lower_bound == pytest.approx(best, rel=1e-6)
        assert certified.objective >= best * (1 - 1e-6)
        assert certified.objective == pytest.approx(
            objective_of(problem, rules, x, past, reference, certified.plan), rel=1e-6
        )
        assert (certified.status is Status.OPTIMAL) == (certified.gap == 0)
        proven += certified.status is Status.OPTIMAL
        assert_keeps_limits_and_rules(case, certified)
    assert proven >= examples(10, quick=3)


@pytest.mark.parametrize("seed", range(5))
def test_a_certificate_is_about_a_plan_that_keeps_the_rules(seed):
    """So it implies polish: a plan that moves a little everywhere would cost less than any admissible one."""
    case = random_case(seed)
    decision = decide(case, "alternating", warm_up=0, certify=True)
    assert decision.lower_bound == pytest.approx(best_value(seed, case.rules), rel=1e-6)
    assert decision.objective >= decision.lower_bound
    assert (decision.status is Status.OPTIMAL) == (decision.gap == 0)
    assert_keeps_limits_and_rules(case, decision)


@pytest.mark.parametrize("method", [name for name in mampc.METHODS if name != "alternating"])
@pytest.mark.parametrize("seed", seeds(10, quick=3))
def test_nobody_pays_for_moves_that_limits_keep_at_zero(method, seed):
    rng, model, room = np.random.default_rng(seed), random_model(seed), np.array([1.0, 0.0])
    problem = mampc.TrackingProblem(
        model, prediction_horizon=6, control_horizon=3,
        limits=mampc.Limits(u_min=model.u_op - room, u_max=model.u_op + room),
    )  # fmt: skip
    x, reference = rng.standard_normal(3), model.y_op + rng.standard_normal(2)
    case = Case(problem, mampc.MoveRules(price=0.1), model.u_op[None], x, reference)
    decision = decide(case, method)
    assert not decision.moves[:, 1].any()
    planned = objective_of(problem, case.rules, case.x, case.past, case.reference, decision.plan)
    assert decision.objective == pytest.approx(planned, rel=1e-9)


def test_a_search_over_signs_that_is_cut_short_says_so_and_offers_what_it_found():
    model = random_model(5, m=1, l=1)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=8, control_horizon=6,
        limits=mampc.Limits(u_max=model.u_op + 0.5, u_min=model.u_op - 0.5),
    )  # fmt: skip
    condensed = CondensedQP(problem, bound_every_move=True)
    admissible = AdmissiblePatterns(mampc.MoveRules(min_size=0.3), 1, 6)
    data = sample_data(condensed, model.u_op, x=np.ones(3), reference=model.y_op + 0.3)
    pattern = np.ones(6, dtype=bool)
    whole = PatternSolver(condensed, admissible).solve(data, pattern)
    assert whole.status is QPStatus.OPTIMAL
    statuses = set()
    for most in range(1, 130):
        cut = PatternSolver(condensed, admissible).solve(data, pattern, most=most)
        statuses.add(cut.status)
        if cut.moves is not None:
            assert cut.objective >= whole.objective - 1e-9
            assert (np.abs(cut.moves) >= 0.3).all()
    assert statuses == {QPStatus.TIME_LIMIT, QPStatus.OPTIMAL}
    assert cut.objective == pytest.approx(whole.objective, rel=1e-12)


def test_every_pattern_takes_the_best_multipliers_between_new_and_earlier_ones():
    rng = np.random.default_rng(5)
    model = random_model(5, n=3, m=2, l=2)
    limits = mampc.Limits(u_min=model.u_op - 0.3, u_max=model.u_op + 0.3)
    problem = mampc.TrackingProblem(model, prediction_horizon=8, control_horizon=4, limits=limits)
    condensed = CondensedQP(problem)
    admissible = AdmissiblePatterns(mampc.MoveRules(max_moves=3), 2, 4)
    table = ranking.ranking_of(condensed, admissible)
    x, reference = rng.standard_normal(3), model.y_op + 5 * rng.standard_normal(2)
    sample = sample_data(condensed, model.u_op, x=x, reference=reference)
    past = admissible.allowance(model.u_op[None])
    solver = PatternSolver(condensed, admissible)
    patterns = table.patterns[table.rows(past)]
    optima = [solver.solve(sample, pattern) for pattern in patterns]
    shown = [optima[i].multipliers for i in (0, 3, 7)]
    without = table.bounds(sample.moves, sample.cost, past)
    open_ = OpenPatterns(table, sample, past, without.copy())
    for multipliers in shown:
        open_.price(condensed.priced(sample, multipliers), np.inf)
    ends = [(new, shown[j]) for i, new in enumerate(shown) for j in range(i + 1)]
    between = [new + s * (old - new) for new, old in ends for s in np.linspace(0, 1, 501)]
    best = np.max([without, *(table.priced(condensed.priced(sample, m), past) for m in between)], axis=0)
    np.testing.assert_allclose(open_.bounds, best, rtol=1e-3)  # of a grid
    assert (open_.bounds <= [one.objective * (1 + 1e-9) for one in optima]).all()
    assert (open_.bounds > without + 0.1 * best).any()
