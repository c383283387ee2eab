"""Every method keeps limits and rules, costs what it says, and is never better than the proven optimum."""

import pickle
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import mampc
from builders import cost_of, random_model, same_decision, tank_problem
from mampc import MampcError, MoveRules, Status
from mampc.methods.heuristic import MOST_PROGRAMS
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import PatternSolver
from mampc.program.restriction import Restriction
from referees import charge, keeps_rules
from seeds import examples

SETTINGS = {"alternating": {"polish": True, "warm_up": 0}}
NAMES = list(mampc.METHODS)
HEURISTICS = [name for name in NAMES if name != "exact"]
RULES = {
    "budget": MoveRules(max_moves=3, sparsity_horizon=3),
    "no moves left": MoveRules(max_moves=0),
    "price": MoveRules(price=0.5),
    "price per input": MoveRules(price=(0.2, 1.0)),
    "budget and price": MoveRules(max_moves=3, sparsity_horizon=2, price=0.3),
    "simultaneous": MoveRules(max_moves=2, price=0.3, counting="simultaneous"),
    "least size": MoveRules(max_moves=3, min_size=(0.3, 0.5)),
    "dwell": MoveRules(dwell=3, sparsity_horizon=3),
    "one input a step": MoveRules(max_moves_per_step=1, max_moves=3),
    "blocks": MoveRules(blocks=(1, 2)),
}

every_method = pytest.mark.parametrize("name", NAMES)
every_heuristic = pytest.mark.parametrize("name", HEURISTICS)
every_rule = pytest.mark.parametrize("rules", RULES.values(), ids=RULES)


def controller_of(problem, rules, name, **settings):
    return mampc.MAMPC(problem, rules, method=name, **(SETTINGS.get(name, {}) | settings))


def sample(seed, *, control_horizon=4, narrow=True, **changes):
    """A random problem, past inputs (3, m), state and reference; narrow input limits are active."""
    rng = np.random.default_rng(seed)
    model = random_model(seed)
    reach = rng.uniform(0.6, 1.2) if narrow else 1e3
    problem = mampc.TrackingProblem(
        model, prediction_horizon=control_horizon + 3, control_horizon=control_horizon, move_weight=0.1,
        limits=mampc.Limits(u_min=model.u_op - reach, u_max=model.u_op + reach), **changes,
    )  # fmt: skip
    past = np.tile(model.u_op, (3, 1))
    past[-1, 0] += 0.5 * (seed % 2)  # every second past holds a move
    return problem, past, rng.standard_normal(3), model.y_op + 2 * rng.standard_normal(2)


def decide(controller, past, x, reference):
    return controller.step(controller.initial_state(past), x, reference)


@cache
def decided(seed, rules, name):
    """The decision of a method on a sample; several tests look at it."""
    problem, *asked = sample(seed)
    return decide(controller_of(problem, rules, name), *asked)


@every_rule
@every_method
def test_plans_keep_limits_and_rules_and_cost_what_they_say(name, rules):
    for seed in range(examples(4, quick=2)):
        problem, past, x, reference = sample(seed)
        decision = decided(seed, rules, name)
        changes = np.diff(np.vstack([past[-1:], decision.plan]), axis=0)
        np.testing.assert_allclose(decision.changes, changes, atol=1e-12)
        assert (decision.moves == (np.abs(changes) > 1e-9)).all()
        assert (decision.plan >= problem.limits.u_min).all()
        assert (decision.plan <= problem.limits.u_max).all()
        assert keeps_rules(rules, past, decision.moves)
        assert (np.abs(changes) >= np.where(decision.moves, rules.min_size, 0.0) - 1e-7).all()
        cost = cost_of(problem, x, past[-1], reference, decision.plan) + charge(rules, decision.moves)
        assert decision.objective == pytest.approx(cost, rel=1e-8)


@every_rule
@every_heuristic
def test_no_plan_is_better_than_the_proven_optimum(name, rules):
    for seed in range(examples(4, quick=2)):
        best, found = decided(seed, rules, "exact"), decided(seed, rules, name)
        assert best.status is Status.OPTIMAL
        assert found.status is Status.FEASIBLE
        assert found.lower_bound == -np.inf
        assert found.objective >= best.objective * (1 - 1e-9)
        still = decided(seed, RULES["no moves left"], "exact")
        assert found.objective <= still.objective * (1 + 1e-12)


@every_method
@pytest.mark.parametrize("narrow", [False, True])
def test_a_budget_of_all_moves_gives_the_plan_of_plain_mpc(name, narrow):
    problem, past, x, reference = sample(3, narrow=narrow)
    rules = MoveRules(max_moves=3 * 2 + 2)  # all of the 4 x 2 moves
    assert not AdmissiblePatterns(rules, 2, 4).unrestricted
    decision = decide(controller_of(problem, rules, name), past, x, reference)
    plain = decide(mampc.MPC(problem), past[-1:], x, reference)
    np.testing.assert_allclose(decision.plan, plain.plan, atol=1e-7)
    assert decision.objective == pytest.approx(plain.objective, rel=1e-9)


@every_heuristic
@pytest.mark.parametrize("rules", [RULES["budget"], RULES["budget and price"]])
def test_a_certificate_holds_the_proven_optimum(name, rules):
    for seed in range(examples(4, quick=2)):
        problem, *asked = sample(seed)
        best, plain = decided(seed, rules, "exact"), decided(seed, rules, name)
        certified = decide(controller_of(problem, rules, name, certify=True), *asked)
        assert certified.objective == pytest.approx(plain.objective, rel=1e-12)
        assert certified.lower_bound == pytest.approx(best.objective, rel=1e-8)
        assert certified.gap == pytest.approx(certified.objective - best.objective, abs=1e-7)
        assert (certified.status is Status.OPTIMAL) == (certified.gap <= 1e-8 * best.objective)


def easy_instance():
    """Inputs that act at once and for good, each on its own output: the Hessian is nearly diagonal in the moves."""
    model = mampc.StateSpace(np.zeros((2, 2)), np.eye(2), np.eye(2), None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=3, control_horizon=3, output_weight=[1.0, 1.0], move_weight=5.0,
        limits=mampc.Limits(u_min=-9.0, u_max=9.0),
    )  # fmt: skip
    return problem, np.zeros((1, 2)), np.zeros(2), np.array([3.0, 0.2])


@every_method
def test_an_easy_optimum_is_found(name):
    problem, past, x, reference = easy_instance()
    rules = MoveRules(max_moves=1)
    best = decide(controller_of(problem, rules, "exact"), past, x, reference)
    found = decide(controller_of(problem, rules, name), past, x, reference)
    assert found.objective == pytest.approx(best.objective, rel=1e-9)
    assert (found.moves == best.moves).all()
    assert found.moves.sum() == 1


def test_greedy_spreads_what_no_single_move_can_do():
    """Where moves are bounded, the work of one takes several, which pay only together with the first."""
    found, left_open = 0, []
    for seed in range(examples(100, quick=20)):
        problem, past, x, reference = sample(seed, narrow=False)
        largest = np.abs(decide(mampc.MPC(problem), past[-1], x, reference).changes).max(axis=0)
        problem = replace(problem, limits=replace(problem.limits, du_max=0.3 * largest))
        rules = MoveRules(price=0.1)
        best, greedy = (
            decide(controller_of(problem, rules, name), past, x, reference).objective
            for name in ("exact", "greedy")
        )
        left_open.append(greedy / best - 1)
        found += left_open[-1] < 1e-7
    assert found >= 0.75 * len(left_open)
    assert np.mean(left_open) < 0.003


@every_heuristic
def test_least_sizes_take_a_bounded_number_of_programs(name, monkeypatch):
    solved, solve = [], Restriction.solve
    monkeypatch.setattr(Restriction, "solve", lambda *args: solved.append(1) or solve(*args))
    problem, past, x, reference = sample(5, control_horizon=10)
    controller = controller_of(problem, MoveRules(min_size=0.4, price=1e-4), name)
    assert not decide(controller, past, x, reference).held
    assert len(solved) < 1.1 * MOST_PROGRAMS


@every_heuristic
def test_beyond_its_time_a_method_keeps_the_best_plan_so_far_and_says_so(name, monkeypatch):
    monkeypatch.setattr("mampc.methods.heuristic.SECONDS", 0.0)
    problem, past, x, reference = sample(5, control_horizon=10)
    controller = controller_of(problem, MoveRules(min_size=0.4, price=1e-4), name)
    assert decide(controller, past, x, reference).status is mampc.Status.TIME_LIMIT


@every_method
def test_a_step_is_pure_and_its_state_can_be_pickled(name):
    problem = tank_problem()
    controller = controller_of(problem, RULES["budget"], name)
    state, x = controller.initial_state(), np.zeros(4)
    for k in range(4):
        reference = problem.model.y_op + np.array([2.0, 1.0 - 0.5 * k])
        decision = controller.step(state, x, reference)
        again = controller.step(pickle.loads(pickle.dumps(state)), x.copy(), reference.copy())
        assert same_decision(decision, again, atol=1e-9)
        fresh = controller_of(problem, RULES["budget"], name).step(state, x, reference)
        assert same_decision(decision, fresh, atol=1e-9)
        x = problem.model.A @ x + problem.model.B @ (decision.u - problem.model.u_op)
        state = decision.state


@every_method
def test_a_measurement_that_is_no_number_holds_the_inputs_and_spoils_nothing(name):
    problem, past, x, reference = sample(1)
    controller = controller_of(problem, RULES["budget"], name)
    before = decide(controller, past, x, reference)
    held = decide(controller, past, np.full(3, np.nan), reference)
    assert held.status is Status.HELD_BAD_MEASUREMENT
    np.testing.assert_array_equal(held.u, past[-1])
    assert same_decision(decide(controller, past, x, reference), before, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "setting", "value"),
    [
        ("exact", "time_limit", 0.0),
        ("exact", "time_limit", -1.0),
        ("alternating", "penalty", 0.0),
        ("alternating", "tolerance", -1e-4),
        ("alternating", "max_iterations", 0),
        ("alternating", "warm_up", -1),
        ("penalty_decomposition", "penalty", 0.0),
        ("penalty_decomposition", "growth", 1.0),
        ("penalty_decomposition", "tolerance", 0.0),
        ("penalty_decomposition", "max_iterations", 1.5),
        ("hard_thresholding", "tolerance", 0.0),
        ("hard_thresholding", "max_iterations", 0),
        ("admm", "penalty", -0.1),
        ("admm", "starts", 0),
        ("admm", "iterations", 0),
        ("admm", "seed", -1),
        ("l1", "reweightings", -1),
        ("l1", "bisections", 0),
        ("reweighted_l1", "reweightings", 101),
        ("greedy", "penalty", 1.0),
    ],
)
def test_settings_out_of_range_are_refused(name, setting, value):
    with pytest.raises(MampcError, match=r"expected .*, received") as refused:
        mampc.MAMPC(tank_problem(), RULES["budget"], method=name, **{setting: value})
    assert setting in str(refused.value)


def tight_sample(seed):
    """Limits that vary over the horizon and make inputs move, at times on no pattern that the rules admit."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, n=3, m=2, l=2)
    limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1, du_max=0.5)
    problem = mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=4, limits=limits)
    middle = model.u_op + rng.uniform(-0.6, 0.6, (4, 2))
    now = mampc.Limits(u_min=middle - rng.uniform(0.2, 0.8), u_max=middle + rng.uniform(0.2, 0.8))
    rules = MoveRules(max_moves=int(rng.integers(1, 6)), sparsity_horizon=2)
    return problem, rules, (0.5 * rng.standard_normal(3), model.y_op + rng.standard_normal(2)), now


@every_heuristic
def test_a_method_holds_the_inputs_only_where_no_plan_keeps_limits_and_rules(name):
    held = {"exact": 0, name: 0}
    for seed in (chosen := examples(range(60), quick=range(16, 32))):
        problem, rules, asked, now = tight_sample(seed)
        statuses = {}
        for method in held:
            controller = controller_of(problem, rules, method)
            decision = controller.step(controller.initial_state(), *asked, limits=now)
            statuses[method] = decision.status
            held[method] += decision.held
        assert statuses[name].held == statuses["exact"].held, (seed, statuses)
    assert 0 < held["exact"] < len(chosen)


@every_heuristic
def test_a_name_and_an_object_with_the_same_settings_decide_alike(name):
    problem, past, x, reference = sample(1)
    named = decide(controller_of(problem, RULES["budget"], name), past, x, reference)
    method = mampc.METHODS[name](**SETTINGS.get(name, {}))
    given = decide(mampc.MAMPC(problem, RULES["budget"], method=method), past, x, reference)
    assert same_decision(named, given)


def test_greedy_says_how_many_patterns_it_tried(monkeypatch):
    tried, offer = [], PatternSolver.offer
    monkeypatch.setattr(PatternSolver, "offer", lambda *of, **how: tried.append(1) or offer(*of, **how))
    for seed in range(8):
        model = random_model(seed)
        limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1, du_max=[np.inf, 0.3][seed % 2])
        problem = mampc.TrackingProblem(
            model, prediction_horizon=8, control_horizon=4, move_weight=0.01, limits=limits
        )
        controller = mampc.MAMPC(problem, MoveRules(max_moves=2, sparsity_horizon=2), method="greedy")
        tried.clear()
        decision = controller.step(controller.initial_state(), np.zeros(3), model.y_op + 1.0)
        assert decision.iterations == len(tried)
