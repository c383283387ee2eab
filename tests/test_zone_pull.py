"""What draws outputs into their zones: the cost against referees, the edge that moves no longer stop at, and units."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import cost_of, random_model
from referees import (
    assert_best_of_all_patterns,
    objective_of,
)
from seeds import seeds

INF = np.inf


def random_problem(seed, **changes):
    """Zones of several kinds with a pull; a state and a reference."""
    rng = np.random.default_rng(seed)
    model = random_model(seed, m=2, l=2)
    limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + 1) if seed % 2 else mampc.Limits()
    settings = {
        "prediction_horizon": 7, "control_horizon": 3, "limits": limits, "output_weight": rng.uniform(0.5, 2, 2),
        "zone_below": [0.5, [0.3, 0.0, INF][seed % 3]], "zone_above": [[0.2, INF][seed % 2], [0.1, 0.0][seed % 2]],
        "zone_pull": [0.03, 0.3][seed % 2],
    }  # fmt: skip
    problem = mampc.TrackingProblem(model, **settings | changes)
    return problem, rng.standard_normal(model.n_states), model.y_op + 2 * rng.standard_normal(2), rng


@pytest.mark.parametrize("seed", seeds(12, quick=3))
def test_the_exact_optimum_is_that_of_brute_force(seed):
    for rules in (mampc.MoveRules(price=0.2), mampc.MoveRules(price=0.05, max_moves=2, sparsity_horizon=2)):
        problem, x, reference, _ = random_problem(seed)
        assert_best_of_all_patterns(problem, rules, x, reference)


@pytest.mark.parametrize("seed", seeds(12, quick=4))
def test_a_zone_told_draws_to_its_middle_or_inside_its_only_end(seed):
    problem, x, reference, rng = random_problem(seed)
    mpc = mampc.MPC(problem)
    zoned = problem.zoned
    below, above = rng.uniform(0, 1, (2, problem.prediction_horizon + 1, 2)) * zoned
    below[2:4, 0] = INF
    above[4:, 0] = INF
    told = mampc.Zone(reference - below, reference + above)
    decision = mpc.step(mpc.initial_state(), x, told)
    cost = cost_of(problem, x, problem.model.u_op, told, decision.plan)
    assert decision.objective == pytest.approx(cost, rel=1e-8)
    for _ in range(5):  # no plan nearby costs less
        limits = problem.limits.checked(2, 2)
        other = np.clip(decision.plan + 0.05 * rng.standard_normal((3, 2)), limits.u_min, limits.u_max)
        assert cost_of(problem, x, problem.model.u_op, told, other) >= cost * (1 - 1e-9)


def test_what_is_drawn_fully_is_a_set_point():
    for seed in range(4):
        problem, x, reference, _ = random_problem(seed, zone_pull=1 - 1e-8, tail_horizon=5.0)
        point = replace(problem, zone_below=0.0, zone_above=0.0)
        expected, own = (
            one.step(one.initial_state(), x, reference) for one in (mampc.MPC(point), mampc.MPC(problem))
        )
        np.testing.assert_allclose(own.plan, expected.plan, atol=0.1)
        assert own.objective == pytest.approx(expected.objective, rel=0.05)


@pytest.mark.parametrize("method", mampc.METHODS)
def test_every_method_plans_with_a_pull_and_can_be_certified(method):
    settings = {} if method == "exact" else {"certify": True}
    if method == "alternating":
        settings |= {"warm_up": 0}
    rules = mampc.MoveRules(price=0.1, max_moves=4, sparsity_horizon=2)
    problem, x, reference, _ = random_problem(2)
    sparse, exact = mampc.MAMPC(problem, rules, method=method, **settings), mampc.MAMPC(problem, rules)
    best = exact.step(exact.initial_state(), x, reference).objective
    decision = sparse.step(sparse.initial_state(), x, reference)
    past = sparse.initial_state().inputs
    assert decision.objective == pytest.approx(
        objective_of(problem, rules, x, past, reference, decision.plan)
    )
    assert decision.lower_bound == pytest.approx(best, rel=1e-8)


def lag(pull, rules):
    model = mampc.StateSpace.from_first_order(gain=[[1.0]], time_constant=[[8.0]], dt=1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=3, tail_horizon=20.0, move_weight=0.01,
        limits=mampc.Limits(u_min=-10.0, u_max=10.0), zone_below=0.2, zone_above=0.2, zone_pull=pull,
    )  # fmt: skip
    return model, mampc.Regulator(mampc.MAMPC(problem, rules), mampc.LoadBank(model, noise=0.01))


def test_a_move_that_is_made_goes_to_the_middle_and_not_to_the_edge():
    leads_to = []
    for pull in (0.0, 0.03):
        _, regulator = lag(pull, mampc.MoveRules(price=0.1))
        decision = regulator.controller.step(
            regulator.controller.initial_state(), np.zeros(1), [0.0], output_disturbance=np.array([1.0])
        )
        assert decision.moves.sum() <= 2
        leads_to.append(1.0 + decision.plan[-1, 0])
    assert abs(leads_to[0]) > 0.15  # to the far edge, since that is quicker
    assert abs(leads_to[1]) < 0.1


def test_inside_the_zone_a_price_keeps_the_pull_from_moving_anything():
    model, regulator = lag(0.03, mampc.MoveRules(price=0.1))
    run = mampc.simulate(model, regulator, [0.0], steps=60, noise=0.02, output_disturbance=[0.1])
    assert run.metrics(threshold=1e-9).moves.sum() == 0


def test_batches_make_the_same_moves():
    for rules in (None, mampc.MoveRules(price=0.1)):
        model, regulator = lag(0.1, mampc.MoveRules(price=0.1))
        if rules is None:
            regulator = mampc.Regulator(mampc.MPC(regulator.controller.problem))
        low = np.zeros((20, 1)) - 0.2
        high = low + np.where(np.arange(20) < 10, 0.5, INF)[:, None]
        for asked in ([0.1], mampc.Zone(low, high)):
            batch = mampc.simulate_batch(
                model, regulator, asked, steps=20, seeds=[0, 1], noise=0.1, progress=False
            )
            for seed in range(2):
                run = mampc.simulate(model, regulator, asked, steps=20, seed=seed, noise=0.1)
                np.testing.assert_allclose(batch.u[seed], run.u, atol=1e-8)


@pytest.mark.parametrize(("u", "y"), [(1e-6, 1e3), (1e5, 1e-5)])
def test_units_decide_nothing(u, y):
    def decided(u, y, seed):
        rng, usual = np.random.default_rng(seed), random_model(seed, m=2, l=2)
        model = mampc.StateSpace(
            usual.A, usual.B / u, usual.C * y, usual.D * y / u, 1.0, usual.u_op * u, usual.y_op * y
        )
        problem = mampc.TrackingProblem(
            model, prediction_horizon=8, control_horizon=3, output_weight=1 / y**2, move_weight=0.1 / u**2,
            limits=mampc.Limits(u_min=model.u_op - u, u_max=model.u_op + u), tail_horizon=4.0,
            zone_below=[0.3 * y, INF], zone_above=0.1 * y, zone_pull=0.1,
        )  # fmt: skip
        sparse = mampc.MAMPC(problem, mampc.MoveRules(price=0.1))
        x, reference = rng.standard_normal(3), model.y_op + 2 * y * rng.standard_normal(2)
        decision = sparse.step(sparse.initial_state(), x, reference)
        return decision.changes / u, decision.objective

    for seed in range(3):
        for usual, other in zip(decided(1.0, 1.0, seed), decided(u, y, seed), strict=True):
            np.testing.assert_allclose(other, usual, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("pull", [-0.1, 1.0, np.nan])
def test_other_shares_are_refused(pull):
    with pytest.raises(mampc.MampcError, match="zone_pull: expected"):
        random_problem(0, zone_pull=pull)
