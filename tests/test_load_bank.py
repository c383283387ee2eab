"""The load bank: its filters, its weights, what it says, and what it leaves."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import mampc
from builders import identified_tank, random_model, tank_problem
from mampc import Hypothesis, LoadBank, LoadKind
from mampc.loop.disturbances import state_sizes
from mampc.loop.hypotheses import HYPOTHESES, INPUT_NOISE, Loads, Member
from mampc.loop.load_bank import FORGIVEN, LATE
from mampc.loop.mixing import FORGETS, JUMP_GOES_ON, LEAST, NOISE_REMEMBERED, STAYS, TO_JUMP, UNUSUAL
from mampc.systems.noise import Noise
from mampc.systems.riccati import predicted_covariance, seen_covariance

LEVEL = mampc.StateSpace([[1.0, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0, [5.0], [3.0])
MODELS = {
    "stable": random_model(1, n=4, m=2, l=2, feedthrough=True),
    "integrating": LEVEL,
    "slow": mampc.StateSpace(np.diag([1 - 1e-6, 0.8]), np.eye(2), [[1, 0.2], [0.3, 1]], None, 1.0),
    "more inputs": random_model(2, n=3, m=3, l=2),
    "more outputs": random_model(3, n=4, m=1, l=3),
    "unstable": mampc.StateSpace([[1.05, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0),
    "measured": replace(
        random_model(4, n=3, m=3, l=2, feedthrough=True), u_op=[1.0, 2.0], v_op=[3.0],
        names=mampc.Names(("u1", "u2"), ("y1", "y2"), (), ("load",)),
    ),
}  # fmt: skip


def bank_of(model, **options):
    return LoadBank(model, **({"noise": np.linspace(0.1, 0.3, model.n_outputs)} | options))


def driven(hypothesis, loads):
    """Covariance of what drives z, written down once more: x by inputs, w by walks and bursts, s by both."""
    model, k, a = loads.model, loads.count, hypothesis.kept
    n = model.n_states
    walk, burst, slope = (np.zeros((n + 2 * k, k)) for _ in range(3))
    walk[n : n + k] = hypothesis.walk * np.eye(k)
    burst[n : n + k], burst[n + k :] = hypothesis.burst * np.eye(k), -(1 - a) * hypothesis.burst * np.eye(k)
    slope[n + k :] = hypothesis.slope * np.eye(k)
    inputs = np.zeros((n + 2 * k, k))
    inputs[:n] = INPUT_NOISE * loads.on_states
    Q = sum(part @ part.T for part in (walk, burst, slope, inputs))
    sizes = state_sizes(model.A, inputs[:n], model.C / loads.noise[:, None])
    Q[:n, :n] += np.diag(1e-10 * np.sum((inputs[:n] / sizes[:, None]) ** 2) * sizes**2)
    return Q


@pytest.mark.parametrize("hypothesis", HYPOTHESES, ids=lambda h: h.load)
@pytest.mark.parametrize("name", ["stable", "integrating", "slow", "more inputs", "more outputs", "measured"])
def test_gains_are_those_that_a_kalman_filter_settles_at(name, hypothesis):
    model = MODELS[name]
    loads = Loads.of(model, np.linspace(0.1, 0.3, model.n_outputs))
    member = Member(hypothesis, loads)
    A, C, Q, R = member.A, member.C, driven(hypothesis, loads), member.noise
    P, K = Q.copy(), np.zeros((len(A), len(C)))
    for _ in range(3000):  # in the form of Joseph, which keeps it positive
        before, K = K, np.linalg.solve(C @ P @ C.T + R, C @ P).T
        if np.allclose(K, before, rtol=0, atol=1e-13 * np.abs(K).max()):
            break
        rest = np.eye(len(A)) - K @ C
        P = A @ (rest @ P @ rest.T + K @ R @ K.T) @ A.T + Q
        P = (P + P.T) / 2
    gain = member.gain(np.ones(len(R), dtype=bool))
    np.testing.assert_allclose(gain, K, atol=1e-6 * np.abs(K).max())
    assert np.linalg.eigvalsh(member.posterior)[0] > -1e-9 * np.abs(member.posterior).max()


@pytest.mark.parametrize("seed", range(4))
def test_where_all_is_detectable_doubling_solves_the_riccati_equation(seed):
    model, rng = random_model(seed, n=4), np.random.default_rng(seed)
    root = rng.standard_normal((4, 4))
    arguments = model.A, model.C, root @ root.T, np.diag([0.1, 2.0])
    expected = solve_discrete_are(model.A.T, model.C.T, *arguments[2:])
    for covariance in (predicted_covariance, seen_covariance):
        np.testing.assert_allclose(covariance(*arguments), expected, rtol=1e-8)


def naive(bank, estimate, drive, surplus, h):
    """One sample of the bank, one hypothesis after the other: members, weights and usual ones.

    h: what the inputs moved the outputs by of late.
    """
    mu, usual, B = estimate.weights, estimate.usual, len(bank.members)
    jumps = [h.load is LoadKind.JUMPS for h in bank.hypotheses]
    T = np.zeros((B, B))
    for a in range(B):
        for b in range(B):
            if jumps[a]:
                T[a, b] = (JUMP_GOES_ON if a == b else 0.0) + (1 - JUMP_GOES_ON) * usual[b]
            elif a == b:
                T[a, b] = STAYS
            else:
                T[a, b] = TO_JUMP if jumps[b] else (1 - STAYS - TO_JUMP) / (B - 2)
    c, predicted, innovation = mu @ T, [], surplus.copy()
    variance, seen = estimate.scale
    n = len(drive)
    for b, member in enumerate(bank.members):
        z = sum(mu[a] * T[a, b] * estimate.members[a] for a in range(B)) / c[b]
        predicted.append(member.A @ z)
        predicted[-1][:n] += drive
        innovation -= c[b] * member.C @ predicted[-1]
    members, likelihood, surprise = [], [], []
    for z, member in zip(predicted, bank.members, strict=True):
        e = surplus - member.C @ z
        S = member.C @ member.covariance @ member.C.T + member.noise
        moved = sum(h[i] ** 2 * np.linalg.inv(S)[i, i] for i in range(len(e)) if h[i] * innovation[i] < 0)
        trust = max(
            1 / (1 + moved / len(e) / min(variance, 1.0)),
            1 - FORGIVEN * np.sqrt(moved / (e @ np.linalg.solve(S, e))),
        )
        doubted = 1 / trust
        members.append(z + member.covariance @ member.C.T @ np.linalg.solve(S, e) / doubted)
        surprise.append(e @ np.linalg.solve(S, e) / doubted)
        likelihood.append(
            np.exp(-0.5 * surprise[-1] / variance) / np.sqrt(np.linalg.det(S) * doubted ** len(e))
        )
    mu = c * likelihood / (c @ likelihood)
    usual = np.maximum((1 - FORGETS) * usual + FORGETS * mu, LEAST) * ~np.array(jumps)
    seen = min(seen + 1, NOISE_REMEMBERED)
    variance += (min(mu @ surprise / len(surplus), UNUSUAL * variance) - variance) / seen
    return np.array(members), mu, usual / usual.sum(), [variance, seen]


@pytest.mark.parametrize("name", MODELS)
def test_weights_follow_bayes_rule_and_one_step_is_prediction_and_correction(name):
    model, rng = MODELS[name], np.random.default_rng(0)
    bank, d = bank_of(model), model.n_disturbances
    estimate, v = bank.initial(model.u_op), model.v_op
    u, x, h, m = model.u_op, np.zeros(model.n_states), np.zeros(model.n_outputs), model.n_inputs
    kept, waits = np.exp(-1 / LATE), np.abs(model.poles()).max() < 1 + 1e-6
    for _ in range(25):
        last_u, last_v = u, v
        u = model.u_op + 0.1 * rng.standard_normal(model.n_inputs)
        v = model.v_op + 0.1 * rng.standard_normal(d)
        y = model.y_op + 0.3 * rng.standard_normal(model.n_outputs)
        drive = model.B @ np.concatenate([u - model.u_op, last_v - model.v_op])
        surplus = y - model.y_op - model.D @ np.concatenate([u - model.u_op, v - model.v_op])
        if waits:
            x = kept * model.A @ x + model.B[:, :m] @ (u - last_u)
            h = kept * (h + model.C @ x + model.D[:, :m] @ (u - last_u))
        members, weights, usual, scale = naive(bank, estimate, drive, surplus, h)
        predicted = bank.predict(estimate, u, last_v)
        innovation = bank.innovation(predicted, u, y, v)
        updated = bank.update(estimate, u, y, last_v, v)
        corrected = bank.corrected(predicted, innovation)
        np.testing.assert_allclose(updated.innovation, innovation, rtol=1e-7, atol=1e-9)
        for one in (updated.estimate, corrected):
            np.testing.assert_allclose(one.weights, weights, rtol=1e-6, atol=1e-12)
            np.testing.assert_allclose(one.usual, usual, rtol=1e-6)
            np.testing.assert_allclose(one.scale, scale, rtol=1e-6)
            np.testing.assert_allclose(one.members, members, rtol=1e-6, atol=1e-6 * np.abs(members).max())
        estimate = updated.estimate


@pytest.mark.parametrize("name", MODELS)
def test_plans_predict_what_the_mixture_of_all_hypotheses_does(name):
    """Each goes on by itself, without noise; the planning model knows them all at once."""
    model, rng = MODELS[name], np.random.default_rng(1)
    bank = bank_of(model)
    rest = bank.initial(model.u_op)
    members = rng.standard_normal(rest.members.shape)
    for b, hypothesis in enumerate(bank.hypotheses):
        if hypothesis.kept == 0:
            members[b, -bank.loads.count :] = 0.0
    weights = rng.dirichlet(np.ones(len(members)))
    predicted = sum(
        w * to
        for w, to in zip(weights, (bank.to_plan(b) @ members[b] for b in range(len(members))), strict=True)
    )
    m, l, plan = model.n_inputs, model.n_outputs, bank.planning_model
    x, d_u, d_y = predicted[: -m - l], predicted[-m - l : -l], predicted[-l:]
    u = np.tile(np.concatenate([model.u_op + d_u, model.v_op]), (12, 1))
    outputs = plan.response(u, x) + d_y
    for i in range(12):
        expected = model.y_op + sum(
            w * member.C @ z for w, member, z in zip(weights, bank.members, members, strict=True)
        )
        np.testing.assert_allclose(outputs[i], expected, rtol=1e-8, atol=1e-8)
        members = np.array([member.A @ z for member, z in zip(bank.members, members, strict=True)])


@pytest.mark.parametrize("rules", [None, mampc.MoveRules(price=1.0)])
def test_units_decide_nothing(rules):
    problem = tank_problem(replace(identified_tank(), noise=None))  # so that the bank has to guess
    model, plant = problem.model, mampc.plants.QuadrupleTank()
    y_op = plant.output(plant.steady_state())
    of_u, of_y = np.array([1e-4, 1e3]), np.array([1e5, 1e-2])
    scaled = replace(
        model, B=model.B / of_u, C=of_y[:, None] * model.C, u_op=of_u * model.u_op, y_op=of_y * model.y_op
    )
    other = mampc.TrackingProblem(
        scaled, prediction_horizon=10, control_horizon=5, output_weight=of_y**-2.0, move_weight=0.1 * of_u**-2.0,
        limits=mampc.Limits(u_min=0.0, u_max=100.0 * of_u),
    )  # fmt: skip
    first, second = (
        mampc.Regulator(mampc.MPC(p) if rules is None else mampc.MAMPC(p, rules), LoadBank(p.model, noise=s))
        for p, s in ((problem, 0.1), (other, 0.1 * of_y))
    )
    states, rng = [first.initial_state(), second.initial_state()], np.random.default_rng(0)
    for k in range(60):
        y = y_op + 0.1 * rng.standard_normal(2) + (2.0 if k > 20 else 0.0)
        one, two = first.step(states[0], y, y_op), second.step(states[1], of_y * y, of_y * y_op)
        assert one.load == two.load
        np.testing.assert_allclose(one.u, two.u / of_u, atol=1e-5)
        np.testing.assert_allclose(one.state.estimate.weights, two.state.estimate.weights, atol=1e-6)
        states = [one.state, two.state]
    np.testing.assert_allclose(LoadBank.for_problem(other).noise, of_y * LoadBank.for_problem(problem).noise)


@pytest.mark.parametrize("name", MODELS)
def test_units_of_states_decide_nothing(name):
    """Over eight decades: gains in outputs and in loads are the same, of the bank and of the Kalman filter."""
    model = MODELS[name]
    n, everything = model.n_states, np.ones(model.n_outputs, dtype=bool)
    of_x = 10 ** np.random.default_rng(0).uniform(-4, 4, n)
    scaled = replace(model, A=of_x[:, None] * model.A / of_x, B=of_x[:, None] * model.B, C=model.C / of_x)
    for one, other in zip(bank_of(model).members, bank_of(scaled).members, strict=True):
        gain, same = one.gain(everything), other.gain(everything)
        same[:n] /= of_x[:, None]
        np.testing.assert_allclose(same, gain, rtol=1e-6, atol=1e-6 * np.abs(gain).max())
    y = model.y_op + 0.3
    one, other = (bank_of(each).initial(model.u_op, y) for each in (model, scaled))
    np.testing.assert_allclose(other.members[:, n:], one.members[:, n:], atol=1e-6)
    np.testing.assert_allclose(other.members[:, :n] / of_x, one.members[:, :n], atol=1e-6)
    gain, same = (mampc.KalmanFilter.offset_free(each).gain.copy() for each in (model, scaled))
    same[:n] /= of_x[:, None]
    np.testing.assert_allclose(same, gain, rtol=1e-6, atol=1e-6 * np.abs(gain).max())


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


@pytest.mark.parametrize("units", [(1e8, 1e-8), (1e-6, 1e6), (1e-3, 1e3)])
def test_states_in_any_units_have_the_same_gains(units):
    """Dead times keep past inputs as states, which so have the units of these."""
    gain, lag, delay = (
        np.array([[-0.5, 1.3], [-0.7, 0.9]]),
        [[9.0, 4.0], [2.0, 15.0]],
        [[3.3, 1.0], [4.0, 2.5]],
    )
    loads = []
    for u, y in ((1.0, 1.0), units):
        model = mampc.StateSpace.from_first_order(
            gain=gain * y / u, time_constant=lag, dead_time=delay, dt=1.0
        )
        bank, nothing = LoadBank(model, noise=0.05 * y), np.zeros(0)
        estimate = bank.initial(np.zeros(2))
        for _ in range(3):
            estimate = bank.update(
                estimate, np.full(2, u), np.array([0.3, -0.2]) * y, nothing, nothing
            ).estimate
        loads.append(bank.loads_of(estimate))
    np.testing.assert_allclose(loads[1], loads[0], rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_plants_with_more_inputs_than_outputs_and_long_delays_have_a_bank(seed):
    """Many loads, some of which no output can tell apart."""
    rng = np.random.default_rng(seed)
    size = (4, 5)
    inputs, outputs = 10 ** rng.uniform(-8, 8, 5), 10 ** rng.uniform(-8, 8, 4)
    model = mampc.StateSpace.from_first_order(
        gain=rng.standard_normal(size) * outputs[:, None] / inputs, time_constant=10 ** rng.uniform(-1, 2, size),
        dead_time=rng.uniform(0, 5, size), dt=1.0,
    )  # fmt: skip
    assert LoadBank(model, noise=0.05 * outputs).model is model


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
        for member, gain in zip(bank.members, bank.filters(believed).gains, strict=True):
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
        ({"noise": 0.0}, "positive"),
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


@pytest.mark.parametrize("told", [0.02, 0.1, 0.5])
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
