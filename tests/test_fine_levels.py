"""Inputs on levels that are fine beside the price of a move are searched by patterns, others by courses."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import mampc
from builders import random_model
from mampc import Status
from mampc.methods.exact import ranking, search
from mampc.moves import level_search
from mampc.moves.last_first import LastFirst, _least_squares
from referees import objective_of
from seeds import seeds
from test_levels import instance, random_rules


def case(seed):
    """Levels of all kinds, a free input among them, every rule and a price; outputs with limits in turn."""
    rng = np.random.default_rng(1000 + seed)
    m = int(rng.integers(1, 4))
    n_c = int(rng.integers(2, 5 if m < 3 else 3))
    own, problem, levels, x, past, reference = instance(
        seed, m, n_c, limited_outputs=seed % 2 == 0, few=rng.random() < 0.7
    )
    rules = replace(random_rules(own, levels, m), price=float(10 ** rng.uniform(-2, 0.5)))
    entries = list(rules.levels)
    if rng.random() < 0.25:
        times = rng.integers(0, 3, 2).astype(float)
        entries[0] = mampc.OnOff(off=-3.0, on=3.0, min_on=times[0], min_off=times[1])
        past[:, 0] = rng.choice([-3.0, 3.0])
    if m > 1 and seed % 4 < 2:
        entries[-1], past[:, -1] = None, rng.uniform(-3, 3)
        rules = replace(rules, min_size=0.0)
    return problem, replace(rules, levels=entries), x, past, reference


def decided(problem, rules, x, past, reference):
    controller = mampc.MAMPC(problem, rules, method=mampc.Exact(time_limit=None))
    return controller.step(controller.initial_state(past), x, reference)


@pytest.mark.parametrize("seed", seeds(120, quick=16))
def test_patterns_and_courses_have_the_same_optimum(seed, monkeypatch):
    found = []
    monkeypatch.setattr(level_search, "MANY", 0)
    for fine, largest in ((0.0, None), (np.inf, ranking.LARGEST_TABLE), (np.inf, 0)):
        monkeypatch.setattr(search, "FINE", fine)
        if largest is not None:
            monkeypatch.setattr(ranking, "LARGEST_TABLE", largest)
        found.append(decided(*case(seed)))
    assert {decision.status for decision in found} == {Status.OPTIMAL}
    for decision in found[1:]:
        assert decision.objective == pytest.approx(found[0].objective, rel=1e-9)
    problem, rules, x, past, reference = case(seed)
    for decision in found:
        cost = objective_of(problem, rules, x, past, reference, decision.plan)
        assert decision.objective == pytest.approx(cost, rel=1e-7)


@pytest.mark.parametrize("seed", seeds(300, quick=40))
def test_courses_decided_from_either_end_have_the_same_optimum(seed, monkeypatch):
    """With inputs between levels, limits of the moment and blocks among the rules; cut short, with a bound on it."""
    monkeypatch.setattr(search, "FINE", 0.0)
    rng = np.random.default_rng(seed)
    problem, rules, x, past, reference = case(seed)
    rules = replace(rules, counting="elementwise", max_moves_per_step=None)
    if seed % 3 == 0:
        past = past + 0.01 * rng.standard_normal(past.shape)
    limits = None
    if seed % 5 < 2:  # of one sample, at once or over the horizon
        lower = rng.uniform(0, 1 + 2 * (seed % 5), (problem.control_horizon, 1) if seed % 5 else ())
        limits = replace(problem.limits, u_max=problem.limits.u_max - lower)
    found, run = [], LastFirst.run
    for most in (None, 0, 3, 100, np.inf):

        def searched(self, deadline, _, keeps, most=most):
            return None if most is None else run(self, deadline, most, keeps)

        monkeypatch.setattr(LastFirst, "run", searched)
        controller = mampc.MAMPC(problem, rules, method=mampc.Exact(time_limit=None))
        found.append(controller.step(controller.initial_state(past), x, reference, limits=limits))
    forward, *short, complete = found
    assert complete.status is forward.status
    assert complete.objective == pytest.approx(forward.objective, rel=1e-9, nan_ok=True)
    if not np.isfinite(forward.objective):  # no plan
        return
    for decision in short:
        assert decision.lower_bound <= forward.objective * (1 + 1e-9)
        assert decision.objective >= forward.objective * (1 - 1e-9)


@pytest.mark.parametrize("seed", seeds(300, quick=30))
def test_what_single_jumps_leave_is_no_more_than_the_truth_where_squares_cancel(seed):
    rng = np.random.default_rng(seed)
    p, inputs, nodes = int(rng.integers(2, 120)), int(rng.integers(1, 4)), 5
    jumps = [np.cumsum(rng.standard_normal((p, 6)), axis=0) for _ in range(inputs)]
    size = rng.uniform(-3, 3, (nodes, inputs))
    at = rng.integers(6, size=inputs)
    made = sum(size[:, a, None] * jumps[a][:, at[a]] for a in range(inputs))
    rest = (made + 10.0 ** rng.uniform(-12, 0) * rng.standard_normal((nodes, p)))[:, None]
    truth = np.full(nodes, np.inf, dtype=np.longdouble)
    for times in product(range(6), repeat=inputs):
        left = rest[:, 0].astype(np.longdouble)
        for a, t in enumerate(times):
            left = left - np.longdouble(size[:, a, None]) * jumps[a][:, t]
        truth = np.minimum(truth, np.square(left).sum(axis=1))
    found = _least_squares(rest, size, jumps)[:, 0]
    sizes = np.square(rest[:, 0]).sum(axis=1) + sum(
        size[:, a] ** 2 * np.square(jumps[a]).sum(axis=0).max() for a in range(inputs)
    )
    assert (found <= truth).all()
    assert (found >= truth - 1e-12 * sizes).all()


def test_coarse_levels_of_three_inputs_with_a_price_are_proven_in_few_nodes(monkeypatch):
    visited, run = [], LastFirst.run
    monkeypatch.setattr(LastFirst, "run", lambda *of: visited.append(run(*of)) or visited[-1])
    controller, x, reference = three_inputs(0.5)
    decision = controller.step(controller.initial_state(), x, 0.2 * np.array(reference))
    assert decision.status is Status.OPTIMAL
    assert visited[0].visited < 20_000


def three_inputs(levels, size=1.0):
    """Three inputs in a unit that is `size` of another, far from their references."""
    model = mampc.StateSpace.from_first_order(
        gain=np.array([[2.0, -0.7, 0.3], [0.5, 1.5, -0.4], [-0.3, 0.4, 1.2]]) / size,
        time_constant=[[120, 200, 80], [90, 150, 60], [100, 70, 180]], dt=10.0,
    )  # fmt: skip
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=8, move_weight=0.01 / size**2,
        limits=mampc.Limits(u_min=-5.0 * size, u_max=5.0 * size),
    )  # fmt: skip
    controller = mampc.MAMPC(
        problem, mampc.MoveRules(levels=levels * size, price=0.3), method=mampc.Exact(time_limit=None)
    )
    return controller, np.zeros(model.n_states), [2.0, -1.0, 1.5]


def test_fine_levels_of_three_inputs_are_proven_in_few_programs():
    controller, x, reference = three_inputs(0.05)
    decision = controller.step(controller.initial_state(), x, reference)
    assert decision.status is Status.OPTIMAL
    assert decision.iterations < 50
    assert np.allclose(decision.plan / 0.05, np.round(decision.plan / 0.05), atol=1e-9)


@pytest.mark.parametrize("size", [1e-5, 1e4])
def test_units_of_inputs_decide_nothing(size):
    plans = []
    for unit in (1.0, size):
        controller, x, reference = three_inputs(0.1, unit)
        plans.append(controller.step(controller.initial_state(), x, reference).plan / unit)
    np.testing.assert_allclose(*plans, atol=1e-9)


def test_coarse_levels_are_searched_by_courses():
    model = random_model(2, n=3, m=2, l=2)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=8, control_horizon=3,
        limits=mampc.Limits(u_min=model.u_op - 3, u_max=model.u_op + 3),
    )  # fmt: skip
    for levels, price, by_table in ((mampc.OnOff(), 0.1, False), (1e-4, 0.1, True), (1e-4, 0.0, False)):
        controller = mampc.MAMPC(problem, mampc.MoveRules(levels=levels, price=price))
        assert controller._search.has_table is by_table


@pytest.mark.parametrize("price", [0.0, 0.5])
def test_an_input_does_not_stay_where_a_later_limit_forbids_it(price):
    """Beside all courses one by one: in steady state to stay costs nothing, and breaks a limit two samples ahead."""
    model = mampc.StateSpace.from_first_order(gain=2.0, time_constant=50.0, dead_time=0.0, dt=10.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=4, limits=mampc.Limits(u_min=1.0, u_max=5.0)
    )
    rules, past = mampc.MoveRules(levels=1.0, price=price), np.array([[3.0]])
    x = model.steady_state(past[0])
    reference, highest = model.y_op + model.C @ x, np.array([[5.0], [5.0], [2.0], [2.0]])
    controller = mampc.MAMPC(problem, rules)
    decision = controller.step(
        controller.initial_state(past), x, reference, limits=mampc.Limits(u_max=highest)
    )
    least = min(
        objective_of(problem, rules, x, past, reference, np.array(course)[:, None])
        for course in product(range(1, 6), repeat=4)
        if (np.array(course) <= highest[:, 0]).all()
    )
    assert decision.status is Status.OPTIMAL
    assert (decision.plan <= highest).all()
    assert decision.objective == pytest.approx(least, rel=1e-9)
