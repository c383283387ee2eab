"""Inputs on levels: lists, grids, on and off; proven best, and never anywhere else."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import mampc
from builders import random_model
from mampc import Remark, Status
from referees import best_on, keeps_rules, keeps_timings, moved, objective_of, program_of, scip_on_levels
from seeds import deep, examples, seeds

METHODS = {name: {"polish": True} if name == "alternating" else {} for name in mampc.METHODS}


def instance(seed, m, n_c, *, limited_outputs=False, few=True):
    """A problem, levels of each input, and where a sample starts."""
    rng = np.random.default_rng(seed)
    model = random_model(
        seed, n=int(rng.integers(1, 4)), m=m, l=int(rng.integers(1, 3)), feedthrough=rng.random() < 0.3
    )
    y = {"y_max": model.y_op + 0.5, "y_min": model.y_op - 0.7} if limited_outputs else {}
    limits = mampc.Limits(u_min=-3.0, u_max=3.0, du_max=rng.choice([np.inf, 4.0]), **y)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + int(rng.integers(0, 4)), control_horizon=n_c, limits=limits,
        move_weight=float(rng.choice([0.01, 0.1])), output_limit_weight=float(rng.choice([10.0, 1e3])),
    )  # fmt: skip
    levels = [
        np.sort(rng.choice(np.linspace(-3, 3, 13), 3 if few else 12, replace=False)).tolist()
        for _ in range(m)
    ]
    past = np.array([[rng.choice(values) for values in levels] for _ in range(6)])
    return (
        rng,
        problem,
        levels,
        rng.standard_normal(model.n_states),
        past,
        model.y_op + 2 * rng.standard_normal(model.n_outputs),
    )


def random_rules(rng, levels, m):
    return mampc.MoveRules(
        max_moves=[None, None, 1, 2, 3][rng.integers(5)], sparsity_horizon=int(rng.integers(1, 4)),
        price=float(rng.choice([0.0, 0.1, 1.0])), counting=str(rng.choice(["elementwise", "simultaneous"])),
        dwell=int(rng.choice([1, 1, 2])), max_moves_per_step=[None, 1][rng.integers(2)],
        min_size=float(rng.choice([0.0, 0.0, 1.1])), levels=levels,
    )  # fmt: skip


def brute_force(problem, rules, levels, x, past, reference, n_c):
    """The least objective of all courses on levels that keep limits and rules."""
    limits, best = problem.limits, np.inf
    for course in product(*[list(values) for _ in range(n_c) for values in levels]):
        plan = np.array(course).reshape(n_c, -1)
        changes = np.diff(np.vstack([past[-1:], plan]), axis=0)
        sizes = np.abs(changes)
        if (sizes > limits.du_max + 1e-9).any() or (
            (sizes > 0) & (sizes < np.asarray(rules.min_size) - 1e-9)
        ).any():
            continue
        if keeps_rules(rules, past, changes != 0) and keeps_timings(rules, problem, past, plan):
            best = min(best, objective_of(problem, rules, x, past, reference, plan))
    return best


def on_levels(plan, levels):
    return all(np.isin(plan[..., a], values).all() for a, values in enumerate(levels) if values is not None)


@pytest.mark.parametrize("seed", seeds(30, quick=12))
def test_no_course_on_the_levels_is_better(seed):
    m = 1 + seed % 2
    n_c = 3 if m == 2 else 5
    rng, problem, levels, x, past, reference = instance(seed, m, n_c, limited_outputs=seed % 3 == 0)
    rules = random_rules(rng, levels, m)
    controller = mampc.MAMPC(problem, rules)
    decision = controller.step(controller.initial_state(past), x, reference)
    best = brute_force(problem, rules, levels, x, past, reference, n_c)
    assert decision.status is Status.OPTIMAL
    assert on_levels(decision.plan, levels)
    assert decision.objective == pytest.approx(best, rel=1e-9)
    assert decision.gap == 0


@pytest.mark.parametrize("seed", seeds(12, quick=5))
def test_no_course_on_many_levels_is_better(seed):
    """These are searched pattern by pattern where moves have a price."""
    rng, problem, levels, x, past, reference = instance(seed, 1, 3, few=False)
    rules = random_rules(rng, levels, 1)
    controller = mampc.MAMPC(problem, rules)
    decision = controller.step(controller.initial_state(past), x, reference)
    assert decision.status is Status.OPTIMAL
    assert on_levels(decision.plan, levels)
    assert decision.objective == pytest.approx(
        brute_force(problem, rules, levels, x, past, reference, 3), rel=1e-9
    )


@pytest.mark.parametrize("seed", range(10))
def test_no_course_on_the_levels_is_better_where_outputs_have_zones(seed):
    m = 1 + seed % 2
    n_c = 3 if m == 2 else 5
    rng, problem, levels, x, past, reference = instance(seed, m, n_c, limited_outputs=seed % 3 == 0)
    problem = replace(
        problem,
        zone_below=0.4,
        zone_above=[0.7, np.inf][: problem.model.n_outputs],
    )
    rules = random_rules(rng, levels, m)
    controller = mampc.MAMPC(problem, rules)
    decision = controller.step(controller.initial_state(past), x, reference)
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(
        brute_force(problem, rules, levels, x, past, reference, n_c), rel=1e-9
    )


@pytest.mark.parametrize("zoned", [False, True])
@pytest.mark.parametrize("seed", seeds(20, quick=6))
def test_no_course_is_better_where_an_input_beside_levels_may_stay(seed, zoned):
    """Without a move of that input no program is solved: limits and zones of outputs count all the same."""
    rng, problem, levels, x, past, reference = instance(seed, 2, 2, limited_outputs=True)
    if zoned:
        problem = replace(problem, zone_below=0.4, zone_above=0.7)
    rules = mampc.MoveRules(price=float(rng.choice([0.05, 1.0])), levels=[levels[0], None])
    controller, program = mampc.MAMPC(problem, rules), program_of(problem, x, past[-1], reference)
    decision = controller.step(controller.initial_state(past), x, reference)
    best, n_violations = np.inf, len(program.f) - 4
    for course, beside in product(product(levels[0], repeat=2), product([False, True], repeat=2)):
        of_levels = np.diff([past[-1, 0], *course])
        pattern = np.array([of_levels[0] != 0, beside[0], of_levels[1] != 0, beside[1]])
        exactly = (
            np.array([of_levels[0], -np.inf, of_levels[1], -np.inf]),
            np.array([of_levels[0], np.inf, of_levels[1], np.inf]),
        )
        cost = best_on(program, pattern, n_violations, *exactly) + rules.price * pattern.sum()
        best = min(best, cost)
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(best, rel=1e-6)
    assert decision.objective == pytest.approx(
        objective_of(problem, rules, x, past, reference, decision.plan), rel=1e-7
    )


def first_order(u_max=10.0, dt=1.0):
    return mampc.StateSpace.from_first_order(gain=10.0 / u_max, time_constant=10.0, dead_time=0.0, dt=dt)


def on_off_problem(n, u_max=10.0, move_weight=1e-3):
    return mampc.TrackingProblem(
        first_order(u_max), prediction_horizon=n, control_horizon=n, move_weight=move_weight * (10 / u_max) ** 2,
        limits=mampc.Limits(u_min=0.0, u_max=u_max),
    )  # fmt: skip


TIMED = {
    "on off": {},
    "times": {"min_on": 3.0, "min_off": 2.0},
    "long off": {"min_off": 4.0},
    "starts": {"starts_per_hour": 2},
}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("timed", TIMED.values(), ids=TIMED)
def test_no_course_of_an_on_off_valve_is_better(timed, seed):
    rng = np.random.default_rng(seed)
    problem = on_off_problem(8)
    rules = mampc.MoveRules(levels=[mampc.OnOff(**timed)], price=float(rng.choice([0.0, 0.2])))
    past = np.repeat(rng.choice([0.0, 10.0], 4), rng.integers(1, 4, 4))[:, None]
    controller, x = mampc.MAMPC(problem, rules), rng.uniform(0, 10, 1) / problem.model.C[0, 0]
    reference = [rng.uniform(2, 9)]
    decision = controller.step(controller.initial_state(past), x, reference)
    best = brute_force(problem, rules, [[0.0, 10.0]], x, past, reference, 8)
    assert decision.objective == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize(
    "levels", [[0.0, 10.0], list(range(0, 11, examples(1, quick=2))), *deep([0.0, 4.0, 10.0])], ids=len
)
@pytest.mark.parametrize("rules", [{}, {"price": 0.1}, {"max_moves": 3}, {"price": 0.1, "dwell": 2}], ids=str)
def test_scip_finds_nothing_better(levels, rules):
    problem = on_off_problem(8)
    problem = replace(problem, limits=mampc.Limits(u_min=0.0, u_max=10.0, du_max=10.0, y_max=8.5))
    rules, x, reference = mampc.MoveRules(levels=[levels], **rules), np.array([5.0]), [7.3]
    controller = mampc.MAMPC(problem, rules)
    decision = controller.step(controller.initial_state([0.0]), x, reference)
    lower, upper = scip_on_levels(problem, rules, levels, x, [0.0], reference, 20.0)
    assert decision.status is Status.OPTIMAL
    assert decision.objective <= upper * (1 + 1e-6)
    assert decision.objective >= lower * (1 - 1e-6)


@pytest.mark.parametrize("n", [10, pytest.param(15, marks=pytest.mark.slow)])
@pytest.mark.parametrize("u_max", [10.0, 1e5])
def test_an_on_off_valve_holds_a_mean_between_its_levels(n, u_max):
    problem = on_off_problem(n, u_max)
    regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(levels=mampc.OnOff())))
    run = mampc.simulate(problem.model, regulator, [8.0], steps=120, noise=0.02, u_initial=[0.0])
    assert run.y[40:].mean() == pytest.approx(8.0, abs=0.1)
    assert set(run.u[:, 0].tolist()) == {0.0, u_max}
    assert set(run.statuses) == {"optimal"}


@pytest.mark.parametrize(
    ("timing", "held"), [({"min_on": 5.0, "min_off": 3.0}, 0.0), ({"starts_per_hour": 6}, 0.02)], ids=str
)
def test_timings_are_kept_in_closed_loop(timing, held):
    problem = on_off_problem(10)
    problem = replace(problem, model=first_order(dt=1.0))
    rules = mampc.MoveRules(levels=mampc.OnOff(**timing))
    regulator = mampc.Regulator(mampc.MAMPC(problem, rules))
    run = mampc.simulate(
        problem.model, regulator, [6.0], steps=examples(150, quick=75), noise=0.05, u_initial=[0.0]
    )
    assert keeps_timings(rules, problem, np.zeros((1, 1)), run.u)
    assert moved(run.u).any()


def loop_of(method, levels, *, settings=None, rules=None, m=2, **limits):
    model = random_model(5, n=3, m=m, l=2)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=8, control_horizon=3,
        limits=mampc.Limits(**({"u_min": -3.0, "u_max": 3.0} | limits)),
    )  # fmt: skip
    rules = mampc.MoveRules(levels=levels, **({"price": 0.05} if rules is None else rules))
    estimator = mampc.KalmanFilter.offset_free(model)  # the same for all methods
    return mampc.Regulator(mampc.MAMPC(problem, rules, method=method, **(settings or {})), estimator)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("levels", [[[-3, -1, 0, 2, 3], 0.5], [mampc.OnOff(), None]], ids=["levels", "mixed"])
def test_every_method_stays_on_levels_and_is_certified(method, levels):
    certify = {} if method == "exact" else {"certify": True}
    regulator = loop_of(method, levels, settings=METHODS[method] | certify)
    model = regulator.controller.problem.model
    reference = mampc.steps(examples(12, quick=5), model.y_op, [(3, model.y_op + 1.0)])
    run = mampc.simulate(model, regulator, reference, noise=0.1, u_initial=[0.0, 0.0])
    known = regulator.controller.levels.values
    assert on_levels(run.u, [None if v is None else v.tolist() for v in known])
    for decision in run.decisions[1:]:
        assert on_levels(decision.plan, known)
        assert decision.gap < np.inf
    exact = mampc.simulate(model, loop_of("exact", levels), reference[:1], noise=0.1, u_initial=[0.0, 0.0])
    assert run.decisions[0].objective >= exact.decisions[0].objective * (1 - 1e-9)


@pytest.mark.parametrize("rules", [{}, {"price": 0.1}, {"max_moves": 2}], ids=str)
def test_inputs_without_levels_beside_an_on_off_valve_are_best_for_it(rules):
    """For every course of the valve the best moves of the other input, by plain MPC with the valve held there."""
    regulator = loop_of("exact", [[-3, 0, 3], None], rules=rules, u_max=[3.0, 0.4])
    controller, rng = regulator.controller, np.random.default_rng(0)
    x, reference = rng.standard_normal(3), controller.problem.model.y_op + np.array([1.0, -2.0])
    decision = controller.step(controller.initial_state([0.0, 0.0]), x, reference)
    best, problem = np.inf, controller.problem
    sparse = mampc.MAMPC(problem, mampc.MoveRules(**(rules or {"max_moves": 6})))
    for course in product([-3.0, 0.0, 3.0], repeat=3):
        rows = np.array(course)
        limits = mampc.Limits(
            u_min=np.column_stack([rows, np.full(3, -3.0)]), u_max=np.column_stack([rows, np.full(3, 0.4)])
        )
        start = sparse.initial_state([0.0, 0.0])
        found = sparse.step(start, x, reference, limits=limits)
        if not found.held:
            best = min(best, found.objective)
    assert decision.status is Status.OPTIMAL
    assert decision.objective == pytest.approx(best, rel=1e-7)


def test_held_inputs_are_on_levels():
    regulator = loop_of("exact", 0.5)
    state = regulator.initial_state([0.3, -2.9])
    decision = regulator.step(state, [np.nan, np.nan], [0.0, 0.0])
    assert decision.held
    np.testing.assert_array_equal(decision.u, [0.5, -3.0])
    assert Remark.BACK_INSIDE in decision.remarks


def test_inputs_off_their_levels_go_to_one_at_once():
    regulator = loop_of("exact", [[-3, 0, 3], 0.5])
    y = regulator.controller.problem.model.y_op
    decision = regulator.step(regulator.initial_state([0.0, 0.0]), y, y, u_applied=[1.3, -0.7])
    assert Remark.BACK_INSIDE in decision.remarks
    assert on_levels(decision.plan, regulator.controller.levels.values)


def test_an_input_in_manual_is_planned_where_it_is():
    regulator = loop_of("exact", [[-3, 0, 3], 0.5])
    y = regulator.controller.problem.model.y_op
    manual = [True, False]
    decision = regulator.step(
        regulator.initial_state([0.0, 0.0]), y, y + 1.0, u_applied=[1.3, 0.0], manual=manual
    )
    np.testing.assert_array_equal(decision.plan[:, 0], 1.3)
    assert on_levels(decision.u, regulator.controller.levels.values)


def test_limits_of_a_sample_leave_the_levels_within_them():
    regulator = loop_of("exact", [[-3, -1, 0, 2, 3], 0.5])
    y, state = regulator.controller.problem.model.y_op, regulator.initial_state([3.0, 0.0])
    decision = regulator.step(state, y, y, limits=mampc.Limits(u_max=2.2))
    assert decision.u[0] <= 2.0
    assert on_levels(decision.plan, regulator.controller.levels.values)
    none = regulator.step(state, y, y, limits=mampc.Limits(u_min=[0.3, -3.0], u_max=[1.7, 3.0]))
    assert 0.3 <= none.u[0] <= 1.7  # where no level is within the limits these are kept


@pytest.mark.parametrize("levels", [0.5, [[-3, 0, 3], mampc.OnOff(min_on=2.0)]], ids=str)
def test_a_run_replays_and_comes_out_the_same_among_many(levels):
    regulator = loop_of("exact", levels)
    model = regulator.controller.problem.model
    reference = mampc.steps(15, model.y_op, [(3, model.y_op + 1.0)])
    run = mampc.simulate(model, regulator, reference, noise=0.1, u_initial=[-3.0, 3.0])
    state = regulator.initial_state([-3.0, 3.0], run.y[0])
    assert mampc.replay(loop_of("exact", levels), state, mampc.Recording.of(run)) is None
    batch = mampc.simulate_batch(model, regulator, reference, seeds=[0], noise=0.1, u_initial=[-3.0, 3.0])
    np.testing.assert_array_equal(batch.u[0], run.u)
    text = run.decisions[0]._replace(state=state).state.to_json()
    assert regulator.state_from_json(text).to_json() == text


@pytest.mark.parametrize("scale", [1e-6, 1e5])
@pytest.mark.parametrize("price", [0.0, 0.05])
def test_units_of_inputs_decide_nothing(scale, price):
    plans = []
    for size in (1.0, scale):
        model = random_model(5, n=3, m=2, l=2)
        model = replace(model, B=model.B / size, u_op=size * model.u_op)
        problem = mampc.TrackingProblem(
            model, prediction_horizon=8, control_horizon=3, move_weight=0.1 / size**2,
            limits=mampc.Limits(u_min=-3.0 * size, u_max=3.0 * size),
        )  # fmt: skip
        levels = [(size * np.array([-3.0, -1.0, 0.0, 2.0])).tolist(), 0.25 * size]
        controller = mampc.MAMPC(problem, mampc.MoveRules(levels=levels, price=price))
        decision = controller.step(controller.initial_state([0.0, 0.0]), [1.0, -1.0, 0.5], model.y_op + 1.0)
        plans.append(decision.plan / size)
    np.testing.assert_allclose(plans[0], plans[1], atol=1e-9)


def test_a_search_that_runs_out_of_time_says_what_it_has_not_proven():
    rng = np.random.default_rng(1)
    model = random_model(2, n=3, m=2, l=2)
    limits = mampc.Limits(u_min=model.u_op - 3, u_max=model.u_op + 3)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=8, limits=limits, move_weight=1e-4
    )
    controller = mampc.MAMPC(problem, mampc.MoveRules(levels=0.003), time_limit=0.05)
    decision = controller.step(
        controller.initial_state(np.round(model.u_op / 0.003) * 0.003),
        rng.standard_normal(3), model.y_op + 20 * rng.standard_normal(2),
    )  # fmt: skip
    assert decision.status in (Status.TIME_LIMIT, Status.FEASIBLE, Status.OPTIMAL)
    assert decision.lower_bound <= decision.objective
    assert decision.lower_bound > -np.inf
