"""Ranks of outputs: limits and zones of a lower rank cost those of a higher one nothing."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import mampc
from builders import cost_of, random_model
from referees import objective_of


def torn(ranks, **changes):
    """One input that moves two outputs, whose limits or zones cannot both be kept."""
    model = mampc.StateSpace.from_first_order(gain=[[1.0], [0.7]], time_constant=[[6.0], [15.0]], dt=1.0)
    settings = {
        "prediction_horizon": 20, "control_horizon": 4, "move_weight": 0.01, "output_rank": ranks,
        "limits": mampc.Limits(y_min=[1.0, -np.inf], y_max=[np.inf, 0.2]),
    }  # fmt: skip
    return mampc.TrackingProblem(model, **settings | changes)


def decided(problem, reference=(0.0, 0.0), rules=None):
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    return controller.step(controller.initial_state(), np.zeros(problem.model.n_states), np.array(reference))


def test_a_limit_of_a_lower_rank_costs_one_of_a_higher_rank_nothing():
    for rules in (None, mampc.MoveRules(price=0.1)):
        alone = replace(torn(None), limits=mampc.Limits(y_min=[1.0, -np.inf]))
        best = decided(alone, rules=rules).violations[0]
        ranked, unranked = (decided(torn(r), rules=rules).violations for r in ([1, 2], None))
        assert ranked[0] == pytest.approx(best, abs=1e-6)
        assert unranked[0] > best + 0.05
        alone = replace(torn(None), limits=mampc.Limits(y_max=[np.inf, 0.2]))
        best = decided(alone, rules=rules).violations[1]
        assert decided(torn([2, 1]), rules=rules).violations[1] == pytest.approx(best, abs=1e-6)


def test_a_zone_of_a_lower_rank_costs_one_of_a_higher_rank_next_to_nothing():
    zones = {"limits": mampc.Limits(), "zone_below": 0.1, "zone_above": 0.1, "tail_horizon": 20.0}

    def settled(problem):
        y = mampc.targets(problem, reference=[1.0, -1.0]).y
        return np.maximum(np.abs(y - [1.0, -1.0]) - 0.1, 0.0)

    assert settled(torn([1, 2], **zones))[0] < 0.05
    assert settled(torn([2, 1], **zones))[1] < 0.05
    assert settled(torn(None, **zones)).min() > 0.3


def test_ranks_weigh_a_hundred_times_each_and_objectives_say_so():
    rules = mampc.MoveRules(price=0.1)
    for seed in range(6):
        model = random_model(seed, m=2, l=3)
        problem = mampc.TrackingProblem(
            model, prediction_horizon=6, control_horizon=3, output_rank=[1, 2, 2], output_limit_weight=10.0,
            limits=mampc.Limits(y_max=[model.y_op[0] + 0.5, np.inf, model.y_op[2]]), zone_below=[0.2, 0.1, 0.0],
        )  # fmt: skip
        np.testing.assert_array_equal(problem.output_limit_weights, [1000.0, 10.0, 10.0])
        sparse, x, reference = mampc.MAMPC(problem, rules), np.ones(model.n_states), model.y_op + 1.0
        state = sparse.initial_state()
        decision = sparse.step(state, x, reference)
        expected = objective_of(problem, rules, x, state.inputs, reference, decision.plan)
        assert decision.objective == pytest.approx(expected, rel=1e-8)
        assert decision.status == "optimal"
        mpc = mampc.MPC(problem)
        decision = mpc.step(mpc.initial_state(), x, reference)
        assert decision.objective == pytest.approx(
            cost_of(problem, x, model.u_op, reference, decision.plan), rel=1e-8
        )


def test_inputs_on_levels_are_proven_best_with_ranks_and_zones():
    levels = (-1.0, 0.0, 0.6, 1.4)
    rules = mampc.MoveRules(price=0.05, levels=[list(levels)])
    for changes in ({}, {"zone_below": 0.1, "zone_above": [0.1, 0.0]}):
        for ranks in ([1, 2], [2, 1]):
            problem = torn(ranks, control_horizon=3, output_limit_weight=20.0, **changes)
            sparse, reference = mampc.MAMPC(problem, rules), np.array([1.0, 0.5])
            state, x = sparse.initial_state(), np.full(problem.model.n_states, 0.1)
            decision = sparse.step(state, x, reference)
            every = [np.array(course)[:, None] for course in product(levels, repeat=3)]
            costs = [objective_of(problem, rules, x, state.inputs, reference, plan) for plan in every]
            assert decision.status == "optimal"
            assert decision.objective == pytest.approx(min(costs), rel=1e-8)


def test_equal_ranks_are_none():
    assert decided(torn([3, 3])).objective == decided(torn(None)).objective


@pytest.mark.parametrize(
    ("ranks", "said"),
    [
        ([1], "output_rank: expected a scalar or 2 values"),
        ([0, 1], "output_rank: expected whole numbers of at least 1"),
        ([1, 1.5], "output_rank: expected whole numbers of at least 1"),
        ("first", "output_rank: expected real numbers"),
        ([1, 4], "of at most 1e\\+08"),
    ],
)
def test_bad_ranks_are_refused_with_what_was_expected(ranks, said):
    with pytest.raises(mampc.MampcError, match=said):
        torn(ranks)
