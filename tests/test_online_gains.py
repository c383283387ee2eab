"""Gains corrected while the loop runs: what is learnt, when gains change, how the loop goes on, and what is refused."""

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

import mampc
from mampc import loads
from mampc.base.words import Remark
from mampc.loop.change_over import taken_over
from mampc.loop.corrected_gains import FEWEST, MOST, another_model, with_gains
from mampc.loop.gain_filter import PRIOR
from mampc.loop.gain_learner import GainLearner
from seeds import seeds
from test_learnt_gains import MODEL, NOISE, OFF


def regulator(model=MODEL, *, noise=NOISE, learn=True, weights=1.0, plain=False):
    reach = 5 / np.sqrt(weights)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=20, control_horizon=3, output_weight=1 / noise**2,
        move_weight=20.0 * np.asarray(weights), limits=mampc.Limits(u_min=-reach, u_max=reach),
    )  # fmt: skip
    if plain:
        filtered = mampc.KalmanFilter.offset_free(model, measurement_noise=noise)
        return mampc.Regulator(mampc.MPC(problem), filtered, learn_gains=learn)
    controller = mampc.MAMPC(problem, mampc.MoveRules(price=30.0))
    return mampc.Regulator(controller, mampc.LoadBank(model, noise=noise), learn_gains=learn)


def asked(samples, every=50):
    """Outputs asked for, the operating point at first."""
    levels = np.array([[0.0, 0.0], [1.0, -1.0], [0.0, 1.0], [-1.0, 0.0]])
    return np.resize(np.repeat(levels, every, axis=0), (samples, 2))


def loop(plant, own, samples, *, seed=0, spoil=None, noise=NOISE, reference=None):
    """Decisions, states and measurements of a linear plant under a regulator, beginning at the operating point."""
    rng, state, x, u = np.random.default_rng(seed), own.initial_state(), np.zeros(plant.n_states), plant.u_op
    reference, decisions, states, measured = (
        asked(samples) if reference is None else reference,
        [],
        [state],
        [],
    )
    for k in range(samples):
        y = plant.y_op + plant.C @ x + plant.D @ (u - plant.u_op) + noise * rng.standard_normal(2)
        y = y if spoil is None else spoil(k, y)
        decision = own.step(state, y, reference[k])
        state, u = decision.state, decision.u
        x = plant.A @ x + plant.B @ (u - plant.u_op)
        decisions.append(decision)
        states.append(state)
        measured.append(y)
    return decisions, states, np.array(measured)


@cache
def off(samples=400, plain=False):
    """The usual regulator, and its loop with a plant whose gains are off."""
    own = regulator(plain=plain)
    return own, *loop(with_gains(MODEL, OFF), own, samples)


def changes(decisions):
    return [k for k, decision in enumerate(decisions) if Remark.GAINS_CORRECTED in decision.remarks]


@pytest.mark.parametrize("plain", [False, True], ids=["exact price", "plain MPC"])
def test_gains_that_are_off_are_found_and_told(plain):
    own, decisions, states, _ = off(plain=plain)
    at = changes(decisions)
    assert at
    assert at[0] >= FEWEST
    assert "gains_corrected" in repr(decisions[at[0]])
    factors = [state.learnt.factors for state in states]
    for k, (before, after) in enumerate(pairwise(factors)):
        assert (before == after).all() is np.bool_(k not in at)
    gains = own.gains(states[-1])
    assert own.gains(states[at[0] + 1]).evidence == 0.0
    np.testing.assert_array_equal(gains.factors, factors[-1])
    np.testing.assert_allclose(gains.learnt, OFF, atol=0.12)
    np.testing.assert_allclose(gains.factors, OFF, atol=0.2)
    assert (np.abs(gains.learnt - OFF) < 4 * gains.deviation).all()


def test_until_gains_change_every_decision_is_that_of_a_loop_that_does_not_learn():
    _, learning, _, y = off()
    usual, _, y_usual = loop(with_gains(MODEL, OFF), regulator(learn=False), 400)
    first = changes(learning)[0]
    np.testing.assert_allclose(y[: first + 1], y_usual[: first + 1], atol=1e-9)
    for one, other in zip(learning[: first + 1], usual, strict=False):
        np.testing.assert_allclose(one.plan, other.plan, atol=1e-9)
        assert one.objective == pytest.approx(other.objective, rel=1e-6)


def test_as_much_is_learnt_as_from_the_record():
    own, decisions, states, y = off()
    u = np.array([decision.u for decision in decisions])
    assert (u[0] == MODEL.u_op).all()  # where the record begins
    found = mampc.learn_gains(own.controller.problem.model, mampc.IOData(u, y, MODEL.dt), noise=NOISE)
    gains = own.gains(states[-1])
    np.testing.assert_allclose(gains.learnt, found.factors, rtol=1e-12)
    np.testing.assert_allclose(gains.deviation, found.deviation, rtol=1e-12)


@pytest.mark.parametrize("seed", seeds(6, quick=2))
def test_gains_that_are_right_stay(seed):
    acting = (loads.RandomSteps(size=0.1, every=300.0),) if seed % 2 else (loads.RandomWalk(size=0.01),)
    run = mampc.simulate(
        MODEL, regulator(), asked(400), noise=NOISE, seed=seed, loads=acting, progress=False
    )  # fmt: skip
    assert not changes(run.decisions)


@pytest.mark.parametrize("plain", [False, True], ids=["exact price", "plain MPC"])
def test_estimated_outputs_do_not_jump_where_gains_change(plain):
    own, decisions, states, y = off(plain=plain)
    nothing = np.zeros(0)
    for k in changes(decisions):
        applied, after = decisions[k - 1].u, states[k + 1]
        old, new = (own._online.regulator(state.learnt.factors) for state in (states[k], after))
        kept = states[k]._replace(learnt=None)
        before = old.step(kept, y[k], asked(400)[k]).state.estimate
        outputs = [
            one.estimator.innovation(estimate, applied, np.zeros(2), nothing)
            for one, estimate in ((old, before), (new, after.estimate))
        ]
        np.testing.assert_allclose(*outputs, atol=1e-9)


@pytest.mark.parametrize("plain", [False, True], ids=["load bank", "filter"])
def test_an_estimate_taken_over_and_back_is_the_same(plain):
    own, _, states, _ = off(plain=plain)
    factors, u, v = np.array([[1.2, 0.9], [0.8, 1.1]]), np.array([0.3, -0.2]), np.zeros(0)
    old, new = own.estimator, own._online.regulator(factors).estimator
    there = taken_over(states[50].estimate, old, new, u, v)
    back = taken_over(there, new, old, u, v)
    y = old.innovation(states[50].estimate, u, np.zeros(2), v)
    np.testing.assert_allclose(new.innovation(there, u, np.zeros(2), v), y, atol=1e-9)
    np.testing.assert_allclose(old.innovation(back, u, np.zeros(2), v), y, atol=1e-9)


def test_a_state_goes_through_json_to_the_bit_and_decides_the_same():
    (own, decisions, states, y), elsewhere = off(), regulator()
    for k in (0, 10, *changes(decisions), changes(decisions)[0] + 1, 250):
        text = states[k].to_json()
        kept = elsewhere.state_from_json(text)
        assert kept.to_json() == text
        for one in (elsewhere.step(kept, y[k], asked(400)[k]), own.step(states[k], y[k], asked(400)[k])):
            assert one.state.to_json() == states[k + 1].to_json()
            np.testing.assert_array_equal(one.plan, decisions[k].plan)


def test_states_that_do_not_fit_are_refused():
    own, usual = regulator(), regulator(learn=False)
    state = own.initial_state()
    content = json.loads(state.to_json())
    for spoilt, words in (
        ({"learnt": None}, "learns"),
        ({"learnt": content["learnt"] | {"factors": [[1.0, 1.0], [1.0, -1.0]]}}, "factors"),
        ({"learnt": content["learnt"] | {"factors": [1.0, 1.0]}}, "shape"),
        ({"learnt": content["learnt"] | {"weights": [1.0, 1.0, 0.0, 0.0]}}, "sum up to 1"),
        ({"learnt": content["learnt"] | {"taught": -1}}, "taught"),
        ({"learnt": {"factors": [[1.0, 1.0], [1.0, 1.0]]}}, "to_json"),
    ):
        with pytest.raises(mampc.MampcError, match=words):
            own.state_from_json(json.dumps(content | spoilt))
    with pytest.raises(mampc.MampcError, match="learnt"):
        usual.state_from_json(state.to_json())
    for one, other in ((own, usual), (usual, own)):
        with pytest.raises(mampc.MampcError, match="gains"):
            one.step(other.initial_state(), [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(mampc.MampcError, match="learn_gains=True"):
        usual.gains(usual.initial_state())


def test_what_cannot_be_learnt_is_refused():
    redundant = mampc.StateSpace.from_first_order(gain=[[1.0, 2.0]], time_constant=[[50.0, 50.0]], dt=10.0)
    level = mampc.StateSpace.from_first_order(gain=[[0.1]], time_constant=[[float("inf")]], dt=10.0)
    for model, words in ((redundant, "stand in for"), (level, "fade")):
        problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=3)
        with pytest.raises(mampc.MampcError, match=words):
            mampc.Regulator(mampc.MPC(problem), mampc.LoadBank(model, noise=0.1), learn_gains=True)
    problem = mampc.TrackingProblem(
        MODEL, prediction_horizon=20, control_horizon=3, limits=mampc.Limits(u_min=-5.0, u_max=5.0)
    )
    told = mampc.KalmanFilter.offset_free(MODEL, measurement_noise=NOISE)
    own = mampc.KalmanFilter(MODEL, told.directions, told._covariance, told._noise)
    own.noise_told = NOISE
    for estimator, words in (
        (mampc.LoadBank.for_problem(problem), "told the noise"),
        (mampc.KalmanFilter.offset_free(MODEL), "told the noise"),
        (own, "offset_free"),
    ):
        with pytest.raises(mampc.MampcError, match=words):
            mampc.Regulator(mampc.MPC(problem), estimator, learn_gains=True)
    with pytest.raises(mampc.MampcError, match="true or false"):
        mampc.Regulator(mampc.MPC(problem), told, learn_gains="yes")


def test_units_decide_nothing():
    of_u, of_y = np.array([4.0, 0.125]), np.array([2.0, 64.0])
    scaled = replace(
        MODEL, B=MODEL.B / of_u, C=MODEL.C * of_y[:, None], D=MODEL.D * of_y[:, None] / of_u, u_op=MODEL.u_op * of_u,
        y_op=MODEL.y_op * of_y,
    )  # fmt: skip
    _, decisions, states, _ = off()
    others, other_states, _ = loop(
        with_gains(scaled, OFF), regulator(scaled, noise=NOISE * of_y, weights=1 / of_u**2), 400, noise=NOISE * of_y,
        reference=asked(400) * of_y,
    )  # fmt: skip
    assert changes(decisions) == changes(others) != []
    for one, other in zip(decisions, others, strict=True):
        np.testing.assert_allclose(other.u / of_u, one.u, atol=1e-6)
    np.testing.assert_allclose(other_states[-1].learnt.factors, states[-1].learnt.factors, rtol=1e-6)


@pytest.mark.parametrize("turned", [(0, 0), (0, 1), (1, 1)])
def test_no_gain_changes_its_sign_whatever_the_plant_does(turned):
    factors = np.ones((2, 2))
    factors[turned] = -1.0
    own = regulator()
    _, states, _ = loop(with_gains(MODEL, factors), own, 400)
    for state in states:
        assert (np.abs(state.learnt.factors - 1) <= MOST).all()
        assert not another_model(MODEL, state.learnt.factors)


def test_gains_under_which_inputs_do_the_same_or_the_opposite_are_those_of_another_model():
    alike = mampc.StateSpace.from_first_order(
        gain=[[1.0, 0.8], [0.8, 1.0]], time_constant=np.full((2, 2), 50.0), dt=10.0
    )
    assert not another_model(alike, np.ones((2, 2)))
    assert "stand in" in another_model(alike, np.array([[0.88, 1.0], [1.0, 0.88]]))
    assert "other way" in another_model(alike, np.array([[0.7, 1.3], [1.3, 0.7]]))


def test_what_is_not_believed_teaches_nothing():
    samples = 200

    def missing(k, y):
        return np.where([k >= 30, k >= 30], np.nan, y)

    own = regulator()
    _, states, _ = loop(with_gains(MODEL, OFF), own, samples, spoil=missing)
    at_first, last = own.gains(states[30]), own.gains(states[-1])
    np.testing.assert_allclose(last.learnt - 1, (at_first.learnt - 1), rtol=0.05, atol=1e-3)
    assert last.evidence == pytest.approx(at_first.evidence, abs=1e-9 + 0.05 * abs(at_first.evidence))
    assert (last.deviation >= at_first.deviation - 1e-12).all()
    assert states[-1].learnt.taught == states[30].learnt.taught


@pytest.mark.parametrize("seed", seeds(4, quick=2))
def test_a_sensor_that_sticks_changes_no_gain(seed):
    held = {}

    def stuck(k, y):
        if 100 <= k < 300:
            return np.array([held.setdefault("y1", y[0]), y[1]])
        return y

    decisions, _, _ = loop(MODEL, regulator(), 350, seed=seed, spoil=stuck)
    assert any(decision.ignored_outputs for decision in decisions)
    assert not changes(decisions)


def test_absurd_measurements_end_no_learning():
    def absurd(k, y):
        return y if k % 7 else np.array([9e11, -9e11]) * (-1.0) ** (k // 7)

    own = mampc.Regulator(
        regulator().controller, mampc.LoadBank(regulator().controller.problem.model, noise=NOISE),
        sensors=mampc.SensorChecks(largest_jump=np.inf, stuck_after=None), learn_gains=True,
    )  # fmt: skip
    decisions, states, _ = loop(with_gains(MODEL, OFF), own, 150, spoil=absurd)
    assert np.isfinite([decision.u for decision in decisions]).all()
    for part in states[-1].learnt:
        assert np.isfinite(part).all()


def test_what_was_learnt_is_forgotten_slowly_and_covariances_stay_such():
    model = mampc.StateSpace.from_first_order(gain=[[2.0]], time_constant=[[30.0]], dt=10.0)
    learner, rng = GainLearner(model, np.array([0.1])), np.random.default_rng(0)
    learnt, x, u, found = learner.initial(np.zeros(1)), np.zeros(1), np.zeros(1), []
    for k in range(1600):
        factor = 1.2 if k < 800 else 0.85
        x = model.A @ x + model.B @ u
        y = factor * model.C @ x + 0.1 * rng.standard_normal(1)
        now = u if k % 10 else rng.uniform(-1, 1, 1)
        learnt = learner.update(learnt, u, u, y)
        u = now
        found.append(learner.found(learnt))
        if k % 200 == 199:
            for P in (*learnt.P, *learnt.usual_P):
                np.testing.assert_allclose(P, P.T, atol=1e-9 * np.abs(P).max())
                assert (np.linalg.eigvalsh((P + P.T) / 2) > -1e-12 * np.abs(P).max()).all()
    assert found[799][0][0, 0] == pytest.approx(1.2, abs=0.02)
    assert 1.2 - found[-1][0][0, 0] > 0.1  # on its way to what the plant is now
    assert 1e-4 < found[-1][1][0, 0] < PRIOR


def test_a_run_with_learnt_gains_replays_and_batches():
    plant, own = with_gains(MODEL, OFF), regulator()
    run = mampc.simulate(plant, own, asked(200), noise=NOISE, seed=3, progress=False)
    assert changes(run.decisions)
    state = own.initial_state(run.u_initial, plant.y_op)
    assert mampc.replay(regulator(), state, mampc.Recording.of(run), tolerance=0.0) is None
    batch = mampc.simulate_batch(plant, own, asked(200), noise=NOISE, seeds=[3, 4], progress=False)
    np.testing.assert_allclose(batch.u[0], run.u, atol=1e-9)


@pytest.mark.parametrize("seed", seeds(4, quick=2))
def test_a_loop_that_learns_costs_less_where_gains_are_off(seed):
    plant = with_gains(MODEL, OFF)
    costs = []
    for learn in (False, True):
        run = mampc.simulate(
            plant, regulator(learn=learn), asked(600), noise=NOISE, seed=seed, loads=(loads.RandomWalk(size=0.01),),
            progress=False,
        )  # fmt: skip
        error = np.square((run.y - asked(600)) / NOISE)[300:].sum()
        costs.append(error + 30.0 * np.count_nonzero(np.diff(run.u, axis=0)[300:]))
    assert costs[1] < 1.05 * costs[0]


@pytest.mark.parametrize("seed", seeds(4, quick=2))
def test_dead_times_and_lags_that_are_off_do_not_pass_for_gains(seed):
    late = mampc.StateSpace.from_first_order(
        gain=[[2.0, -0.6], [0.5, 1.5]], time_constant=[[60.0, 95.0], [30.0, 75.0]],
        dead_time=[[40.0, 20.0], [20.0, 30.0]], dt=10.0,
    )  # fmt: skip
    acting = (loads.RandomWalk(size=0.01),)
    run = mampc.simulate(late, regulator(), asked(400), noise=NOISE, seed=seed, loads=acting, progress=False)
    assert not changes(run.decisions)
    found = mampc.learn_gains(MODEL, run, noise=NOISE)
    assert not found.accepted
    assert "samples later" in found.reason
