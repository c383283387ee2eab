"""The exact method finds the best plan of all admissible patterns: against brute force, SCIP and limits of theory."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

import mampc
from builders import predicted, random_model
from mampc import Status
from mampc.condensing import CondensedQP
from mampc.controllers import ranking
from referees import all_patterns, best_on_every_pattern, charge, keeps_rules, objective_of

SEEDS = range(300)
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
    controller = mampc.MAMPC(case.problem, case.rules, method=method, **settings)
    return controller.step(controller.initial_state(case.past), case.x, case.reference)


def both_bookkeepings(monkeypatch):
    """The names of the two searches, each in force while the loop is at it."""
    for name, largest in (("ranking", ranking.LARGEST_TABLE), ("tree", 0)):
        monkeypatch.setattr(ranking, "LARGEST_TABLE", largest)
        yield name


@pytest.mark.parametrize("seed", SEEDS)
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


def test_each_bookkeeping_is_what_it_says(monkeypatch):
    names = []
    for name in both_bookkeepings(monkeypatch):
        search = mampc.Exact().prepare(CondensedQP(random_case(0).problem), random_case(0).rules)
        names.append((name, search._ranking is None))
    assert names == [("ranking", False), ("tree", True)]
