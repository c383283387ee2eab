"""Plans in open loop as the literature states them: few moves, or few inputs, by l1 and by the exact count."""

from itertools import product

import cvxpy as cp
import numpy as np
import pytest

import mampc


def double_integrator():
    return mampc.StateSpace([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]], [[1.0, 0.0]], None, 1.0)


UNIT = mampc.Limits(u_min=-1.0, u_max=1.0)


def fewest(model, x0, steps, on):
    """The l0 optimum by trying all supports, smallest first."""
    n_moves = steps
    for count in range(n_moves + 1):
        for chosen in product([0, 1], repeat=n_moves):
            if sum(chosen) != count:
                continue
            u = cp.Variable(steps)
            z = u if on == "inputs" else cp.hstack([u[0], cp.diff(u)])
            x = x0
            for k in range(steps):
                x = model.A @ x + model.B[:, 0] * u[k]
            rows = [x == 0, cp.abs(u) <= 1, *(z[k] == 0 for k in range(steps) if not chosen[k])]
            program = cp.Problem(cp.Minimize(0), rows)
            program.solve(solver=cp.CLARABEL)
            if program.status == "optimal":
                return count
    return None


@pytest.mark.parametrize(("x0", "steps"), [((2.0, 0.0), 5), ((-1.0, 0.5), 4)])
def test_exact_counts_are_those_of_all_supports(x0, steps):
    model, x0 = double_integrator(), np.array(x0)
    off = mampc.rivals.hands_off(model, x0, steps=steps, limits=UNIT, norm="l0")
    few = mampc.rivals.minimum_attention(model, x0, steps=steps, limits=UNIT, norm="l0")
    assert off.nonzero == fewest(model, x0, steps, "inputs")
    assert few.nonzero == fewest(model, x0, steps, "moves")
    for plan in (off, few):
        np.testing.assert_allclose(plan.x[-1], 0.0, atol=1e-6)


def test_l1_and_l0_agree_on_the_double_integrator():
    """Maximum hands-off on a normal plant: the l1 optimum is bang-off-bang and as sparse as can be."""
    model = double_integrator()
    l1 = mampc.rivals.hands_off(model, [12.0, 0.0], steps=14, limits=UNIT)
    l0 = mampc.rivals.hands_off(model, [12.0, 0.0], steps=14, limits=UNIT, norm="l0")
    assert l1.nonzero == l0.nonzero
    assert l1.norm <= l0.norm + 1e-9
    assert l1.u[l1.nonzero // 2 : -(l1.nonzero // 2)] == pytest.approx(0.0, abs=1e-9)
