"""No offset under step disturbances although the model is wrong: gains by 30 %, a pole by 20 %."""

import numpy as np
import pytest

import mampc
from seeds import examples

CASES = [
    (seed, where, bank)
    for seed in range(examples(12, quick=2))
    for where in ("input", "output")
    for bank in (False, True)
]


def model_and_plant(seed):
    """A stable model with two inputs and outputs, and a plant with other gains and another slowest pole.

    Every input has a gain 30 % off, up or down, and the slowest time constant is 20 % off.
    """
    rng = np.random.default_rng(seed)
    poles = np.array([0.9, rng.uniform(0.3, 0.8), rng.uniform(0.1, 0.6), rng.uniform(0.1, 0.5)])
    B, C = rng.standard_normal((4, 2)), rng.standard_normal((2, 4))
    static = C @ np.diag(1 / (1 - poles)) @ B
    B = B @ np.linalg.inv(static) @ (np.eye(2) + 0.3 * rng.standard_normal((2, 2)))  # a well-conditioned gain
    u_op, y_op = rng.uniform(-2, 2, 2), rng.uniform(-2, 2, 2)
    model = mampc.StateSpace(np.diag(poles), B, C, None, 1.0, u_op, y_op)
    real = poles.copy()
    real[0] = np.exp(np.log(poles[0]) / rng.choice([0.8, 1.2]))
    gains = rng.choice([0.7, 1.3], 2)
    slower = np.diag((1 - real) / (1 - poles))  # the same gain with the other pole
    plant = mampc.StateSpace(np.diag(real), slower @ B * gains, C, None, 1.0, u_op, y_op)
    return model, plant


def loop(model, plant, controller, where, bank, size, steps=600):
    """A regulator, outputs of the plant with a step disturbance from sample 20 on, and the decisions."""
    kalman = mampc.KalmanFilter.offset_free(model, disturbance=where)
    regulator = mampc.Regulator(controller, mampc.LoadBank(model, noise=0.1) if bank else kalman)
    state, x, outputs, decisions = regulator.initial_state(), np.zeros(model.n_states), [], []
    for k in range(steps):
        load = size * (k >= 20)
        outputs.append(model.y_op + plant.C @ x + load * (where == "output"))
        decisions.append(regulator.step(state, outputs[-1], model.y_op))
        state = decisions[-1].state
        x = plant.A @ x + plant.B @ (decisions[-1].u - model.u_op + load * (where == "input"))
    return regulator, outputs, decisions


@pytest.mark.parametrize(("seed", "where", "bank"), CASES)
def test_mpc_removes_step_disturbances_though_the_model_is_wrong(seed, where, bank):
    model, plant = model_and_plant(seed)
    problem = mampc.TrackingProblem(model, prediction_horizon=30, control_horizon=4, move_weight=1.0)
    size = np.array([1.0, -2.0])
    _, y, decisions = loop(model, plant, mampc.MPC(problem), where, bank, size)
    assert {d.status.value for d in decisions} == {"optimal"}
    seen = np.abs(size if where == "output" else plant.dc_gain() @ size).max()
    assert np.abs(y[-1] - model.y_op).max() < 0.01 * seen


@pytest.mark.parametrize(("seed", "where", "bank"), CASES)
def test_with_a_price_what_stays_is_within_the_bound_of_the_price_though_the_model_is_wrong(
    seed, where, bank
):
    model, plant = model_and_plant(seed)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=4, move_weight=1.0, tail_horizon=2000.0
    )
    rules = mampc.MoveRules(price=5.0)
    controller = mampc.MAMPC(problem, rules)
    regulator, y, decisions = loop(model, plant, controller, where, bank, np.array([1.0, -2.0]))
    bound = regulator.largest_offset(decisions[-1].state)
    assert not any(d.moves[0].any() for d in decisions[-50:])
    assert (np.abs(y[-1] - model.y_op) <= bound * (1 + 1e-6)).all()
    assert (bound < 0.2).all()
