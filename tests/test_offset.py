"""Prices and procrastination: what a price leaves, and that moves are not put off for ever."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import mampc
from builders import random_model
from mampc.controllers import offset
from referees import all_patterns, charge, keeps_rules
from seeds import seeds


def inverse_response(dt=0.25):
    """(1 - s) / (s + 1)^2: a step sends the output the wrong way first."""
    plant = signal.StateSpace(signal.TransferFunction([-1.0, 1.0], [1.0, 2.0, 1.0])).to_discrete(dt)
    return mampc.StateSpace(plant.A, plant.B, plant.C, None, dt)


def closed_loop(problem, rules, reference, steps):
    """Outputs and decisions with the plant as modelled, its state known, from rest at the operating point."""
    model, controller = problem.model, mampc.MAMPC(problem, rules, method="exact")
    state, x, outputs, decisions = controller.initial_state(), np.zeros(model.n_states), [], []
    for _ in range(steps):
        decisions.append(controller.step(state, x, reference))
        state = decisions[-1].state
        outputs.append(model.y_op + model.C @ x)
        x = model.A @ x + model.B @ (decisions[-1].u - model.u_op)
    return np.array(outputs), decisions


SHORT = {"prediction_horizon": 8, "control_horizon": 8, "move_weight": 0.1}


def test_with_a_short_horizon_the_best_plan_can_be_to_move_later_for_ever():
    problem = mampc.TrackingProblem(inverse_response(), **SHORT)
    y, decisions = closed_loop(problem, mampc.MoveRules(price=1.0), [1.0], 60)
    assert all(d.moves.any() and not d.moves[0].any() for d in decisions)
    assert (y == 0.0).all()


@pytest.mark.parametrize("tail", [5.0, 20.0, 100.0])
def test_a_tail_horizon_ends_procrastination(tail):
    problem = mampc.TrackingProblem(inverse_response(), tail_horizon=tail, **SHORT)
    y, decisions = closed_loop(problem, mampc.MoveRules(price=1.0), [1.0], 100)
    assert decisions[0].moves[0].any()
    assert abs(y[-1, 0] - 1.0) < 0.25
    assert not decisions[-1].moves.any()


def test_without_a_tail_horizon_nothing_is_promised():
    problem = mampc.TrackingProblem(inverse_response(), **SHORT)
    assert np.isinf(mampc.largest_offset(problem, mampc.MoveRules(price=1.0)))


@pytest.mark.parametrize("seed", seeds(25, quick=10))
def test_an_offset_that_stays_is_within_the_bound_of_its_price(seed):
    rng = np.random.default_rng(seed)
    model = random_model(seed, m=2, l=2, radius=rng.uniform(0.3, 0.8))
    problem = mampc.TrackingProblem(
        model,
        prediction_horizon=8,
        control_horizon=3,
        move_weight=0.01,
        output_weight=rng.uniform(0.5, 2, 2),
        tail_horizon=1e5,
    )
    price = float(10 ** rng.uniform(-2, 2))
    rules = mampc.MoveRules(price=price, counting=["elementwise", "simultaneous"][seed % 2])
    bound = mampc.largest_offset(problem, rules)
    assert np.isfinite(bound).all()
    # From far outside the bound, just outside and inside it.
    for size in (10.0, 1.05, 0.5):
        reference = model.y_op + size * bound * rng.choice([-1, 1], 2)
        y, decisions = closed_loop(problem, rules, reference, 150)
        assert not any(d.moves[0].any() for d in decisions[-20:])
        assert (np.abs(y[-1] - reference) <= bound * (1 + 1e-6)).all()


def test_a_smaller_price_or_a_longer_tail_promises_a_smaller_offset():
    def bound(price, tail):
        problem = mampc.TrackingProblem(inverse_response(), tail_horizon=tail, **SHORT)
        return mampc.largest_offset(problem, mampc.MoveRules(price=price))[0]

    assert bound(0.1, 50.0) < bound(1.0, 50.0)
    assert bound(1.0, 500.0) < bound(1.0, 50.0) < np.inf


@pytest.mark.parametrize(
    "rules", [{"max_moves": 1}, {"max_moves_per_step": 1}, {"min_size": 0.1}, {"blocks": (1, 2)}]
)
def test_rules_that_may_forbid_the_way_out_promise_nothing(rules):
    problem = mampc.TrackingProblem(
        random_model(1, radius=0.5), prediction_horizon=8, control_horizon=3, tail_horizon=100.0
    )
    assert np.isinf(mampc.largest_offset(problem, mampc.MoveRules(price=1.0, **rules))).all()


def counting(problem, price, noise, *, counts=True, **settings):
    controller = mampc.MAMPC(problem, mampc.MoveRules(price=price), **settings)
    return mampc.Regulator(
        controller, mampc.LoadBank(problem.model, noise=noise), value_of_information=counts
    )


def waiting_problem(seed, **settings):
    rng = np.random.default_rng(seed)
    m = int(rng.integers(1, 3))
    model = random_model(seed, m=m, l=int(rng.integers(1, m + 1)), radius=rng.uniform(0.3, 0.8))
    given = {"prediction_horizon": 8, "control_horizon": 3, "move_weight": 0.01, "tail_horizon": 50.0}
    return mampc.TrackingProblem(model, **(given | settings)), rng


@pytest.mark.parametrize("seed", seeds(25, quick=8))
def test_plans_that_wait_for_later_data_leave_no_more_than_the_regulator_says(seed):
    """Loads most likely steady, the state known: offsets from far outside the bound, about it and inside."""
    problem, rng = waiting_problem(seed, tail_horizon=float(10 ** np.random.default_rng(seed).uniform(1, 3)))
    model, price = problem.model, float(10 ** rng.uniform(-2, 1))
    regulator = counting(problem, price, 0.1)
    state, planner = regulator.initial_state(), regulator._planner
    likely, scale = 0.9 * np.eye(6)[0] + 0.1 * rng.dirichlet(np.ones(6)), 10 ** rng.uniform(-1, 1)
    estimate, weights = replace(state.estimate, weights=likely, scale=np.array([scale, 1.0])), likely * scale
    bound = regulator.largest_offset(state._replace(estimate=estimate))
    assert (bound >= mampc.largest_offset(problem, mampc.MoveRules(price=price)) * (1 - 1e-9)).all()
    for size in (5.0, 1.05, 0.8, 0.4):
        reference = model.y_op + size * bound * rng.choice([-1, 1], model.n_outputs)
        memory, x = planner.initial_state(), np.zeros(planner.problem.model.n_states)
        for _ in range(40):
            decision = planner.step(memory, x, reference, hypotheses=weights)
            memory, y = decision.state, model.y_op + model.C @ x[: model.n_states]
            x[: model.n_states] = model.A @ x[: model.n_states] + model.B @ (decision.u - model.u_op)
            settled = not decision.moves[0].any()
        assert settled
        assert (np.abs(y - reference) <= bound * (1 + 1e-6)).all()


@pytest.mark.parametrize("seed", seeds(12, quick=3))
def test_under_noise_and_steady_loads_the_mean_offset_is_within_it(seed):
    problem, rng = waiting_problem(seed)
    l = problem.model.n_outputs
    regulator = counting(problem, float(10 ** rng.uniform(-2, 0)), 0.1)
    bound = regulator.largest_offset()
    if np.isinf(bound).any():  # of a tail that is too short for any
        return
    for size in (0.9, 1.5):
        reference = np.tile(problem.model.y_op, (200, 1))
        reference[5:] += size * bound * rng.choice([-1, 1], l)
        batch = mampc.simulate_batch(
            problem.model, regulator, reference, noise=0.1, seeds=range(2), progress=False
        )
        assert (np.abs((batch.y - reference)[:, -60:].mean(axis=1)) <= bound + 0.1).all()


def lag():
    return mampc.StateSpace([[0.7]], [[0.3]], [[1.0]], None, 1.0)


def test_with_one_move_to_wait_for_it_is_what_a_sample_of_data_or_a_move_is_worth():
    """Of two samples and one input: e^2 ((L + 1) q - M) <= max(p, (L + 1) min(F, p)), F what no later move forgoes."""
    problem = mampc.TrackingProblem(lag(), prediction_horizon=9, control_horizon=2, tail_horizon=40.0)
    forgone = counting(problem, 1.0, 0.1)._planner.information.steady.charge(np.zeros(2, dtype=bool))
    for price in (forgone / 100, forgone / 2, 2 * forgone, 100 * forgone):
        plain = mampc.largest_offset(problem, mampc.MoveRules(price=price))
        times = max(1, 41 * min(forgone / price, 1))
        np.testing.assert_allclose(counting(problem, price, 0.1).largest_offset(), plain * np.sqrt(times))


@pytest.mark.parametrize(
    "rules",
    [{}, {"counting": "simultaneous"}, {"dwell": 2}, {"max_moves": 3, "sparsity_horizon": 2}],
    ids=["price", "simultaneous", "dwell", "budget"],
)
def test_it_is_the_largest_over_all_patterns_one_by_one(rules):
    problem = mampc.TrackingProblem(
        random_model(5, m=2, l=2, radius=0.7), prediction_horizon=8, control_horizon=3, tail_horizon=30.0
    )
    rules = mampc.MoveRules(price=0.05, **rules)
    regulator = mampc.Regulator(
        mampc.MAMPC(problem, rules), mampc.LoadBank(problem.model, noise=0.1), value_of_information=True
    )
    later_data, rest = regulator._planner.information.steady, np.tile(problem.model.u_op, (9, 1))
    cost = {
        pattern.tobytes(): charge(rules, pattern) + later_data.charge(pattern.ravel())
        for pattern in all_patterns(3, 2)
        if keeps_rules(rules, rest, pattern)
    }

    def least(pattern):
        """Of a pattern and of those that hold it."""
        return min(cost.get(p.tobytes(), np.inf) for p in all_patterns(3, 2) if (p | ~pattern).all())

    first = np.array([[True] * 2, [False] * 2, [False] * 2])
    of_waiting = max(
        least(first) - cost[p.tobytes()] + 30 * (least(np.roll(p, -1, axis=0)) - cost[p.tobytes()])
        for p in all_patterns(3, 2)
        if p.tobytes() in cost and not p[0].any()
    )
    alone = mampc.largest_offset(problem, rules)
    expected = alone * np.sqrt(of_waiting / charge(rules, first))
    np.testing.assert_allclose(regulator.largest_offset(), expected, rtol=1e-9)
    assert (expected > alone).all()


def test_plans_that_wait_do_leave_more_than_a_price_alone_and_nearly_all_of_the_bound():
    problem = mampc.TrackingProblem(lag(), prediction_horizon=9, control_horizon=2, tail_horizon=400.0)
    regulator = counting(problem, 0.2, 0.1)
    alone, bound = mampc.largest_offset(problem, mampc.MoveRules(price=0.2)), regulator.largest_offset()
    planner, later_data = regulator._planner, np.eye(6)[0]
    step = planner.initial_state(), np.zeros(planner.problem.model.n_states)
    for size, waits in ((1.01 * alone / bound, True), (0.95, True), (1.01, False)):
        decision = planner.step(*step, size * bound, hypotheses=later_data)
        assert decision.moves[0].any() is not waits
    assert bound > 2 * alone


def test_more_moves_than_can_be_listed_have_a_bound_no_smaller():
    problem, _ = waiting_problem(3)
    regulator = counting(problem, 0.3, 0.1)
    fine = regulator.largest_offset()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(offset, "FEW", 0)
        coarse = regulator.largest_offset()
    assert np.isfinite(coarse).all()
    assert (coarse >= fine).all()


def test_a_regulator_promises_what_its_controller_does_where_plans_do_not_wait():
    problem, rules = waiting_problem(3)[0], mampc.MoveRules(price=0.3)
    alone = mampc.largest_offset(problem, rules)
    np.testing.assert_allclose(counting(problem, 0.3, 0.1, counts=False).largest_offset(), alone)
    filtered = mampc.KalmanFilter.offset_free(problem.model)
    np.testing.assert_allclose(mampc.Regulator(mampc.MAMPC(problem, rules), filtered).largest_offset(), alone)
    np.testing.assert_allclose(mampc.Regulator(mampc.MPC(problem)).largest_offset(), 0.0)
    assert np.isinf(mampc.Regulator(mampc.MAMPC(problem, rules, method="greedy")).largest_offset()).all()
    variants = {
        "calm": mampc.MAMPC(problem, mampc.MoveRules(price=3.0)),
        "brisk": mampc.MAMPC(problem, rules),
    }
    dearest = mampc.largest_offset(problem, mampc.MoveRules(price=3.0))
    bank = mampc.Regulator(mampc.ControllerBank(variants), filtered)
    np.testing.assert_allclose(bank.largest_offset(), dearest)


def test_units_decide_nothing_of_what_plans_that_wait_may_leave():
    problem, _ = waiting_problem(3)
    model = problem.model
    of_u, of_y = 2.0 ** np.arange(-3, model.n_inputs - 3), 2.0 ** np.arange(4, model.n_outputs + 4)
    scaled = replace(
        model, B=model.B / of_u, C=model.C * of_y[:, None], D=model.D * of_y[:, None] / of_u,
        u_op=model.u_op * of_u, y_op=model.y_op * of_y,
    )  # fmt: skip
    other = replace(
        problem, model=scaled, output_weight=problem.output_weight / np.outer(of_y, of_y),
        move_weight=problem.move_weight / np.outer(of_u, of_u),
    )  # fmt: skip
    usual = counting(problem, 0.3, 0.1).largest_offset()
    np.testing.assert_allclose(counting(other, 0.3, 0.1 * of_y).largest_offset(), usual * of_y, rtol=1e-7)
