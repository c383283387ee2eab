"""Tree and table: two bookkeepings of one search prove the same."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import random_model
from mampc import Status
from mampc.methods.exact import ranking
from seeds import seeds
from test_tree import priced_case


def decide(problem, rules, x, reference):
    controller = mampc.MAMPC(problem, rules, method=mampc.Exact(time_limit=60.0))  # on a busy machine
    return controller.step(controller.initial_state(), x, reference)


def drawn_case(seed, scale_u=1.0):
    """A problem, any rules that patterns compete under, and what is asked; inputs in other units."""
    rng = np.random.default_rng([seed, 77])
    m, n_c = [(2, 4), (2, 5), (3, 3), (1, 9)][seed % 4]
    model = random_model(seed, n=3, m=m, l=2)
    rules = mampc.MoveRules(
        price=10.0 ** rng.uniform(-2, 1) * (seed % 3 > 0), counting=["elementwise", "simultaneous"][seed % 5 == 1],
        dwell=1 + (seed % 7 == 2), max_moves=int(rng.integers(1, 6)) if seed % 3 == 0 or seed % 2 else None,
        max_moves_per_step=1 if seed % 6 == 4 else None,
    )  # fmt: skip
    below, above, du_max = rng.uniform(0.2, 1.5, 3)
    limits = mampc.Limits(
        du_max=scale_u * du_max if seed % 8 < 4 else None, u_min=(model.u_op - below) * scale_u,
        u_max=(model.u_op + above) * scale_u, y_max=model.y_op + 1 if seed % 4 == 1 else None,
    )  # fmt: skip
    scaled = mampc.StateSpace(
        model.A, model.B / scale_u, model.C, None, 1.0, model.u_op * scale_u, model.y_op
    )
    problem = mampc.TrackingProblem(
        scaled, prediction_horizon=n_c + 3, control_horizon=n_c, output_limit_weight=10.0,
        move_weight=10.0 ** rng.uniform(-3, 0) * scale_u**-2.0, limits=limits,
    )  # fmt: skip
    return problem, rules, rng.standard_normal(3), model.y_op + 3 * rng.standard_normal(2)


@pytest.mark.parametrize("seed", seeds(400, quick=40))
def test_the_tree_proves_what_the_table_does_in_any_units(seed, monkeypatch):
    by_table = decide(*drawn_case(seed))
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)
    for scale in (1.0, [1e-4, 1e3][seed % 2]):
        by_tree = decide(*drawn_case(seed, scale))
        assert by_tree.status is by_table.status is Status.OPTIMAL
        assert by_tree.objective == pytest.approx(by_table.objective, rel=1e-7)


def sized_case(seed):
    """A case with least sizes and a price, mostly nearer to where it should be."""
    rng = np.random.default_rng([seed, 9])
    problem, rules, x, reference = drawn_case(seed, (1.0, 1e-4, 1e3)[seed % 3])
    limits, m = problem.limits, problem.model.n_inputs
    most = np.minimum(limits.u_max - limits.u_min, limits.du_max)
    size = rng.uniform(0.02, (0.3, 0.9)[seed % 2], m) * most * (rng.random(m) < 0.8)
    price = rules.price if rng.random() < 0.3 else 10.0 ** rng.uniform(-2, 0.5)
    if rng.random() < 0.6:
        x, reference = 0.1 * x, problem.model.y_op + rng.uniform(0, 0.4) * (reference - problem.model.y_op)
    return problem, replace(rules, min_size=size, price=price), x, reference


@pytest.mark.parametrize("seed", [136, 140, 320, 321, 374, 416, 435, 526, *seeds(100, quick=4)])
def test_least_sizes_are_proven_alike_by_table_and_tree(seed, monkeypatch):
    by_table = decide(*sized_case(seed))
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)
    by_tree = decide(*sized_case(seed))
    assert by_tree.status is by_table.status is Status.OPTIMAL
    assert by_tree.objective == pytest.approx(by_table.objective, rel=1e-9)


@pytest.mark.parametrize("seed", seeds(60, quick=10))
def test_no_plan_of_the_last_sample_changes_the_optimum(seed, monkeypatch):
    """A tree tries its pattern first, whatever it is: moves that the rules forbid too."""
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)
    problem, rules, x, reference = priced_case(seed)
    controller, rng = mampc.MAMPC(problem, rules), np.random.default_rng(seed)
    state = controller.initial_state()
    decision = controller.step(state, x, reference)
    assert decision.status is Status.OPTIMAL
    np.testing.assert_array_equal(decision.state.guess[:-1], decision.changes[1:])
    for guess in (decision.changes, rng.standard_normal(decision.changes.shape), np.zeros((4, 2))):
        again = controller.step(state._replace(guess=guess), x, reference)
        assert again.status is Status.OPTIMAL
        assert again.objective == pytest.approx(decision.objective, rel=1e-9)
