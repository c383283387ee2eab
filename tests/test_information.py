"""The value of information: what later data are worth on a fixed pattern, and plans that count on them."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import cost_of, random_model, tank_model
from mampc import Status
from mampc.loop.hypotheses import HYPOTHESES
from mampc.methods.exact import ranking, search
from referees import all_patterns, best_on_every_pattern, charge, keeps_rules
from seeds import seeds
from test_load_bank import driven

LEVEL = mampc.StateSpace([[1.0, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0, [5.0], [3.0])
MODELS = {
    "stable": random_model(1, n=3, m=2, l=2),
    "integrating": LEVEL,
    "more inputs": random_model(2, n=3, m=3, l=2),
    "unstable": mampc.StateSpace([[1.05, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0),
}


def problem_of(model, n_c=3, **settings):
    return mampc.TrackingProblem(
        model, **({"prediction_horizon": 8, "control_horizon": n_c, "move_weight": 0.05} | settings)
    )


def counting(problem, price, *, hypotheses=HYPOTHESES, noise=0.1, **settings):
    """A regulator that counts on later data, and its planner."""
    bank = mampc.LoadBank(problem.model, noise=noise, hypotheses=hypotheses)
    controller = mampc.MAMPC(problem, mampc.MoveRules(price=price), **settings)
    regulator = mampc.Regulator(controller, bank, value_of_information=True)
    return regulator, regulator._planner


@pytest.mark.parametrize("load", [1, 2, 3, 4])
@pytest.mark.parametrize("name", ["stable", "integrating", "more inputs"])
def test_on_a_fixed_pattern_it_is_what_planning_again_saves(name, load):
    """In simulations of states that move as one hypothesis says, seen with noise, from what is known of them."""
    model, hypothesis, rng = MODELS[name], HYPOTHESES[load], np.random.default_rng(load)
    problem = problem_of(model)
    regulator, planner = counting(problem, 1.0, hypotheses=(hypothesis,))
    (member,) = regulator.estimator.members
    n_c, n_p, m, l = problem.control_horizon, problem.prediction_horizon, model.n_inputs, model.n_outputs
    A, C, paths = member.A, member.C, 4000
    gain, n_z, n = member.gain(np.ones(l, dtype=bool)), len(member.A), n_c * model.n_inputs
    step = model.step_response(n_p + 1)[:, :, :m]
    theta = np.zeros((n_p + 1, l, n_c, m))
    for j in range(n_c):
        theta[j:, :, j] = step[: n_p + 1 - j]
    theta = theta.reshape(n_p + 1, l, n)
    H = np.einsum("kli,klj->ij", theta, theta) + np.kron(np.eye(n_c), problem.move_weight)

    def sampled(covariance):
        values, vectors = np.linalg.eigh(covariance)
        return rng.standard_normal((paths, n_z)) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T

    off = sampled(member.posterior)  # of the states from their estimate
    drive = driven(hypothesis, regulator.estimator.loads)
    estimate, z, seen, estimates = np.zeros((paths, n_z)), off, [], []
    for k in range(n_p + 1):
        if k:
            z = z @ A.T + sampled(drive)
            estimate = estimate @ A.T
            y = z @ C.T + rng.multivariate_normal(np.zeros(l), member.noise, paths)
            estimate = estimate + (y - estimate @ C.T) @ gain.T
        seen.append(z @ C.T)
        estimates.append(estimate)
    for pattern in rng.random((3, n)) < 0.7:
        d = np.zeros((paths, n))
        for j in range(n_c):
            rows = np.flatnonzero(pattern & (np.arange(n) >= j * m))
            f, ahead = np.zeros((paths, n)), estimates[j]
            for k in range(j, n_p + 1):
                f += (ahead @ C.T) @ theta[k]
                ahead = ahead @ A.T
            made = np.where(np.arange(n) < j * m, d, 0.0)
            d[:, rows] = (
                -np.linalg.solve(H[np.ix_(rows, rows)], (f + made @ H)[:, rows].T).T if len(rows) else 0.0
            )
        f = sum(seen[k] @ theta[k] for k in range(n_p + 1))
        saved = -np.einsum("pi,ij,pj->p", d, H, d) - 2 * np.einsum("pi,pi->p", d, f)
        nothing = np.zeros(n, dtype=bool)
        expected = (planner.information.forgone(nothing) - planner.information.forgone(pattern))[0]
        assert abs(saved.mean() - expected) < 4.5 * saved.std() / np.sqrt(paths) + 1e-12


@pytest.mark.parametrize("name", MODELS)
def test_it_falls_with_every_move_and_is_nothing_where_all_are_free(name):
    _, planner = counting(problem_of(MODELS[name], tail_horizon=3.0), 1.0)
    n, m = planner.condensed.n_moves, MODELS[name].n_inputs
    rng = np.random.default_rng(0)
    for pattern in rng.random((20, n)) < 0.5:
        less = pattern & (rng.random(n) < 0.7)
        assert (
            planner.information.forgone(less) >= planner.information.forgone(pattern) * (1 - 1e-9) - 1e-12
        ).all()
    free = np.arange(n) >= m  # moves at once are chosen with what is known now
    np.testing.assert_allclose(planner.information.forgone(free), 0.0, atol=1e-12)
    assert (planner.information.forgone(np.zeros(n, dtype=bool)) > 0).all()


@pytest.mark.parametrize("limit", [None, 0.6])
@pytest.mark.parametrize("method", ["table", "tree"])
@pytest.mark.parametrize("seed", seeds(8, quick=4))
def test_the_exact_search_finds_the_best_plan_and_proves_it(seed, method, limit, monkeypatch):
    if method == "tree":
        monkeypatch.setattr(search, "ranking_of", lambda *_: None)
    model, rng = random_model(seed, n=3, m=2, l=2), np.random.default_rng(seed)
    limits = (
        mampc.Limits() if limit is None else mampc.Limits(u_min=model.u_op - limit, u_max=model.u_op + limit)
    )
    problem = problem_of(model, limits=limits)
    rules = mampc.MoveRules(price=(0.3, 0.5), max_moves=4 if seed % 2 else None)
    bank = mampc.LoadBank(model, noise=0.3)
    regulator = mampc.Regulator(mampc.MAMPC(problem, rules), bank, value_of_information=True)
    planner = regulator._planner
    weights = rng.dirichlet(np.ones(len(HYPOTHESES)))
    x = np.concatenate([rng.standard_normal(3), np.zeros(planner.problem.model.n_states - 3)])
    reference = model.y_op + 2 * rng.standard_normal(2)
    decision = planner.step(planner.initial_state(), x, reference, hypotheses=weights)
    alone = best_on_every_pattern(planner.problem, rules, x, model.u_op, reference)
    best = min(
        cost + charge(rules, pattern) + float(planner.information.forgone(pattern.ravel()) @ weights)
        for cost, pattern in zip(alone, all_patterns(3, 2), strict=True)
        if keeps_rules(rules, model.u_op[None], pattern)
    )
    assert decision.status is Status.OPTIMAL
    assert decision.gap == 0
    assert decision.objective == pytest.approx(best, rel=1e-7)
    own = (
        cost_of(planner.problem, x, model.u_op, reference, decision.plan)
        + decision.moves.sum(axis=0) @ rules.price
    )
    forgone = planner.information.forgone(decision.moves.ravel()) @ weights
    if limit is None:
        assert decision.objective == pytest.approx(own + forgone, rel=1e-8)
    else:  # at a limit a planned move may be nothing as yet
        assert decision.objective <= (own + forgone) * (1 + 1e-8)


def test_what_a_tree_searches_is_listed_where_plans_count_on_later_data(monkeypatch):
    problem, weights = problem_of(tank_model()), np.full(len(HYPOTHESES), 1 / len(HYPOTHESES))
    asked = {"x": np.zeros(counting(problem, 0.5)[1].problem.model.n_states), "hypotheses": weights}
    asked["reference"] = problem.model.y_op + np.array([0.5, -0.3])
    planners = [counting(problem, 0.5, noise=0.3)[1]]
    monkeypatch.setattr(ranking, "LARGEST_TABLE", 0)
    regulator, planner = counting(problem, 0.5, noise=0.3)
    assert planner._search.has_table
    assert not regulator.controller._search.has_table
    monkeypatch.setattr(search, "LARGEST_BESIDE_DATA", 0)
    planners += [planner, counting(problem, 0.5, noise=0.3)[1]]
    assert not planners[-1]._search.has_table
    decisions = [planner.step(planner.initial_state(), **asked) for planner in planners]
    for decision in decisions[1:]:
        np.testing.assert_allclose(decision.plan, decisions[0].plan, atol=1e-9)
        assert decision.gap == 0


def test_every_method_keeps_to_the_same_objective():
    problem = problem_of(tank_model(), output_weight=1.0)
    _, exact = counting(problem, 0.5, noise=0.3)
    weights = np.full(len(HYPOTHESES), 1 / len(HYPOTHESES))
    x = np.zeros(exact.problem.model.n_states)
    given = {"reference": problem.model.y_op + np.array([0.5, -0.3]), "hypotheses": weights}
    best = exact.step(exact.initial_state(), x, **given)
    for method in ("greedy", "penalty_decomposition", "hard_thresholding", "admm", "l1"):
        _, planner = counting(problem, 0.5, noise=0.3, method=method, certify=True)
        decision = planner.step(planner.initial_state(), x, **given)
        assert decision.objective >= best.objective * (1 - 1e-9)
        assert decision.lower_bound == pytest.approx(best.objective, rel=1e-8)


def test_it_is_off_by_one_argument_and_refused_where_it_has_no_meaning():
    problem = problem_of(tank_model())
    bank, rules = mampc.LoadBank(problem.model, noise=0.1), mampc.MoveRules(price=1.0)
    assert (
        mampc.Regulator(mampc.MAMPC(problem, rules), bank, value_of_information=False)._planner.information
        is None
    )
    with pytest.raises(
        mampc.MampcError,
        match="value_of_information: expected a controller MAMPC, or a bank of them, received MPC",
    ):
        mampc.Regulator(mampc.MPC(problem), bank, value_of_information=True)
    with pytest.raises(
        mampc.MampcError, match="noise in output units, such as a LoadBank, received KalmanFilter"
    ):
        mampc.Regulator(mampc.MAMPC(problem, rules), value_of_information=True)
    with pytest.raises(mampc.MampcError, match="value_of_information"):
        mampc.Regulator(mampc.MAMPC(problem, rules), bank, value_of_information="yes")


@pytest.mark.parametrize("name", MODELS)
def test_units_decide_nothing(name):
    model = MODELS[name]
    of_u, of_y = 2.0 ** np.arange(-3, model.n_inputs - 3), 2.0 ** np.arange(4, model.n_outputs + 4)
    scaled = replace(
        model, B=model.B / of_u, C=model.C * of_y[:, None], D=model.D * of_y[:, None] / of_u,
        u_op=model.u_op * of_u, y_op=model.y_op * of_y,
    )  # fmt: skip
    usual = counting(problem_of(model, tail_horizon=2.0), 1.0)[1].information
    other = counting(
        problem_of(scaled, output_weight=1 / of_y**2, move_weight=0.05 / of_u**2, tail_horizon=2.0), 1.0,
        noise=0.1 * of_y,
    )[1].information  # fmt: skip
    for pattern in np.random.default_rng(0).random((10, 3 * model.n_inputs)) < 0.5:
        np.testing.assert_allclose(other.forgone(pattern), usual.forgone(pattern), rtol=1e-6, atol=1e-12)


def test_plans_wait_where_data_are_worth_more_than_a_sample_is():
    """A lag under loads that wander far, seen with much noise: with a high price its first move comes later."""
    problem = problem_of(tank_model(), output_weight=1.0)
    first = {}
    for counts in (False, True):
        bank = mampc.LoadBank(problem.model, noise=0.5)
        regulator = mampc.Regulator(
            mampc.MAMPC(problem, mampc.MoveRules(price=3.0)), bank, value_of_information=counts
        )
        planner, weights = regulator._planner, np.eye(len(HYPOTHESES))[-1]
        x = np.zeros(planner.problem.model.n_states)
        decision = planner.step(
            planner.initial_state(), x, problem.model.y_op + np.array([0.8, 0.5]), hypotheses=weights
        )
        first[counts] = int(np.flatnonzero(decision.moves.any(axis=1)).min(initial=3))
    assert first[True] > first[False]


@pytest.mark.parametrize("factor", [0.2, 1.0, 5.0])
def test_prices_that_follow_the_noise_are_those_of_a_bank_that_was_told_it(factor):
    problem, weights = (
        problem_of(tank_model(), output_weight=1.0),
        np.full(len(HYPOTHESES), 1 / len(HYPOTHESES)),
    )
    rules = mampc.MoveRules(price=0.4)
    told = mampc.Regulator(
        mampc.MAMPC(problem, rules), mampc.LoadBank(problem.model, noise=0.3), value_of_information=True,
        price_follows_noise=True,
    )._planner  # fmt: skip
    scaled = counting(problem, 0.4 * factor, noise=0.3 * np.sqrt(factor))[1]
    x = np.zeros(told.problem.model.n_states)
    for change in ([0.5, -0.3], [1.5, 2.0], [0.1, 0.1]):
        reference = problem.model.y_op + np.array(change)
        one = told.step(told.initial_state(), x, reference, hypotheses=factor * weights)
        other = scaled.step(scaled.initial_state(), x, reference, hypotheses=weights)
        np.testing.assert_allclose(one.plan, other.plan, atol=1e-9)
        assert one.objective == pytest.approx(other.objective, rel=1e-9)
        assert one.gap == 0


def test_prices_follow_the_noise_only_where_all_patterns_are_listed():
    problem = problem_of(tank_model())
    bank = mampc.LoadBank(problem.model, noise=0.1)
    sparse = mampc.MAMPC(problem, mampc.MoveRules(price=1.0))
    with pytest.raises(mampc.MampcError, match="value_of_information=True beside it"):
        mampc.Regulator(sparse, bank, value_of_information=False, price_follows_noise=True)
    greedy = mampc.MAMPC(problem, mampc.MoveRules(price=1.0), method="greedy")
    with pytest.raises(mampc.MampcError, match="price_follows_noise: expected method='exact'"):
        mampc.Regulator(greedy, bank, value_of_information=True, price_follows_noise=True)
