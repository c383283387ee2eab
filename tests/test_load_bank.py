"""The load bank: its filters, its weights, and that units decide nothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import mampc
from builders import identified_tank, random_model, tank_problem
from load_bank_models import MODELS, bank_of
from mampc import LoadBank, LoadKind
from mampc.loop.disturbances import state_sizes
from mampc.loop.doubt import FADED, LATE, moves_of_late, remembers, runs_away
from mampc.loop.hypotheses import HYPOTHESES, INPUT_NOISE, Loads, Member
from mampc.loop.mixing import FORGETS, JUMP_GOES_ON, LEAST, NOISE_REMEMBERED, STAYS, TO_JUMP, UNUSUAL
from mampc.systems.riccati import predicted_covariance, seen_covariance


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


def test_a_jump_is_found_behind_long_dead_times():
    model = mampc.StateSpace.from_first_order(
        gain=[[1.0, -0.9], [0.9, 1.0]],
        time_constant=np.full((2, 2), 5.0),
        dead_time=[[50, 10], [10, 50]],
        dt=1.0,
    )
    member = Member(HYPOTHESES[-1], Loads.of(model, np.full(2, 0.05)))
    A, C, K = member.A, member.C, member.gain(np.ones(2, dtype=bool))
    z, z_hat = np.zeros(len(A)), np.zeros(len(A))
    z[model.n_states] = 1.0
    for _ in range(150):
        z, z_hat = A @ z, A @ z_hat
        z_hat += K @ C @ (z - z_hat)
    np.testing.assert_allclose(C @ z_hat, C @ z, atol=1e-3 * np.abs(C @ z).max())


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
    c, predicted = mu @ T, []
    variance, seen = estimate.scale
    n = len(drive)
    for b, member in enumerate(bank.members):
        z = sum(mu[a] * T[a, b] * estimate.members[a] for a in range(B)) / c[b]
        predicted.append(member.A @ z)
        predicted[-1][:n] += drive
    members, likelihood, surprise = [], [], []
    for z, member in zip(predicted, bank.members, strict=True):
        e = surplus - member.C @ z
        S = member.C @ member.covariance @ member.C.T + member.noise
        moved = sum(h[i] ** 2 * np.linalg.inv(S)[i, i] for i in range(len(e)))
        doubted = 1 + moved / len(e) / min(variance, 1.0)
        corrected = 1.0 if remembers(bank.model) else doubted
        members.append(z + member.covariance @ member.C.T @ np.linalg.solve(S, e) / corrected)
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
    u, m, moves = model.u_op, model.n_inputs, []
    response = model.step_response(60)[1:, :, :m]
    plain_filter = mampc.KalmanFilter.offset_free(model, measurement_noise=bank.noise)
    plain = plain_filter.initial(model.u_op)
    for _ in range(25):
        last_u, last_v = u, v
        u = model.u_op + 0.1 * rng.standard_normal(model.n_inputs)
        v = model.v_op + 0.1 * rng.standard_normal(d)
        y = model.y_op + 0.3 * rng.standard_normal(model.n_outputs)
        drive = model.B @ np.concatenate([u - model.u_op, last_v - model.v_op])
        surplus = y - model.y_op - model.D @ np.concatenate([u - model.u_op, v - model.v_op])
        moves.insert(0, u - last_u)
        counted = [np.exp(-(a + 1) / LATE) * response[a] @ du for a, du in enumerate(moves)]
        h = np.sum([part for a, part in enumerate(counted) if np.exp(-a / LATE) > FADED], axis=0)
        members, weights, usual, scale = naive(bank, estimate, drive, surplus, h)
        limit = min(estimate.scale[0], 1.0)
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
        plain = plain_filter.update(plain, u, y, last_v, v).estimate
        np.testing.assert_allclose(
            estimate.x, trusted(bank, estimate, plain, h, limit)[: -m - len(h)], rtol=1e-6, atol=1e-9
        )


def test_moves_make_a_model_doubtful_when_their_dead_times_are_over():
    """As long as they do without; each output counts its own."""
    dead, gain, lag = np.array([[0, 7], [12, 3]]), np.array([[1.0, -0.5], [2.0, 0.3]]), np.full((2, 2), 6.0)
    u = np.random.default_rng(0).standard_normal((60, 2)).cumsum(axis=0)

    def doubted(gain, dead_time):
        step = moves_of_late(
            mampc.StateSpace.from_first_order(gain=gain, time_constant=lag, dead_time=dead_time, dt=1.0)
        )
        late, found = np.zeros(len(step)), np.zeros((60, 2))
        for k, now in enumerate(u):
            late = step @ np.concatenate([late, now])
            found[k] = late[:2]
        return found

    expected = np.zeros((60, 2))
    for i, j in np.ndindex(2, 2):
        pair = np.zeros((2, 2))
        pair[i, j] = gain[i, j]
        expected[dead[i, j] :, i] += doubted(pair, 0 * dead)[: 60 - dead[i, j], i]
    np.testing.assert_allclose(doubted(gain, dead), expected, rtol=1e-9, atol=1e-12)


def trusted(bank, estimate, plain, h, limit):
    """What plans start from: the mixture, as far as h casts no doubt on the model, and else the plain filter."""
    plan = 0.0
    fading = np.zeros(bank.planning_model.n_states - len(plain.x))
    of_plain = np.concatenate([plain.x, fading, plain.input_disturbance, plain.output_disturbance])
    share = 0.0
    for b, (weight, member) in enumerate(zip(estimate.weights, bank.members, strict=True)):
        S = member.C @ member.covariance @ member.C.T + member.noise
        share += weight / (1 + h**2 @ np.diag(np.linalg.inv(S)) / len(h) / limit)
        plan = plan + weight * bank.to_plan(b) @ estimate.members[b]
    if bank._hindsight is not None:
        share *= bank._hindsight.share(estimate.hindsight, estimate.scale)
    return share * plan + (1 - share) * of_plain


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


def test_the_noise_that_is_guessed_does_not_depend_on_dead_times():
    for dead_time in (0.0, 19.0, 60.0):
        model = mampc.StateSpace.from_first_order(gain=2.0, time_constant=5.0, dead_time=dead_time, dt=1.0)
        problem = mampc.TrackingProblem(
            model, prediction_horizon=70, control_horizon=2, limits=mampc.Limits(u_min=0.0, u_max=10.0)
        )
        reach = 10.0 * 2.0 * (1 - np.exp(-20 / 5))
        np.testing.assert_allclose(LoadBank.for_problem(problem).noise, 0.002 * reach, rtol=0.01)


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
        loads.append(bank.loads_of(estimate)[: bank.loads.count])
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


@pytest.mark.parametrize("units", [1.0, 1e5])
@pytest.mark.parametrize("seed", range(5))
def test_integrators_beside_each_other_do_not_run_away_in_any_coordinates(seed, units):
    """Rounding alone leads from one of them to the other."""
    T = np.random.default_rng(seed).standard_normal((4, 4))
    A, B = np.diag([1, 1, 0.8, 0.5]), np.array([[0.1, 0], [0, 0.3], [1, 0], [0, 1]]) * [1.0, units]
    C = np.array([[1, 0, 0.3, 0], [0, 1, 0, 0.2]]) / [[1.0], [units]]
    assert not runs_away(mampc.StateSpace(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), None, 1.0))
    A[0, 1] = 1
    assert runs_away(mampc.StateSpace(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), None, 1.0))


@pytest.mark.parametrize(("lags", "integrators", "runs"), [(3, 0, False), (3, 1, False), (3, 2, True)])
@pytest.mark.parametrize("time_constant", [5.0, 2000.0])
def test_lags_in_a_row_do_not_run_away_however_long_they_take(lags, integrators, runs, time_constant):
    rates = [-1 / time_constant] * lags + [0.0] * integrators
    n = len(rates)
    chain = mampc.StateSpace(np.diag(rates) + np.eye(n, k=-1), np.eye(n, 1), np.eye(n)[-1:], None, 0.0)
    assert runs_away(chain.discretise(1.0)) == runs


def test_what_grows_beyond_all_numbers_runs_away():
    assert runs_away(mampc.StateSpace([[5.0]], [[1.0]], [[1.0]], None, 1.0))


def test_without_any_output_plans_count_on_the_bank_as_little_as_before():
    """What the inputs' moves make doubtful does not become certain where measurements fail."""
    model = MODELS["stable"]
    bank = bank_of(model)
    estimate = bank.initial(model.u_op)
    estimate = bank.update(estimate, model.u_op + 1.0, model.y_op + 1.0, model.v_op, model.v_op).estimate
    predicted = bank.predict(estimate, model.u_op)
    blind = bank.corrected(predicted, np.zeros(model.n_outputs), np.zeros(model.n_outputs, dtype=bool))
    np.testing.assert_allclose(blind.x, predicted.x, rtol=1e-9, atol=1e-12)
    certain = (predicted.weights[:, None] * predicted.members).sum(axis=0)[: model.n_states]
    assert np.abs(blind.x[: model.n_states] - certain).max() > 1e-3


def test_a_vessel_whose_level_nobody_measures_stands_beside_a_loop_with_a_bank():
    model = mampc.StateSpace([[0.8, 0], [1, 1]], [[0.2], [0]], [[1, 0]], None, 1.0)
    seen = mampc.StateSpace([[0.8]], [[0.2]], [[1]], None, 1.0)
    bank, other = bank_of(model), bank_of(seen)
    one, two = bank.initial(model.u_op), other.initial(seen.u_op)
    for k in range(200):
        u, y = np.array([np.sin(k)]), np.array([np.cos(0.1 * k)])
        one, two = (
            b.update(e, u, y, np.zeros(0), np.zeros(0)).estimate for b, e in ((bank, one), (other, two))
        )
    assert one.x[0] == pytest.approx(two.x[0], rel=1e-3, abs=1e-3)
    np.testing.assert_allclose(one.weights, two.weights, rtol=1e-2, atol=1e-3)
