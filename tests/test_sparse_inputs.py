"""Few inputs off their steady target at a time."""

from itertools import product

import cvxpy as cp
import numpy as np
import pytest

import mampc
from builders import random_problem, tank_model, tank_problem
from mampc import rivals


@pytest.mark.parametrize("seed", range(6))
def test_few_inputs_at_each_instant_are_the_best_of_all_patterns(seed):
    problem, x, reference, u = random_problem(seed, control_horizon=2)
    controller = rivals.SparseInputs(problem, most=1)
    decision = controller.step(controller.initial_state(u), x, reference)
    parameter = controller.condensed.parameter.vector(x, u, reference)
    u_s = mampc.program.steady.SteadyTarget(problem, controller.condensed.parameter).at(parameter).u
    condensed = controller.condensed
    sample = condensed.sample(parameter, u)
    best = np.inf
    for pattern in product([(True, False), (False, True)], repeat=2):
        plan = cp.Variable((2, 2))
        d = cp.hstack([plan[0] - u, plan[1] - plan[0]])
        cost = cp.sum_squares(condensed.U @ d - sample.target) + sample.cost
        rows = [plan >= np.tile(problem.limits.u_min, (2, 1)), plan <= np.tile(problem.limits.u_max, (2, 1))]
        rows += [plan[j][a] == u_s[a] for j in range(2) for a in range(2) if not pattern[j][a]]
        program = cp.Problem(cp.Minimize(cost), rows)
        best = min(best, program.solve(solver=cp.CLARABEL))
    assert decision.objective == pytest.approx(best, rel=1e-6)
    assert ((np.abs(decision.plan - u_s) > 1e-9).sum(axis=1) <= 1).all()


def test_small_inputs_move_beside_large_ones():
    def changes(scale):
        model = tank_model()
        other = mampc.StateSpace(
            model.A, model.B / scale, model.C, model.D / scale, model.dt, model.u_op * scale, model.y_op
        )
        problem = tank_problem(other, limits=mampc.Limits(), move_weight=0.1 / scale**2)
        controller = rivals.SparseInputs(problem, most=1)
        return controller.step(controller.initial_state(), np.zeros(4), [34.0, 28.0]).changes / scale

    np.testing.assert_allclose(changes(np.array([1e-9, 1e6])), changes(np.ones(2)), rtol=1e-6, atol=1e-6)
