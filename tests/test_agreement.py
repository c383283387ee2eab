"""Whatever a decision came from: its plan, changes, moves and objective are of one and the same plan."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import mampc
from builders import cost_of_inputs, distance, fading, predicted, random_model, violation_scale
from mampc import Remark
from referees import charge
from seeds import examples

SETTINGS = {
    "alternating": {"polish": True, "warm_up": 0}, "as in the paper": {"warm_up": 1},
    "admm": {"starts": 3, "iterations": 10}, "reweighted_l1": {"reweightings": 1, "bisections": 6},
}  # fmt: skip
METHODS = ["mpc", "as in the paper", *mampc.METHODS]
SEEDS = range(examples(40, quick=12))


def random_limits(rng, model, n_c):
    m, l = model.n_inputs, model.n_outputs

    def some(share, values):
        return values if rng.random() < share else None

    return mampc.Limits(
        u_min=some(0.8, model.u_op - rng.uniform(0.1, 1.5, m)),
        u_max=some(0.8, model.u_op + rng.uniform(0.1, 1.5, m)),
        du_max=some(0.4, rng.uniform(0.05, 0.8, m)),
        y_min=some(0.3, model.y_op - rng.uniform(0.1, 2.0, l)),
        y_max=some(0.3, model.y_op + rng.uniform(0.1, 2.0, l)),
    )


def random_rules(rng):
    return mampc.MoveRules(
        max_moves=[None, 0, 1, 3, 5][rng.integers(5)],
        sparsity_horizon=int(rng.integers(1, 5)),
        price=rng.choice([0.0, 0.05, 0.5]),
        counting=str(rng.choice(["elementwise", "simultaneous"])),
        dwell=int(rng.choice([1, 1, 2, 3])),
        max_moves_per_step=[None, None, 1][rng.integers(3)],
        min_size=float(rng.choice([0.0, 0.0, 0.05])),
    )


def random_controller(seed, method):
    rng = np.random.default_rng(seed)
    m, l, n = (int(size) for size in rng.integers(1, 4, 3))
    model = random_model(seed, n, m, l, feedthrough=rng.random() < 0.3, radius=rng.choice([0.5, 0.9, 1.02]))
    n_c = int(rng.integers(1, 5))
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_c + int(rng.integers(0, 6)), control_horizon=n_c,
        move_weight=float(rng.choice([0.01, 0.1, 1.0])), limits=random_limits(rng, model, n_c),
        tail_horizon=float(rng.choice([0.0, 0.0, 3.0])), weigh_first_move=m > 1 or rng.random() < 0.5,
        output_limit_weight=float(rng.choice([10.0, 1e4])),
    )  # fmt: skip
    problem = with_more(np.random.default_rng([seed, 1]), problem)
    rules = random_rules(rng)
    if method == "mpc":
        return rng, mampc.MPC(problem), mampc.MoveRules()
    limits = problem.limits
    if min(limits.du_max.min(), (limits.u_max - limits.u_min).min()) < 0.05:
        rules = mampc.MoveRules(price=0.1)
    name = "alternating" if method == "as in the paper" else method
    urgent = str(rng.choice(["keep_budget", "ignore_budget"]))
    settings = SETTINGS.get(method, {})
    return rng, mampc.MAMPC(problem, rules, method=name, on_limit_violation=urgent, **settings), rules


def with_more(rng, problem):
    """The problem, and as often as not with targets for its inputs, costs where a limit is, or zones."""
    limits, m = problem.limits, problem.model.n_inputs
    target = {}
    if rng.random() < 0.3:
        target = {
            "u_target": problem.model.u_op + rng.uniform(-1, 1, m),
            "u_target_weight": rng.choice([1e-3, 0.1]),
        }
    cost = np.zeros(m)
    if rng.random() < 0.3:
        cost = rng.choice([1e-3, 0.1]) * rng.uniform(-1, 1, m)
        cost[(cost > 0) & np.isinf(limits.u_min) | (cost < 0) & np.isinf(limits.u_max)] = 0.0
    if rng.random() < 0.25 and not problem.tail_horizon and problem.weigh_first_move:
        target["zone_below"] = rng.choice([0.0, 0.5, np.inf], problem.model.n_outputs)
        target["zone_above"] = rng.choice([0.0, 0.3], problem.model.n_outputs)
    return replace(problem, u_cost=cost, **target)


def limits_now(rng, problem):
    """Limits of one sample, at times further in than the inputs are, at times varying over the horizon."""
    usual, model, n_c = problem.limits, problem.model, problem.control_horizon
    given, shape = {}, (n_c, model.n_inputs) if rng.random() < 0.5 else model.n_inputs
    if np.isfinite(usual.u_min).all() and np.isfinite(usual.u_max).all():
        given["u_min"] = model.u_op - rng.uniform(-0.1, 0.5, shape)
        given["u_max"] = np.maximum(model.u_op + rng.uniform(-0.1, 0.5, shape), given["u_min"])
    if np.isfinite(usual.du_max).all():
        given["du_max"] = rng.uniform(0.05, 0.4, shape)
    if np.isfinite(usual.y_max).all():
        given["y_max"] = model.y_op + rng.uniform(0.0, 1.0, model.n_outputs)
    return mampc.Limits(**given)


@cache
def decided(seed, method):
    """A few samples: (controller, rules, what was asked, decision) each."""
    rng, controller, rules = random_controller(seed, method)
    problem, found = controller.problem, []
    model, m = problem.model, problem.model.n_inputs
    spread = 2.0 if rng.random() < 0.4 else 0.5
    state, x = (
        controller.initial_state(model.u_op + spread * rng.uniform(-1, 1, m)),
        rng.standard_normal(model.n_states),
    )
    for _ in range(6):
        asked = {
            "limits": limits_now(rng, problem) if rng.random() < 0.3 else None,
            "manual": rng.random(m) < 0.5 if rng.random() < 0.3 else None,
            "input_disturbance": rng.uniform(-0.3, 0.3, m) if rng.random() < 0.5 else np.zeros(m),
            "output_disturbance": rng.uniform(-0.3, 0.3, model.n_outputs),
        }
        shape = (problem.prediction_horizon + 1, model.n_outputs) if rng.random() < 0.5 else model.n_outputs
        reference = model.y_op + rng.choice([0.0, 0.5, 2.0]) * rng.standard_normal(shape)
        at = x if rng.random() < 0.95 else np.full_like(x, np.nan)
        decision = controller.step(state, at, reference, **asked)
        found.append((controller, rules, state, at, reference, asked, decision))
        applied = decision.u + (rng.uniform(-1, 1, m) if rng.random() < 0.3 else 0.0)
        state = mampc.ControllerState(
            np.vstack([decision.state.inputs[:-1], applied]), decision.state.samples,
            decision.state.guess, decision.state.active,
        )  # fmt: skip
        x = model.A @ x + model.B @ (applied - model.u_op)
        x = np.clip(x, -20, 20)
    return found


def cost_of(problem, x, u_previous, reference, plan, limits, input_disturbance, output_disturbance):
    """The objective without prices, as `TrackingProblem` states it, from a simulation of the model."""
    n_p, L = problem.prediction_horizon, problem.tail_horizon
    gamma = L / (1 + L)
    beyond = int(np.ceil(np.log(1e-16) / np.log(gamma))) if L else 0
    y = predicted(problem.model, x, plan, n_p + 1 + beyond, input_disturbance, output_disturbance)
    reference = np.broadcast_to(reference, (n_p + 1, y.shape[1]))
    error = distance(problem, y, np.vstack([reference, np.repeat(reference[-1:], beyond, axis=0)]))
    weight = np.concatenate([np.ones(n_p + 1), gamma ** np.arange(1, beyond + 1)])
    changes = np.diff(plan, axis=0, prepend=u_previous[None])
    weighed = changes if problem.weigh_first_move else changes[1:]
    y_max = problem.limits.y_max if limits is None or limits.y_max is None else limits.y_max
    excess = np.maximum(0.0, np.maximum(y - y_max, problem.limits.y_min - y))[1 : n_p + 1]
    scaled = violation_scale(problem) * (excess / fading(n_p)[:, None]).max(axis=0)
    return (
        np.einsum("i,ia,ab,ib", weight, error, problem.output_weight, error)
        + np.einsum("ja,ab,jb", weighed, problem.move_weight, weighed)
        + problem.output_limit_weight * np.sum(scaled + scaled**2 / 2)
        + cost_of_inputs(problem, plan[np.minimum(np.arange(n_p + 1), len(plan) - 1)])
        + L * cost_of_inputs(problem, plan[-1:])
    ), excess.max(axis=0)


@pytest.mark.parametrize("method", METHODS)
def test_plan_changes_moves_and_objective_are_of_one_plan(method):
    for seed in SEEDS:
        for controller, rules, state, x, reference, asked, decision in decided(seed, method):
            problem, u_previous = controller.problem, state.inputs[-1]
            where = f"seed {seed}: {decision.status}, {decision.remarks}"
            np.testing.assert_allclose(
                decision.plan, u_previous + decision.changes.cumsum(axis=0), rtol=0, atol=1e-9, err_msg=where
            )
            np.testing.assert_array_equal(decision.moves, np.abs(decision.changes) > 1e-9)
            if not np.isfinite(x).all():
                continue
            disturbed = asked["input_disturbance"], asked["output_disturbance"]
            cost, violations = cost_of(
                problem, x, u_previous, reference, decision.plan, asked["limits"], *disturbed
            )
            np.testing.assert_allclose(decision.violations, violations, atol=1e-7, err_msg=where)
            if decision.held:
                assert np.isnan(decision.objective)
                continue
            expected = cost + charge(rules, decision.moves)
            assert decision.objective == pytest.approx(expected, rel=1e-7, abs=1e-7), where
            assert decision.lower_bound <= decision.objective


@pytest.mark.parametrize("method", METHODS)
def test_inputs_to_apply_are_within_their_limits_and_planned_but_for_those_in_manual(method):
    for seed in SEEDS:
        for controller, _, state, _, _, asked, decision in decided(seed, method):
            usual, told = controller.problem.limits, asked["limits"] or mampc.Limits()
            low = np.atleast_2d(usual.u_min if told.u_min is None else np.maximum(told.u_min, usual.u_min))
            high = np.atleast_2d(usual.u_max if told.u_max is None else np.minimum(told.u_max, usual.u_max))
            if (low > high).any():
                low, high = usual.u_min[None], usual.u_max[None]
            assert (decision.u >= low[0]).all()
            assert (decision.u <= high[0]).all()
            manual = np.zeros(len(decision.u), bool) if asked["manual"] is None else asked["manual"]
            applied = state.inputs[-1]
            left_alone = manual & ((applied < low) | (applied > high)).any(axis=0)
            np.testing.assert_array_equal(decision.plan[0][~left_alone], decision.u[~left_alone])
            assert ((decision.plan >= low) & (decision.plan <= high))[:, ~left_alone].all()
            assert (decision.plan[:, manual] == applied[manual]).all()
            assert not decision.moves[:, manual].any()


def test_the_random_samples_meet_every_feature_often():
    met = Counter()
    for method in METHODS:
        for seed in SEEDS:
            for _, _, _, _, _, asked, decision in decided(seed, method):
                met[decision.status] += 1
                met.update(decision.remarks)
                met["manual beyond limits"] += bool((decision.plan[0] != decision.u).any())
                met["limits now"] += asked["limits"] is not None
    assert met["manual beyond limits"] > 20
    assert met[Remark.BACK_INSIDE] > 100
    assert met[Remark.RULES_SUSPENDED] > 20
    assert met["limits now"] > 100
    assert min(met[status] for status in ("optimal", "feasible", "settled", "held_infeasible")) > 20
