"""Bad measurements: what is believed, what is not, and how the loop goes on."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import identified_tank, random_model, tank_problem
from mampc import Fault, Status
from seeds import deep

pytestmark = pytest.mark.usefixtures("either_estimator")

TANK = mampc.plants.QuadrupleTank()


def plant_loop(regulator, steps, spoil, *, noise=0.05, seed=0, reference=None, at_output=None):
    """Decisions and true outputs on the model itself; `spoil(k, y)` gives what the sensors say."""
    model = regulator.controller.problem.model
    rng, x, u = np.random.default_rng(seed), np.zeros(model.n_states), model.u_op
    reference = model.y_op + np.array([1.0, -0.5])[: model.n_outputs] if reference is None else reference
    state, decisions, outputs = regulator.initial_state(), [], []
    for k in range(steps):
        y = model.y_op + model.C @ x + (0 if at_output is None else at_output(k))
        outputs.append(y)
        said = spoil(k, y + noise * rng.standard_normal(len(y)))
        decisions.append(regulator.step(state, said, reference))
        state, u = decisions[-1].state, decisions[-1].u
        x = model.A @ x + model.B @ (u - model.u_op)
    return decisions, np.array(outputs), reference


def tank_regulator(rules=None, **options):
    problem = tank_problem(identified_tank(), prediction_horizon=20)
    controller = mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules)
    return mampc.Regulator(controller, **options)


@pytest.mark.parametrize("lost", [0, 1])
@pytest.mark.parametrize(
    "gone", [np.nan, np.inf, -np.inf, 1e200, np.ma.masked], ids=["nan", "inf", "-inf", "huge", "masked"]
)
def test_a_missing_output_is_named_and_the_other_is_still_controlled(lost, gone):
    def spoil(k, y):
        y = np.ma.array(y)
        if k >= 30:
            y[lost] = gone
        return y

    # Afterwards the other output is pushed: only its own measurement can tell.
    load = np.zeros(2)
    load[1 - lost] = 2.0
    regulator = tank_regulator()
    decisions, outputs, reference = plant_loop(
        regulator, 160, spoil, noise=0.0, at_output=lambda k: load * (k >= 60)
    )
    name = regulator.controller.problem.model.names.outputs[lost]
    assert all(d.ignored_outputs == {} for d in decisions[:30])
    assert all(d.ignored_outputs == {name: Fault.MISSING} for d in decisions[30:])
    assert not any(d.held for d in decisions)
    assert np.abs(outputs[-1] - reference)[1 - lost] < 0.02
    assert np.abs(outputs[-1] - reference)[lost] < 1.5


def test_with_every_output_missing_the_inputs_are_held_after_max_blind_steps():
    regulator = tank_regulator(max_blind_steps=4)
    decisions, *_ = plant_loop(regulator, 40, lambda k, y: y * np.nan if 3 <= k < 20 else y)
    held = [k for k, d in enumerate(decisions) if d.status is Status.HELD_BAD_MEASUREMENT]
    assert held == list(range(7, 20))
    assert all(len(d.ignored_outputs) == 2 for d in decisions[3:20])
    for k in held:
        np.testing.assert_array_equal(decisions[k].u, decisions[6].u)


@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=1.0)])
def test_the_first_good_sample_moves_the_inputs_no_further_than_every_day_operation_would(
    either_estimator, rules
):
    """At rest, a blind spell and back: nothing happened meanwhile, so nothing is to be done."""
    regulator = tank_regulator(rules)
    model = regulator.controller.problem.model
    decisions, *_ = plant_loop(
        regulator, 60, lambda k, y: y * np.nan if 30 <= k < 50 else y, noise=0.0, reference=model.y_op
    )
    assert np.abs(np.array([d.u for d in decisions]) - model.u_op).max() < 1e-9

    # A jump of the plant meanwhile: the answer is that to a jump that was seen at once.
    jump = lambda k: np.array([1.0, 1.0]) * (k >= 40)  # noqa: E731
    blind, *_ = plant_loop(
        regulator, 60, lambda k, y: y * np.nan if 30 <= k < 50 else y, noise=0.0, reference=model.y_op,
        at_output=jump,
    )  # fmt: skip
    seen, *_ = plant_loop(
        regulator, 60, lambda k, y: y, noise=0.0, reference=model.y_op, at_output=lambda k: jump(k - 10)
    )
    if either_estimator == "kalman filter":
        np.testing.assert_allclose(blind[50].u, seen[50].u, atol=1e-9)
    assert (np.abs(blind[50].u - model.u_op) <= np.abs(seen[50].u - model.u_op) + 1e-9).all()


@pytest.mark.parametrize("size", [20.0, -30.0, 1e5, 1e11])
def test_a_spike_is_ignored_and_changes_nothing(size):
    regulator = tank_regulator()
    spiked, *_ = plant_loop(regulator, 80, lambda k, y: y + size * (k == 40) * np.array([1.0, 0.0]))
    assert spiked[40].ignored_outputs == {"y1": Fault.JUMP}
    assert not any(d.ignored_outputs for k, d in enumerate(spiked) if k != 40)
    calm, *_ = plant_loop(regulator, 80, lambda k, y: y)
    difference = max(np.abs(a.u - b.u).max() for a, b in zip(spiked, calm, strict=True))
    noise = np.std([d.u for d in calm[60:]], axis=0).max()
    assert difference < 4 * noise


def test_a_jump_that_stays_is_believed_after_some_samples():
    regulator = tank_regulator(sensors=mampc.SensorChecks(confirm=3))
    decisions, outputs, reference = plant_loop(
        regulator, 200, lambda k, y: y, at_output=lambda k: np.array([-15.0, 0.0]) * (k >= 40)
    )
    doubted = [k for k, d in enumerate(decisions) if d.ignored_outputs]
    assert doubted == [40, 41]
    assert abs(outputs[-1] - reference)[0] < 0.5


@pytest.mark.parametrize("taken", [0.9, 0.0])
def test_an_output_that_goes_far_in_every_sample_is_believed_where_its_model_takes_it(taken):
    """An integrator at full speed gets further in a sample than `largest_jump`."""
    model = mampc.StateSpace([[1.0]], [[1.0]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=2, limits=mampc.Limits(u_min=-1.0, u_max=1.0)
    )
    checks = mampc.SensorChecks(largest_jump=0.5, confirm=3).fitted(problem)
    state, found = checks.initial(np.zeros(1)), []
    for k in range(5):
        y, innovation, movement = np.array([5.0 + k]), np.array([5.0 + 0.1 * k]), np.array([taken])
        judged, state = checks.update(state, y, innovation, movement, np.zeros(1))
        found.append(bool(judged.believed[0]))
    assert found == [False, False, taken > 0, taken > 0, taken > 0]


def test_a_sensor_that_says_something_else_at_every_sample_is_never_believed():
    regulator = tank_regulator()
    swing = np.array([50.0, 0.0])
    decisions, *_ = plant_loop(regulator, 60, lambda k, y: y + (-1) ** k * swing * (k >= 30))
    assert all(d.ignored_outputs == {"y1": Fault.JUMP} for d in decisions[30:])


def test_a_stuck_sensor_does_not_drive_the_plant_away(either_estimator):
    """It sticks below its reference: believed, it would have the plant pushed further and further."""
    stuck_from, seen = 40, {}

    def spoil(k, y):
        seen.setdefault("y1", y[0]) if k == stuck_from else None
        return np.array([seen["y1"] - 0.5, y[1]]) if stuck_from <= k < 160 else y

    _, trusting, _ = plant_loop(tank_regulator(sensors=mampc.SensorChecks(stuck_after=None)), 160, spoil)
    seen.clear()
    decisions, outputs, reference = plant_loop(tank_regulator(), 260, spoil)
    assert np.abs(trusting[159] - reference).max() > 6.0  # and drifting on
    found = next(k for k, d in enumerate(decisions) if d.ignored_outputs.get("y1") is Fault.STUCK)
    assert found < 100
    assert all(d.ignored_outputs == {"y1": Fault.STUCK} for d in decisions[found:160])
    assert np.abs(outputs[40:] - reference).max() < (3.0 if either_estimator == "kalman filter" else 5.0)
    assert not any(d.ignored_outputs for d in decisions[162:])
    assert np.abs(outputs[-1] - reference).max() < 0.5


@pytest.mark.parametrize("value", [0.0, 20.0, 60.0, 1e11])
def test_a_broken_wire_is_found_and_what_it_did_to_the_estimate_is_undone(value):
    """y1 falls to a constant and stays: a jump that lasts is believed at first, a stuck sensor is not."""
    decisions, outputs, reference = plant_loop(
        tank_regulator(), 260, lambda k, y: np.array([value, y[1]]) if k >= 60 else y
    )
    told = [d.ignored_outputs.get("y1") for d in decisions]
    assert told[60:62] == [Fault.JUMP] * 2
    assert all(told[75:])
    assert np.abs(outputs[-60:] - reference)[:, 0].max() < 1.0
    assert np.abs(outputs[-60:] - reference)[:, 1].max() < 0.5


class Overflowing:
    """A tank (first order, gain 1) whose level cannot exceed 55."""

    names = mampc.Names(("u",), ("y",), ("x",))
    u_op = (40.0,)

    def derivative(self, x, u):
        return (u - x) / 50.0 - np.maximum(x - 55.0, 0.0)  # what is too much leaves over a weir

    def output(self, x, u):
        return np.minimum(x, 55.0)

    def steady_state(self, u=None):
        return np.minimum(np.atleast_1d(self.u_op if u is None else u), 55.0)


@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=1.0)])
def test_a_plant_at_a_hard_stop_looks_stuck_and_is_controlled_again_in_the_end(rules):
    model = mampc.StateSpace([[np.exp(-0.2)]], [[1 - np.exp(-0.2)]], [[1.0]], None, 10.0, [40.0], [40.0])
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=3, limits=mampc.Limits(u_min=0.0, u_max=100.0)
    )
    regulator = mampc.Regulator(mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules))
    reference = mampc.steps(600, [45.0], [(50, [60.0]), (200, [40.0])])
    run = mampc.simulate(Overflowing(), regulator, reference, progress=False)
    assert any(d.ignored_outputs.get("y1") is Fault.STUCK for d in run.decisions)
    assert run.y[150:200].max() >= 54.9
    assert abs(run.y[-1, 0] - 40.0) < 0.5


def test_values_outside_the_range_of_a_sensor_are_ignored():
    regulator = tank_regulator(sensors=mampc.SensorChecks(y_low=0.0, y_high=[40.0, 60.0]))
    state, y = regulator.initial_state(), regulator.controller.problem.model.y_op
    decision = regulator.step(state, [40.5, y[1]], y)
    assert decision.ignored_outputs == {"y1": Fault.OUT_OF_RANGE}
    assert decision.ignored_outputs["y1"].sentence


def test_without_finite_input_limits_every_finite_value_is_believed():
    problem = mampc.TrackingProblem(random_model(0), prediction_horizon=8, control_horizon=3)
    regulator = mampc.Regulator(mampc.MPC(problem))
    decision = regulator.step(regulator.initial_state(), problem.model.y_op + 1e6, problem.model.y_op)
    assert not decision.ignored_outputs


@pytest.mark.parametrize("seed", range(10))
def test_what_is_left_never_lets_the_estimate_run_away(seed):
    """With any outputs missing for good, errors of the estimate do not grow (beyond those of the plant)."""
    model = random_model(seed, n=4, m=2, l=3, radius=0.97)
    kalman = mampc.KalmanFilter.offset_free(model)
    A = np.block([[model.A, np.zeros((4, 3))], [np.zeros((3, 4)), np.eye(3)]])
    C = np.hstack([model.C, np.eye(3)])
    for left in ([0], [1], [0, 1], [1, 2], []):
        believed = np.isin(np.arange(3), left)
        gain = kalman.gain_with(believed)
        assert (gain[:, ~believed] == 0).all()
        assert np.abs(np.linalg.eigvals(A - gain @ C @ A)).max() <= 1 + 1e-9


@pytest.mark.parametrize(
    "options",
    [
        {"y_low": 1.0, "y_high": 0.0},
        {"largest_jump": 0.0},
        {"largest_jump": [1.0]},
        {"largest_jump": np.nan},
        {"confirm": 0},
        {"stuck_after": 1},
        {"y_low": "low"},
    ],
    ids=str,
)
def test_sensor_checks_out_of_range_are_refused(options):
    with pytest.raises(mampc.MampcError, match=r"expected.*received"):
        tank_regulator(sensors=mampc.SensorChecks(**options))
    with pytest.raises(mampc.MampcError, match=r"expected.*received"):
        tank_regulator(max_blind_steps=-1)


@pytest.mark.parametrize("step", [0.02, 0.4, *deep(0.1, 1.0)])
@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=1.0)])
def test_a_coarse_sensor_is_not_stuck_while_the_controller_balances_a_load(rules, step):
    """Its number stays the same for many samples although the inputs move: a load moves the other way."""
    model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0)
    limits = mampc.Limits(u_min=-50.0, u_max=50.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=5, limits=limits)
    loads = {
        "slow ramp": lambda k: -0.05 * min(max(0, k - 50), 100),
        "fast ramp": lambda k: -0.2 * min(max(0, k - 50), 50),
        "slow wave": lambda k: 8.0 * np.sin(k / 32.0),
    }
    for load in loads.values():
        loop = mampc.Regulator(mampc.MPC(problem) if rules is None else mampc.MAMPC(problem, rules))
        state, x = loop.initial_state([0.0], [0.0]), 0.0
        for k in range(300):
            decision = loop.step(state, [step * round(x / step)], [10.3 if k > 10 else 0.0])
            assert decision.ignored_outputs == {}
            state = decision.state
            x = 0.9 * x + 0.1 * (0.85 * decision.u[0] + load(k))


def test_a_coarse_sensor_that_is_stuck_is_found_in_the_end():
    model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0)
    limits = mampc.Limits(u_min=-50.0, u_max=50.0, du_max=0.5)
    problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=5, limits=limits)
    loop = mampc.Regulator(mampc.MPC(problem))
    state, x, faults = loop.initial_state([0.0], [0.0]), 0.0, []
    for k in range(200):
        shown = 4.0 if k > 60 else 0.4 * round(x / 0.4)
        decision = loop.step(state, [shown], [10.0 if k > 60 else 4.1 if k > 10 else 0.0])
        state = decision.state
        faults.append(decision.ignored_outputs.get("y1"))
        x = 0.9 * x + 0.1 * decision.u[0]
    assert Fault.STUCK in faults[80:120]
    assert Fault.STUCK not in faults[:80]


def test_an_output_that_washes_out_has_a_largest_jump_too():
    """At rest the input does next to nothing to it; soon after a move it does much."""
    A, B, C = np.diag([0.6, 0.95]), np.array([[0.4], [0.05]]), np.array([[1.0, -0.97]])
    model = mampc.StateSpace(A, B, C, None, 1.0)
    limits = mampc.Limits(u_min=-50.0, u_max=50.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=60, control_horizon=5, limits=limits)
    decisions, *_ = plant_loop(
        mampc.Regulator(mampc.MPC(problem)), 200, lambda k, y: y, noise=0.3, reference=np.ones(1)
    )
    assert not any(d.ignored_outputs for d in decisions)


def test_a_sensor_is_found_stuck_once_and_its_stuck_run_is_no_healthy_one():
    """Also if nothing comes for a sample meanwhile, and whichever way the model moves the output."""
    sensors = mampc.SensorChecks(stuck_after=3, largest_jump=1.0).fitted(tank_problem(identified_tank()))
    none, moving = np.zeros(2), np.array([-0.5, 0.0])
    state, found = sensors.initial(none), []
    healthy = 30.0 + np.random.default_rng(0).standard_normal(20)
    for shown in (*healthy, 31.03, 31.03, 31.03, 31.03, np.nan, 31.03, 31.03, 32.0):
        y = np.array([shown, 20.0 + len(found) / 7])
        judged, state = sensors.update(state, y, none, moving, none)
        found.append(bool(judged.newly_stuck[0]))
    assert np.flatnonzero(found) == [23]
    np.testing.assert_array_equal(state.longest, 0.0)
    np.testing.assert_array_equal(state.stuck, 0.0)


def test_noise_as_found_in_the_record_is_no_jump():
    """Inputs of a small range, and noise as large as what they do."""
    plant = mampc.StateSpace.from_first_order(gain=5e4, time_constant=4 * 3600, dt=600.0, u_op=0.3, y_op=2e5)
    limits = mampc.Limits(u_min=0.25, u_max=0.35)
    for noise, doubted in ((mampc.Noise([200.0], [0.0]), False), (None, True)):
        model = replace(plant, noise=noise)
        problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=3, limits=limits)
        run = mampc.simulate(plant, mampc.Regulator(mampc.MPC(problem)), [2e5], steps=300, noise=200.0)
        assert any(decision.ignored_outputs for decision in run.decisions) == doubted


def test_noise_that_a_load_bank_was_told_is_no_jump():
    """The inputs reach 10, and a tenth of that is less than three standard deviations."""
    model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=2, limits=mampc.Limits(u_min=-5.0, u_max=5.0)
    )
    regulator = mampc.Regulator(mampc.MPC(problem), mampc.LoadBank(model, noise=0.4))
    state = regulator.initial_state()
    for y in 0.4 * np.random.default_rng(3).standard_normal((300, 1)):
        decision = regulator.step(state, y, [0.0])
        assert not decision.ignored_outputs
        state = decision.state
    assert regulator.step(state, [8.0], [0.0]).ignored_outputs
