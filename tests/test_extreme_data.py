"""Masked, missing and extreme data, as fuzzing found them."""

import numpy as np
import pytest

import fuzzing
import mampc
from fuzzing import LARGEST, same_to_the_bit
from mampc import Fault, Status
from seeds import seeds


def masked_loop():
    """A loop with a measured disturbance and limits, and data for one sample."""
    names = mampc.Names(("u",), ("y",), ("x",), ("load",))
    model = mampc.StateSpace([[0.8]], [[0.5, 0.3]], [[1.0]], None, 1.0, names=names)
    limits = mampc.Limits(u_min=-5.0, u_max=5.0, du_max=2.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=2, limits=limits)
    regulator = mampc.Regulator(mampc.MPC(problem))
    return regulator, regulator.initial_state(measured_disturbance=[0.5])


def test_what_is_masked_is_not_believed_whatever_stands_behind_the_mask():
    loop, state = masked_loop()
    masked = np.ma.masked_array([3.0], [True])
    assert loop.step(state, [0.1], masked).status is Status.HELD_BAD_MEASUREMENT
    usual = loop.step(state, [0.1], [1.0])
    assert same_to_the_bit(loop.step(state, [0.1], [1.0], measured_disturbance=masked), usual)
    assert same_to_the_bit(loop.step(state, [0.1], [1.0], u_applied=masked), usual)
    assert same_to_the_bit(loop.step(state, masked, [1.0]), loop.step(state, [np.nan], [1.0]))


@pytest.mark.parametrize("size", [-LARGEST, LARGEST])
def test_a_measurement_just_too_large_is_missing_where_jumps_are_not_tested(size):
    loop, _ = masked_loop()
    loop = mampc.Regulator(loop.controller, sensors=mampc.SensorChecks(largest_jump=np.inf))
    decision = loop.step(loop.initial_state(), [size], [1.0])
    assert decision.ignored_outputs == {"y": Fault.MISSING}


@pytest.mark.parametrize("nothing", [np.ma.masked_array([0.1], [True]), [None], [np.nan]], ids=str)
@pytest.mark.parametrize("name", ["u_min", "u_max", "du_max"])
def test_a_limit_of_this_sample_that_is_missing_is_the_usual_one(name, nothing):
    loop, state = masked_loop()
    usual = loop.step(state, [0.1], [3.0])
    assert not usual.held
    assert same_to_the_bit(
        loop.step(state, [0.1], [3.0], limits=mampc.Limits(**{name: nothing})),
        loop.step(state, [0.1], [3.0], limits=mampc.Limits()),
    )


@pytest.mark.parametrize("rules", [None, mampc.MoveRules(max_moves=1)], ids=str)
def test_inputs_without_limits_stay_within_what_counts_as_a_number(rules):
    model = mampc.StateSpace([[0.8]], [[0.5]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=2, move_weight=0.01)
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    decision = controller.step(controller.initial_state(), [9e11], [-9e11])
    assert np.abs(decision.plan).max() == LARGEST / 2
    assert not controller.step(decision.state, [0.0], [0.0]).held


def test_a_penalty_grows_no_further_than_a_solver_can_follow():
    """Copies that are too large to agree to the tolerance let it grow without end."""
    model = mampc.StateSpace([[0.6]], [[1.0, 0.5, 0.4]], [[1.0]], None, 1.0)
    limits = mampc.Limits(y_max=0.5)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=7, control_horizon=4, limits=limits, output_limit_weight=0.01
    )
    controller = mampc.MAMPC(problem, mampc.MoveRules(max_moves=1), method="penalty_decomposition")
    for size in (1.0, 1e6, 1e11):
        assert not controller.step(controller.initial_state(), [0.3 * size], [-size]).held


@pytest.mark.parametrize("seed", seeds(40, quick=3))
def test_compensated_valves_survive_whatever_the_data(seed):
    """Commands keep their limits, states are plain numbers, and nothing raises; healthy data bring decisions back."""
    rng = np.random.default_rng(seed)
    model = mampc.StateSpace.from_first_order(
        gain=[[1.0, 0.4], [0.3, 0.8]], time_constant=[[6.0, 4.0], [5.0, 8.0]], dt=1.0
    )
    limits = mampc.Limits(u_min=[0.0, -1.0], u_max=[4.0, 1.0])
    problem = mampc.TrackingProblem(model, prediction_horizon=6, control_horizon=2, limits=limits)
    rules = mampc.MoveRules(price=0.05, min_size=0.1, max_moves=[None, 2][seed % 2], sparsity_horizon=4)
    valves = mampc.Valves(band=[0.2, 0.3], jump=0.05)
    regulator = mampc.Regulator(mampc.MAMPC(problem, rules), valves=valves)
    state = regulator.initial_state()

    def spoilt(size):
        return np.where(rng.random(2) < 0.3, rng.choice(fuzzing.EXTREMES, 2), size * rng.standard_normal(2))

    for sample in range(60):
        healthy = sample >= 50
        told = {} if healthy else {
            "u_applied": spoilt(1.0) if rng.random() < 0.4 else None,
            "manual": rng.random(2) < 0.3 if rng.random() < 0.3 else None,
            "limits": mampc.Limits(u_max=spoilt(3.0)) if rng.random() < 0.2 else None,
        }  # fmt: skip
        y = 0.01 * rng.standard_normal(2) if healthy else spoilt(0.3)
        decision = regulator.step(state, y, np.ones(2) if healthy else spoilt(1.0), **told)
        assert isinstance(decision.status, Status)
        assert ((decision.u >= [0.0, -1.0]) & (decision.u <= [4.0, 1.0])).all()
        state = regulator.state_from_json(decision.state.to_json())
        assert state.to_json() == decision.state.to_json()
    assert not decision.held
