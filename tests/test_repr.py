"""What is printed of problems, rules, controllers and decisions fits one screen, whatever their size."""

import numpy as np
import pytest

import mampc
from builders import random_model, tank_problem


def large_problem():
    model = random_model(0, n=30, m=20, l=20)
    limits = mampc.Limits(u_min=-np.arange(1.0, 21.0), u_max=model.u_op + 9, y_max=model.y_op + 3)
    weight = np.eye(20) + 0.1
    return mampc.TrackingProblem(
        model, prediction_horizon=40, control_horizon=8, output_weight=weight, limits=limits
    )


@pytest.mark.parametrize("problem", [tank_problem(), large_problem()], ids=["tank", "large"])
def test_what_is_printed_fits_one_screen(problem):
    m = problem.model.n_inputs
    rules = mampc.MoveRules(max_moves=2, sparsity_horizon=3, price=np.linspace(0.1, 0.2, m))
    controllers = mampc.MPC(problem), mampc.MAMPC(problem, rules, method="greedy")
    printed = [problem, problem.limits, rules, *controllers]
    for controller in controllers:
        x = np.zeros(problem.model.n_states)
        printed.append(controller.step(controller.initial_state(), x, problem.model.y_op + 1))
        printed.append(controller.step(controller.initial_state(), x * np.nan, problem.model.y_op))
    for thing in printed:
        assert repr(thing).startswith(f"{type(thing).__name__}(")
        assert len(repr(thing)) < 80 * 20
        assert "\n" not in repr(thing)


def test_only_what_was_set_is_printed():
    assert repr(mampc.Limits(u_min=0.0, u_max=[1.0, 2.0])) == "Limits(u_min=0, u_max=[1., 2.])"
    assert repr(mampc.MoveRules(price=0.5)) == "MoveRules(price=0.5)"
    assert repr(mampc.Limits(u_min="low")) == "Limits(u_min='low')"
    assert repr(mampc.Limits(u_max=np.ones((3, 2)))).startswith("Limits(u_max=[[1., 1.]")  # over the horizon


def test_a_decision_is_equal_to_itself_alone():
    controller = mampc.MPC(tank_problem())
    decisions = [
        controller.step(controller.initial_state(), np.zeros(4), controller.problem.model.y_op)
        for _ in range(2)
    ]
    assert decisions[0] == decisions[0]
    assert decisions[0] != decisions[1]
    assert len(set(decisions)) == 2
