"""From a record to a loop: on made-up plants that integrate, drift, are slow or late nothing is left of a load."""

import numpy as np
import pytest

import mampc
from mampc.controllers.offset import LEFT
from mampc.study.draft import draft
from mampc.systems.properties import properties
from seeds import seeds

DT = 10.0


def made_up_plant(seed):
    """Of one or two inputs and outputs: levels, drifting, slow poles about one, levels that drift, long dead times."""
    rng, kind = np.random.default_rng(seed), seed % 5
    m = int(rng.integers(1, 3))
    l = int(rng.integers(1, m + 1))
    gain = rng.uniform(0.5, 3, (l, m)) * np.where(rng.random((l, m)) < 0.4, -1, 1)
    gain[range(l), range(l)] *= 2.5
    lag, dead = rng.uniform(40, 300, (l, m)), rng.uniform(0, 60, (l, m)) * (5 if kind == 4 else 1)
    if kind in (0, 3):
        lag[0], gain[0] = np.inf, 2e-3 * gain[0]
    names = {"u_op": np.full(m, 50.0), "y_op": np.full(l, 20.0)}
    if kind != 2:
        return mampc.StateSpace.from_first_order(gain=gain, time_constant=lag, dead_time=dead, dt=DT, **names)
    pole = float(rng.choice([0.99, 0.995, 0.999, 0.9999, 1.0, 1.00005]))
    A = np.diag([pole, *[0.9] * l])
    B = np.vstack([rng.uniform(0.01, 0.03, (1, m)) * np.sign(gain[:1]), 0.1 * gain])  # both the same way
    return mampc.StateSpace(A, B, np.hstack([np.eye(l)[:, :1], np.eye(l)]), None, DT, **names)


@pytest.mark.parametrize("seed", seeds(30, quick=2))
def test_a_load_leaves_no_offset_under_mpc_and_no_more_than_a_price_may(seed):
    plant, rng = made_up_plant(seed), np.random.default_rng(100 + seed)
    m, l = plant.n_inputs, plant.n_outputs
    u = mampc.prbs(order=8, amplitude=3.0, hold=8, mean=plant.u_op, inputs=m, samples=1200, seed=seed)
    y = mampc.excite(plant, u, dt=DT).y
    spread = y.std(axis=0)
    y = y + 0.05 * spread * rng.standard_normal(y.shape)
    if seed % 5 in (1, 3):
        y = y + np.cumsum(0.02 * spread * rng.standard_normal(y.shape), axis=0)
    model = mampc.n4sid(mampc.IOData(u, y, DT), feedthrough=False).model
    plan = draft(model, properties(model))
    horizon = plan.problem.prediction_horizon
    problem = mampc.TrackingProblem(
        model, prediction_horizon=horizon, control_horizon=plan.problem.control_horizon,
        output_weight=plan.problem.output_weight, move_weight=plan.problem.move_weight,
        tail_horizon=plan.problem.tail_horizon, limits=mampc.Limits(u_min=0.0, u_max=100.0),
    )  # fmt: skip
    steps = max(1200, 6 * horizon)
    reference = np.tile(plant.y_op, (steps, 1))
    reference[50:] += plan.changes[0]
    load = mampc.loads.Steps(sizes=[np.full(m, 2.0)], times=[DT * (steps // 2)])
    asked = np.abs(plan.changes).max(axis=0)
    moves = []
    for controller, least in (
        (mampc.MPC(problem), 0.01),
        (mampc.MAMPC(problem, mampc.MoveRules(price=plan.price)), LEFT),
    ):
        run = mampc.simulate(
            plant, mampc.Regulator(controller), reference, noise=0.02 * spread, seed=1, loads=[load]
        )
        left = np.abs((run.y - run.r)[-steps // 6 :].mean(axis=0)) / asked
        assert left.shape == (l,)
        assert (left < least).all()
        moves.append(np.sum(run.metrics().moves))
    assert moves[1] < moves[0] / 5
