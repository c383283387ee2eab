"""The estimator's disturbances: no steady offset under loads for poles from stable to unstable, in any units."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from mampc.systems.riccati import predicted_covariance
from seeds import deep

NEAR_ONE = (
    0.99,
    1 - 1e-4,
    1 - 1e-9,
    1.0,
    1 + 1e-6,
    1.01,
    *deep(0.995, 0.999, 1 - 1e-6, 1 - 1e-13, 1 + 1e-9, 1.0001, 1.001),
)


def level(pole):
    """A tank level: the slow pole behind a valve's lag."""
    return mampc.StateSpace(
        [[pole, 0.02], [0.0, 0.7]], [[0.0], [0.3]], [[1.0, 0.0]], None, 60.0, [50.0], [55.0]
    )


def two_outputs(pole, inputs=2):
    """A level and a quick temperature, which both of the first two inputs move; a third one moves the level."""
    B = np.array([[0.1, -0.05, 0.08], [0.3, 0.2, 0.0]])[:, :inputs]
    return mampc.StateSpace(np.diag([pole, 0.6]), B, [[1.0, 0.0], [0.2, 1.0]], None, 60.0)


def delayed_level(pole, delay=15):
    """A level whose inflow arrives later."""
    n = delay + 1
    A = np.diag(np.ones(delay), 1)
    A[0, 0], A[0, 1] = pole, 0.02
    B = np.zeros((n, 1))
    B[-1] = 1.0
    C = np.zeros((1, n))
    C[0, 0] = 1.0
    return mampc.StateSpace(A, B, C, None, 60.0)


def closed_loop(model, load, *, plant=None, steps=400, units=(1.0, 1.0)):
    """A run under a step load at the inputs from sample 20 on, the reference being the operating point."""
    weight = 1 / np.broadcast_to(units[1], model.n_outputs) ** 2
    problem = mampc.TrackingProblem(
        model, prediction_horizon=50, control_horizon=5, output_weight=weight,
        move_weight=0.1 / np.broadcast_to(units[0], model.n_inputs) ** 2,
    )  # fmt: skip
    disturbance = np.zeros((steps, model.n_inputs))
    disturbance[20:] = load
    return mampc.simulate(
        model if plant is None else plant, mampc.Regulator(mampc.MPC(problem)), model.y_op, steps=steps,
        input_disturbance=disturbance, progress=False,
    )  # fmt: skip


@pytest.mark.parametrize("pole", NEAR_ONE)
@pytest.mark.parametrize(
    "model", [level, two_outputs, lambda p: two_outputs(p, 3), delayed_level],
    ids=["level", "two outputs", "three inputs", "delayed level"],
)  # fmt: skip
def test_a_load_leaves_no_offset_and_drains_nothing_whatever_the_slow_pole(model, pole):
    model = model(pole)
    load = np.array([5.0, -2.0, 1.0])[: model.n_inputs]
    run = closed_loop(model, load)
    unheeded = np.abs(
        mampc.StateSpace.response(model, np.tile(model.u_op + load, (50, 1))) - model.y_op
    ).max()
    assert np.abs(run.y - model.y_op).max() < unheeded
    np.testing.assert_allclose(run.y[-20:], np.tile(model.y_op, (20, 1)), atol=2e-3 * unheeded)


@pytest.mark.parametrize("pole", [1.03, 1.1, 1.25, 1.4])
@pytest.mark.parametrize(
    "model", [level, two_outputs, lambda p: delayed_level(p, 3)], ids=["1 x 1", "2 x 2", "delayed"]
)
def test_loads_on_a_plant_that_runs_away_are_found_as_fast_as_elsewhere(model, pole):
    model = model(pole)
    problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=5, move_weight=1e-3)
    load = np.zeros((80, model.n_inputs))
    load[10:] = 1.0
    run = mampc.simulate(
        model, mampc.Regulator(mampc.MPC(problem)), model.y_op, steps=80, input_disturbance=load
    )
    error = np.abs(run.y - model.y_op)
    assert error[50:].max() < 0.05 * error.max()


@pytest.mark.parametrize("disturbance", ["auto", "input"])
def test_a_measured_disturbance_changes_no_gain_of_a_plant_that_runs_away(disturbance):
    alone = two_outputs(1.05)
    names = mampc.Names(("u1", "u2"), ("y1", "y2"), disturbances=("v",))
    measured = mampc.StateSpace(
        alone.A,
        np.hstack([alone.B, [[0.3], [-0.1]]]),
        alone.C,
        np.zeros((2, 3)),
        60.0,
        v_op=[0.0],
        names=names,
    )
    gains = [
        mampc.KalmanFilter.offset_free(model, disturbance=disturbance).gain for model in (alone, measured)
    ]
    np.testing.assert_allclose(gains[1], gains[0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("pole", [0.99, 0.999, 1.0, 1.01])
def test_a_wrong_gain_leaves_no_offset_either(pole):
    model = two_outputs(pole)
    run = closed_loop(model, [2.0, 1.0], plant=replace(model, B=model.B * [1.3, 0.75]))
    np.testing.assert_allclose(run.y[-20:], 0.0, atol=1e-3)


@pytest.mark.parametrize("pole", [0.8, 0.99, 0.9999, 1.0, 1.01])
@pytest.mark.parametrize("disturbance", ["auto", "output", "input"])
def test_units_do_not_matter_to_the_estimator(disturbance, pole):
    if disturbance == "output" and pole == 1.0:
        pytest.skip("not detectable")
    model = two_outputs(pole)
    u_unit, y_unit = np.array([1e-5, 1e4]), np.array([1e6, 1e-3])
    other = replace(model, B=model.B / u_unit, C=model.C * y_unit[:, None])
    gains = [mampc.KalmanFilter.offset_free(m, disturbance=disturbance) for m in (model, other)]
    np.testing.assert_allclose(gains[1].gain[:2] * y_unit, gains[0].gain[:2], rtol=1e-6, atol=1e-9)
    if disturbance == "auto":
        runs = [
            closed_loop(m, [2.0, 1.0] * u, units=(u, y), steps=60)
            for m, u, y in ((model, np.ones(2), np.ones(2)), (other, u_unit, y_unit))
        ]
        np.testing.assert_allclose(runs[1].y / y_unit, runs[0].y, atol=1e-5)


def test_a_pole_at_one_and_poles_near_it_have_the_same_estimator():
    exact = mampc.KalmanFilter.offset_free(level(1.0)).gain
    for near in (1 - 1e-9, 1 + 1e-9):
        np.testing.assert_allclose(mampc.KalmanFilter.offset_free(level(near)).gain, exact, atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_the_covariance_is_that_of_scipy(seed):
    from scipy.linalg import solve_discrete_are

    rng = np.random.default_rng(seed)
    n, l = 3 + seed, 1 + seed % 3
    A = rng.standard_normal((n, n))
    A *= rng.choice([0.8, 1.0, 1.1]) / np.abs(np.linalg.eigvals(A)).max()
    C, root = rng.standard_normal((l, n)), rng.standard_normal((n, n))
    Q, R = root @ root.T, np.diag(rng.uniform(0.1, 2.0, l))
    P = predicted_covariance(A, C, Q, R)
    np.testing.assert_allclose(P, solve_discrete_are(A.T, C.T, Q, R), rtol=1e-8, atol=1e-10)
    update = P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)
    np.testing.assert_allclose(A @ update @ A.T + Q, P, rtol=1e-9, atol=1e-10)
