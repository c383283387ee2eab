"""Prices and procrastination: what a price leaves, and that moves are not put off for ever."""

import numpy as np
import pytest
from scipy import signal

import mampc
from builders import random_model
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
