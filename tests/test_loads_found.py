"""The load bank in a loop: what it says of loads, what it leaves of them, and what it does with what it is told."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import identified_tank, tank_problem
from load_bank_models import MODELS, bank_of
from mampc import Hypothesis, LoadBank, LoadKind
from mampc.loop.hypotheses import HYPOTHESES
from mampc.loop.mixing import NOISE_REMEMBERED
from mampc.systems.noise import Noise
from seeds import deep


def said(load, samples=300, seed=0):
    """What the bank says while a load acts at the inputs of the tank's model, in plain MPC."""
    model = identified_tank()
    regulator = mampc.Regulator(mampc.MPC(tank_problem(model)), LoadBank(model, noise=0.1))
    run = mampc.simulate(
        model,
        regulator,
        model.y_op,
        steps=samples,
        noise=0.1,
        seed=seed,
        input_disturbance=load,
        progress=False,
    )
    return [decision.load for decision in run.decisions], run


def test_what_loads_do_is_said_in_words():
    unit = LoadBank(identified_tank(), noise=0.1).loads.at_inputs[:, :2].diagonal()
    k, rng = np.arange(300)[:, None], np.random.default_rng(0)
    steady, _ = said(0.0 * k * unit)
    assert np.mean([load is LoadKind.STEADY for load in steady[50:]]) > 0.9
    jumping, _ = said(20.0 * (k >= 150) * unit)
    assert LoadKind.JUMPS in jumping[150:155] or LoadKind.WANDERS_FAR in jumping[150:155]
    assert LoadKind.JUMPS not in jumping[:150]
    drifting, _ = said(0.3 * np.maximum(k - 100, 0) * unit)
    assert np.mean([load is LoadKind.DRIFTS for load in drifting[130:]]) > 0.9
    wandering, _ = said(3.0 * rng.standard_normal((300, 2)).cumsum(axis=0) * unit)
    assert np.mean([load is LoadKind.WANDERS_FAR for load in wandering[50:]]) > 0.9
    for load in LoadKind:
        assert load.sentence.endswith(".")


@pytest.mark.parametrize("seed", range(3))
def test_after_a_jump_the_outputs_are_back_sooner_than_with_one_filter(seed):
    model = identified_tank()
    load = np.where(np.arange(200)[:, None] >= 60, [8.0, -5.0], 0.0)
    errors = []
    for estimator in (None, LoadBank(model, noise=0.1)):
        regulator = mampc.Regulator(mampc.MPC(tank_problem(model)), estimator)
        run = mampc.simulate(
            model,
            regulator,
            model.y_op,
            steps=200,
            noise=0.1,
            seed=seed,
            input_disturbance=load,
            progress=False,
        )
        errors.append(run.metrics().tracking_error)
    assert errors[1] < 0.85 * errors[0]


@pytest.mark.parametrize("name", ["stable", "integrating", "slow", "unstable", "measured"])
def test_constant_loads_leave_no_offset(name):
    model = MODELS[name]
    m, l = model.n_inputs, model.n_outputs
    problem = mampc.TrackingProblem(model, prediction_horizon=20, control_horizon=4)
    regulator = mampc.Regulator(mampc.MPC(problem), bank_of(model))
    run = mampc.simulate(
        model, regulator, model.y_op + 0.5 * (np.arange(l) == 0), steps=700, input_disturbance=np.full(m, 0.4),
        output_disturbance=np.full(l, 0.2), progress=False,
    )  # fmt: skip
    np.testing.assert_allclose(run.y[-5:], run.r[-5:], atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_a_start_in_a_known_steady_state_has_no_jump(name):
    model = MODELS[name]
    bank, rng = bank_of(model), np.random.default_rng(0)
    u, v = model.u_op.copy(), model.v_op + 0.5
    y = model.y_op + 0.3 * rng.standard_normal(model.n_outputs)
    estimate = bank.initial(u, y, v)
    predicted = bank.predict(estimate, u, v)
    np.testing.assert_allclose(bank.innovation(predicted, u, y, v), 0.0, atol=1e-7)
    np.testing.assert_allclose(predicted.members, estimate.members, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_outputs_that_are_left_never_let_the_estimate_run_away(name):
    model = MODELS[name]
    bank, l = bank_of(model), model.n_outputs
    for lost in range(l):
        believed = np.arange(l) != lost
        for member in bank.members:
            gain = member.gain(believed)
            assert (gain[:, ~believed] == 0).all()
            error = member.A - gain @ member.C @ member.A
            fastest = max(1.0, np.abs(model.poles()).max())
            assert np.abs(np.linalg.eigvals(error)).max() <= fastest + 2e-5
    assert (bank.filters(np.zeros(l, dtype=bool)).gains == 0).all()


def test_hypotheses_can_be_chosen_and_one_is_a_plain_filter():
    model = identified_tank()
    one = LoadBank(model, noise=0.1, hypotheses=(Hypothesis(LoadKind.WANDERS, walk=0.3),))
    assert one.planning_model is model
    estimate = one.update(
        one.initial(model.u_op), model.u_op, model.y_op + 1.0, model.v_op, model.v_op
    ).estimate
    assert one.load(estimate) is LoadKind.WANDERS
    everything = np.ones(2, dtype=bool)
    np.testing.assert_allclose(estimate.members[0], one.members[0].gain(everything) @ [1.0, 1.0], atol=1e-12)
    jumps = LoadBank(model, noise=0.1, hypotheses=(HYPOTHESES[-1],))
    assert jumps.load(jumps.initial(model.u_op)) is LoadKind.JUMPS


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        ({"weights": [0.0] * 6}, "sum up to 1"),
        ({"weights": [2.0, -1.0, 0, 0, 0, 0]}, "sum up to 1"),
        ({"usual": [0.5, 0.4, 0, 0, 0, 0]}, "sum up to 1"),
        ({"members": [[0.0] * 3] * 6}, "shape"),
        ({"members": [[0.0] * 12] * 2}, "shape"),
        ({"weights": None}, "received"),
        ({"scale": [0.0, 10.0]}, "estimate.scale"),
        ({"scale": [1.0]}, "shape"),
    ],
    ids=str,
)
def test_a_state_that_does_not_fit_is_refused(spoil, expected):
    regulator = mampc.Regulator(
        mampc.MPC(tank_problem(identified_tank())), LoadBank(identified_tank(), noise=0.1)
    )
    content = json.loads(regulator.initial_state().to_json())
    regulator.state_from_json(json.dumps(content))
    with pytest.raises(mampc.MampcError, match=expected):
        regulator.state_from_json(json.dumps(content | {"estimate": content["estimate"] | spoil}))
    plain = mampc.Regulator(mampc.MPC(tank_problem(identified_tank())))
    with pytest.raises(mampc.MampcError, match="expected an estimate of"):
        plain.state_from_json(json.dumps(content))
    with pytest.raises(mampc.MampcError, match="expected an estimate of"):
        regulator.state_from_json(plain.initial_state().to_json())


def test_runs_say_what_loads_do_and_replay_and_copies_decide_the_same(tmp_path):
    _, run = said(np.where(np.arange(80)[:, None] >= 40, 8.0, 0.0) * np.ones(2), samples=80)
    run.to_csv(tmp_path / "run.csv")
    recording = mampc.Recording.from_csv(tmp_path / "run.csv", run.names)
    assert recording.load == tuple(decision.load for decision in run.decisions)
    model = identified_tank()
    regulator = pickle.loads(
        pickle.dumps(mampc.Regulator(mampc.MPC(tank_problem(model)), LoadBank(model, noise=0.1)))
    )
    state = regulator.initial_state(run.u_initial, model.y_op)
    assert mampc.replay(regulator, state, recording, tolerance=0.0) is None
    other = replace(recording, load=("jumps", *recording.load[1:]))
    assert mampc.replay(regulator, state, other).quantity == "the load"


def test_after_a_restart_far_away_the_weights_are_still_some():
    """Whatever comes first, some hypothesis holds; also from a state in which jumps alone were possible."""
    model = identified_tank()
    bank = LoadBank(model, noise=1e-3)
    start = bank.initial(model.u_op)
    assert start.weights.sum() == pytest.approx(1.0)
    only_jumps = replace(start, weights=np.eye(6)[5], usual=np.eye(6)[0])
    for estimate in (start, only_jumps):
        for size in (1e11, -1e-11):
            after = bank.corrected(bank.predict(estimate, model.u_op), np.full(2, size))
            assert np.isfinite(after.weights).all()
            assert after.weights.sum() == pytest.approx(1.0)
    assert np.isfinite(bank.corrected(start, np.full(2, 1e11)).weights).all()


def test_an_identified_model_knows_its_noise():
    model = replace(identified_tank(), noise=Noise(np.array([0.1, 0.2]), np.zeros(2)))
    np.testing.assert_array_equal(LoadBank(model).noise, model.noise.output)
    np.testing.assert_array_equal(LoadBank.for_problem(tank_problem(model)).noise, model.noise.output)
    plain = replace(model, noise=Noise(np.zeros(2), np.zeros(2)))
    with pytest.raises(mampc.MampcError, match="standard deviation"):
        LoadBank(plain)
    assert (LoadBank.for_problem(tank_problem(plain)).noise > 0.1).all()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"noise": None}, "expected the standard deviation"),
        ({"noise": [0.1]}, "expected"),
        ({"noise": 0.0}, "above 0"),
        ({"noise": 0.1, "hypotheses": ()}, "at least one"),
        ({"noise": 0.1, "hypotheses": ("steady",)}, "Hypothesis"),
        ({"noise": 0.1, "model": "tank"}, "StateSpace"),
        ({"noise": 0.1, "model": mampc.linearise(mampc.plants.QuadrupleTank())}, "discrete"),
        ({"noise": 0.1, "model": mampc.StateSpace([[1.2]], [[0.0]], [[0.0]], None, 1.0)}, "seen"),
    ],
    ids=lambda a: str(a)[:30],
)
def test_arguments_out_of_range_are_refused(arguments, expected):
    with pytest.raises(mampc.MampcError, match=f"{expected}.*"):
        LoadBank(**({"model": replace(identified_tank(), noise=None)} | arguments))
    with pytest.raises(mampc.MampcError, match="without limits"):
        LoadBank.for_problem(tank_problem(limits=mampc.Limits()))


@pytest.mark.parametrize("method", [None, *mampc.METHODS])
def test_every_method_plans_with_loads_that_fade(method):
    """Another model of the same signals leads to the same decisions where it predicts the same."""
    problem = tank_problem(identified_tank())
    rules = mampc.MoveRules(price=0.1, max_moves=6)
    controller = mampc.MPC(problem) if method is None else mampc.MAMPC(problem, rules, method=method)
    bank = LoadBank(problem.model, noise=0.1)
    other = controller.with_model(bank.planning_model)
    x, more = 0.3 * np.cos(np.arange(problem.model.n_states)), np.zeros(2 * bank.loads.count)
    goal = problem.model.y_op + 1.0
    one = controller.step(controller.initial_state(), x, goal)
    two = other.step(other.initial_state(), np.concatenate([x, more]), goal)
    np.testing.assert_allclose(one.plan, two.plan, atol=1e-6)
    assert one.status == two.status
    assert pickle.loads(pickle.dumps(other)).with_model(problem.model).problem.model is problem.model


@pytest.mark.parametrize("told", [0.02, 0.5, *deep(0.1)])
@pytest.mark.parametrize("load", ["none", "steps", "walk"])
def test_noise_that_is_told_wrongly_is_found_out(told, load):
    problem, tank = tank_problem(), mampc.plants.QuadrupleTank()
    loop = mampc.Regulator(mampc.MPC(problem), LoadBank(problem.model, noise=told))
    acting = {
        "none": [], "steps": [mampc.loads.RandomSteps(size=4.0, every=600.0)],
        "walk": [mampc.loads.RandomWalk(size=0.3)],
    }[load]  # fmt: skip
    reference = np.tile(problem.model.y_op, (300, 1))
    run = mampc.simulate(tank, loop, reference, noise=0.1, seed=1, loads=acting, progress=False)
    state = loop.initial_state(run.u_initial)
    for y, r in zip(run.y_measured, run.r, strict=True):
        state = loop.step(state, y, r).state
    variance, seen = state.estimate.scale
    assert seen == NOISE_REMEMBERED
    assert 0.1 / 1.6 < told * np.sqrt(variance) < 0.1 * 1.6
