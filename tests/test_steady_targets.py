"""Inputs about a steady target, and what self-triggered control holds, whatever the units of states."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import mampc
from builders import tank_model, tank_problem
from test_open_loop import UNIT, double_integrator


@pytest.mark.parametrize(("pole", "sample"), [(0.8, -1), (1.25, 0)])
def test_one_input_acts_where_it_reaches_furthest(pole, sample):
    model = mampc.StateSpace([[pole]], [[1.0]], [[1.0]], None, 1.0)
    plan = mampc.rivals.hands_off(model, [1.0], steps=6)
    assert plan.nonzero == 1
    assert plan.u[sample, 0] == pytest.approx(-(pole**6) / pole ** (5 - sample % 6))


def test_a_target_out_of_reach_is_refused():
    with pytest.raises(mampc.MampcError, match="reached in 3 samples"):
        mampc.rivals.hands_off(double_integrator(), [100.0, 0.0], steps=3, limits=UNIT)


def test_a_steady_target_is_reached_whatever_the_states_units_are():
    model = mampc.plants.ogunnaike_ray()  # dead times, and states some thousand times apart
    problem = mampc.TrackingProblem(
        model, prediction_horizon=40, control_horizon=5, output_weight=1 / np.array([1e-3, 1e-3, 0.1]) ** 2,
        move_weight=1.0, limits=mampc.Limits(u_min=0.0, u_max=2 * model.u_op),
    )  # fmt: skip
    controller = mampc.rivals.Penalised(problem, penalty=mampc.rivals.L1(weight=1.0), on="inputs")
    reference = model.y_op + np.array([0.01, 0.01, 1.0])
    place = controller.condensed.parameter
    parameter = place.vector(np.zeros(model.n_states), model.u_op, reference)
    target = mampc.program.steady.SteadyTarget(problem, place).at(parameter)
    np.testing.assert_allclose(target.y, reference, rtol=1e-6)
    u = target.u - model.u_op
    np.testing.assert_allclose(model.A @ target.x + model.B[:, :3] @ u, target.x, atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e3])
@pytest.mark.parametrize(
    "plant", [mampc.plants.QuadrupleTank(), mampc.plants.wood_berry()], ids=["tank", "delays"]
)
def test_holds_are_decided_by_what_inputs_reach_whatever_the_estimator_and_the_states_units(plant, scale):
    model = plant if isinstance(plant, mampc.StateSpace) else mampc.linearise(plant).discretise(10.0)
    sizes = scale ** np.linspace(-1, 1, model.n_states)
    model = replace(model, A=sizes[:, None] * model.A / sizes, B=sizes[:, None] * model.B, C=model.C / sizes)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=5, move_weight=0.1, limits=mampc.Limits(0.0, 100.0)
    )
    controller = mampc.rivals.SelfTriggered(mampc.MPC(problem))
    reference = mampc.steps(60, model.y_op, [(5, model.y_op + 0.5)])
    for estimator in (None, mampc.LoadBank(model, noise=0.01)) if scale == 1.0 else (None,):
        regulator = mampc.Regulator(controller, estimator)
        run = mampc.simulate(model, regulator, reference, noise=0.01, progress=False)
        assert 0 < np.count_nonzero(np.diff(run.u, axis=0)) <= 12  # two inputs, a few holds
        assert np.abs(run.y - run.r)[-10:].mean() < 0.25


def test_the_norm_of_self_triggered_control_falls_by_its_rate_under_the_lq_law_whatever_the_dead_times():
    """So some constant input keeps the decay for a sample, and holds are decided by outputs and not by modes."""
    from mampc.rivals.self_triggered import _law_of

    model = mampc.plants.ogunnaike_ray()
    problem = mampc.TrackingProblem(
        model, prediction_horizon=40, control_horizon=5, output_weight=[1e6, 1e6, 1e2], move_weight=[1e3, 1e4, 1.0],
    )  # fmt: skip
    law = _law_of(problem, None)
    z = np.random.default_rng(0).normal(size=(len(law.A), 50))
    for _ in range(30):
        before, z = np.abs(law.P @ z).max(axis=0), (law.A - law.B @ law.K) @ z
        assert (np.abs(law.P @ z).max(axis=0) <= law.rho * before * (1 + 1e-6)).all()


@pytest.mark.parametrize(
    "rule",
    [
        mampc.rivals.SelfTriggered,
        partial(mampc.rivals.Rounded, step=1.3),
        partial(mampc.rivals.DeadBand, size=0.4),
    ],
)
def test_rules_keep_limits_of_moves_told_at_run_time(rule):
    model = tank_model()
    problem = tank_problem(model, limits=mampc.Limits(u_min=0.0, u_max=100.0, du_max=20.0))
    controller, x = rule(mampc.MPC(problem)), np.zeros(4)
    state, u, moved = controller.initial_state(), model.u_op, 0.0
    for k in range(20):
        du_max = 0.5 if k % 2 else 3.0
        reference = model.y_op + 4.0 * (-1) ** (k // 5)
        decision = controller.step(state, x, reference, limits=mampc.Limits(du_max=du_max))
        assert (np.abs(decision.u - u) <= du_max + 1e-9).all()
        moved, x = moved + np.abs(decision.u - u).sum(), model.A @ x + model.B @ (decision.u - model.u_op)
        state, u = decision.state, decision.u
    assert moved > 1.0
