"""Sensors of levels that hardly move in a sample, beside noise of any size."""

import numpy as np
import pytest

import mampc
from mampc import Fault
from test_sensors import plant_loop

pytestmark = pytest.mark.usefixtures("either_estimator")


def slow_level(unit, **options):
    """The regulator of a level in `unit`, which its valve moves by at most a fortieth a sample from the middle."""
    model = mampc.StateSpace.from_first_order(
        gain=[[5e-4 * unit]], time_constant=np.inf, dt=1.0, u_op=[50.0], y_op=[50.0 * unit]
    )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=3, output_weight=unit**-2, move_weight=1e-4,
        limits=mampc.Limits(u_min=0.0, u_max=100.0),
    )  # fmt: skip
    return mampc.Regulator(mampc.MPC(problem), **options)


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e4])
def test_noise_of_a_slow_level_is_no_jump(unit):
    regulator = slow_level(unit)
    decisions, *_ = plant_loop(
        regulator, 150, lambda k, y: y, noise=0.3 * unit, reference=np.array([52.0 * unit])
    )
    assert sum("y1" in d.ignored_outputs for d in decisions) <= 12


def test_a_slow_level_far_from_its_operating_point_is_believed_after_some_samples():
    regulator = slow_level(1.0)
    decisions, *_ = plant_loop(regulator, 60, lambda k, y: y - 40.0, noise=0.3, reference=np.array([12.0]))
    assert all(not d.ignored_outputs for d in decisions[30:])


@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_spikes_of_a_slow_level_are_jumps_whatever_its_noise(noise):
    regulator = slow_level(1.0)
    decisions, *_ = plant_loop(
        regulator, 200, lambda k, y: y + 30.0 * (k % 37 == 36), noise=noise, reference=np.array([52.0])
    )
    assert all(d.ignored_outputs == {"y1": Fault.JUMP} for d in decisions[36::37])


def test_a_coarse_sensor_of_a_slow_level_is_not_stuck():
    regulator = slow_level(1.0)
    decisions, *_ = plant_loop(
        regulator, 200, lambda k, y: np.round(y), noise=0.05, reference=np.array([52.0])
    )
    assert not any(d.ignored_outputs.get("y1") is Fault.STUCK for d in decisions)


def test_many_slow_levels_are_judged_as_each_of_them():
    regulator = slow_level(1.0)
    model, settings = regulator.controller.problem.model, {"steps": 40, "noise": 0.2, "progress": False}
    batch = mampc.simulate_batch(model, regulator, [52.0], seeds=range(2), **settings)
    for seed in range(2):
        run = mampc.simulate(model, regulator, [52.0], seed=seed, **settings)
        assert any(decision.ignored_outputs for decision in run.decisions)
        np.testing.assert_allclose(batch.u[seed], run.u, atol=1e-9)


@pytest.mark.parametrize("told", [{}, {"sensors": mampc.SensorChecks(largest_jump=0.05)}])
def test_only_a_largest_jump_that_nobody_told_grows_with_the_noise(told):
    regulator = slow_level(1.0, **told)
    *_, last = plant_loop(regulator, 60, lambda k, y: y, noise=0.3, reference=np.array([50.0]))[0]
    assert (last.state.sensors.surprise[0] > 0.1) is not bool(told)
