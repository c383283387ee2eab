"""The alternating minimisation is the paper's Algorithm 1, and its options do what they say."""

import copy
import pickle
from functools import cache

import cvxpy as cp
import numpy as np
import pytest

import mampc
from builders import cost_of, random_model, same_decision, sample_data, tank_problem
from mampc import Status
from mampc.methods.alternating import HardThreshold
from mampc.moves.admissible import AdmissiblePatterns
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import QuadraticProgram
from seeds import examples

SEEDS = range(examples(20, quick=12))
LAMBDA, MU, EPS1 = 0.1, 2.0, 1e-3
TIGHT = {"tol_gap_abs": 1e-13, "tol_gap_rel": 1e-13, "tol_feas": 1e-13}


@cache
def random_case(seed):
    """A small problem, in half the cases with limits that are active, rules, and one sample's data."""
    rng = np.random.default_rng(seed)
    m, l = 2, int(rng.integers(1, 3))
    ns, n_p = int(rng.integers(1, 5)), int(rng.integers(4, 8))
    model = random_model(seed, n=3, m=m, l=l, feedthrough=seed % 3 == 0)
    past = model.u_op + 0.4 * rng.standard_normal((ns, m))
    past[1:] = np.where(rng.random((ns - 1, m)) < 0.5, past[:-1], past[1:])
    limits = mampc.Limits()
    if seed % 2:
        limits = mampc.Limits(
            u_min=past[-1] - rng.uniform(0.1, 0.4, m), u_max=past[-1] + rng.uniform(0.1, 0.4, m)
        )
    problem = mampc.TrackingProblem(
        model, prediction_horizon=n_p, control_horizon=4, move_weight=LAMBDA, limits=limits
    )
    rules = mampc.MoveRules(max_moves=int(rng.integers(1, 5)), sparsity_horizon=ns)
    return problem, rules, past, 0.5 * rng.standard_normal(3), model.y_op + rng.standard_normal(l)


def paper(problem, rules, past, x, reference):
    """Every iterate (u_k .. u_{k+nc-1}) of Algorithm 1 on P1, by a generic solver, from v = 0."""
    model, s, ns = problem.model, rules.max_moves, rules.sparsity_horizon
    n_p, n_c, m = problem.prediction_horizon, problem.control_horizon, model.n_inputs
    size = ns + n_c
    difference = np.eye(size - 1, size, k=1) - np.eye(size - 1, size)
    Psi = np.kron(np.eye(m), difference)
    upsilon = cp.Variable((m, size))  # one row of past and future inputs per input
    X = cp.Variable((n_p + 1, model.n_states))
    v = cp.Parameter(m * (size - 1))
    u = upsilon[:, ns:].T
    held = np.eye(n_c)[np.minimum(np.arange(n_p + 1), n_c - 1)] @ u - np.tile(model.u_op, (n_p + 1, 1))
    y = X @ model.C.T + held @ model.D.T + np.tile(model.y_op, (n_p + 1, 1))
    moves = upsilon[:, ns:] - upsilon[:, ns - 1 : -1]
    penalised = cp.sum_squares(v - Psi @ cp.reshape(upsilon, (m * size,), order="C"))
    cost = (
        cp.sum_squares(np.tile(reference, (n_p + 1, 1)) - y) + LAMBDA * cp.sum_squares(moves) + MU * penalised
    )
    constraints = [upsilon[:, :ns] == past.T, X[0] == x, X[1:] == X[:-1] @ model.A.T + held[:-1] @ model.B.T]
    if np.isfinite(problem.limits.u_max).all():
        constraints += [
            u >= np.tile(problem.limits.u_min, (n_c, 1)),
            u <= np.tile(problem.limits.u_max, (n_c, 1)),
        ]
    first_step = cp.Problem(cp.Minimize(cost), constraints)
    iterates, v.value = [], np.zeros(m * (size - 1))
    while len(iterates) < 2 or np.abs(iterates[-1] - iterates[-2]).sum() > EPS1:
        first_step.solve(solver=cp.CLARABEL, **TIGHT)
        changes = Psi @ upsilon.value.ravel()
        largest = np.argsort(-np.abs(changes), kind="stable")[:s]
        v.value = np.where(np.isin(np.arange(changes.size), largest), changes, 0.0)
        iterates.append(u.value)
    return iterates


def ours(problem, rules, **settings):
    method = mampc.Alternating(**({"penalty": MU, "tolerance": EPS1, "warm_up": 0} | settings))
    return mampc.MAMPC(problem, rules, method=method)


def decide(controller, past, x, reference):
    return controller.step(controller.initial_state(past), x, reference)


@pytest.mark.filterwarnings("ignore:Solution may be inaccurate")
@pytest.mark.parametrize("seed", SEEDS)
def test_every_iterate_is_that_of_the_papers_algorithm(seed):
    problem, rules, *sample = random_case(seed)
    iterates = paper(problem, rules, *sample)
    assert decide(ours(problem, rules), *sample).iterations == len(iterates)
    for count, expected in enumerate(iterates, start=1):
        decision = decide(ours(problem, rules, max_iterations=count), *sample)
        np.testing.assert_allclose(decision.plan, expected, rtol=0, atol=1e-6)
        assert decision.status is (Status.SETTLED if count == len(iterates) else Status.ITERATION_LIMIT)


def test_the_random_cases_include_active_limits_and_many_rounds():
    at_limit, rounds = 0, []
    for seed in SEEDS:
        problem, rules, *sample = random_case(seed)
        decision, limits = decide(ours(problem, rules), *sample), problem.limits
        at_limit += np.minimum(decision.plan - limits.u_min, limits.u_max - decision.plan).min() < 1e-9
        rounds.append(decision.iterations)
    assert at_limit >= 5
    assert max(rounds) >= 10


def past_moves(rules, past):
    return np.count_nonzero(np.diff(past, axis=0)) if rules.sparsity_horizon > 1 else 0


def largest_of_the_window(rules, past, d):
    """Which of the future moves d (nc, m) are among the s largest of the past and future ones."""
    window = np.abs(np.vstack([np.diff(past, axis=0), d])).T.ravel()  # stacked per input, as the paper does
    chosen = np.isin(np.arange(window.size), np.argsort(-window, kind="stable")[: rules.max_moves])
    return chosen.reshape(d.shape[1], -1).T[-len(d) :]


@pytest.mark.parametrize("seed", SEEDS)
def test_at_a_fixed_point_moves_off_the_pattern_pay_lambda_plus_mu(seed):
    problem, rules, past, x, reference = random_case(seed)
    controller = ours(problem, rules, tolerance=1e-11, max_iterations=100_000)
    decision = decide(controller, past, x, reference)
    assert decision.status is Status.SETTLED
    condensed, pattern = controller.condensed, largest_of_the_window(rules, past, decision.changes)
    sample = sample_data(condensed, past[-1], x=x, reference=reference)
    weights = np.diag(np.where(pattern.ravel(), 0.0, 2 * MU))
    program = QuadraticProgram(condensed.H + weights, condensed.program.A, condensed.program.n_simple)
    expected = DaqpSolver(program).solve(sample.f, sample.lower, sample.upper).z
    np.testing.assert_allclose(decision.changes.ravel(), expected, atol=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_objective_is_that_of_the_plan_without_the_penalty(seed):
    problem, rules, past, x, reference = random_case(seed)
    for polish in (False, True):
        decision = decide(ours(problem, rules, polish=polish), past, x, reference)
        expected = cost_of(problem, x, past[-1], reference, decision.plan)
        assert decision.objective == pytest.approx(expected, rel=1e-9)
        assert decision.lower_bound == -np.inf
        assert decision.gap == np.inf


@pytest.mark.parametrize("seed", SEEDS)
def test_a_polished_plan_keeps_the_budget_that_past_moves_leave_exactly(seed):
    problem, rules, past, x, reference = random_case(seed)
    plain = decide(ours(problem, rules), past, x, reference)
    polished = decide(ours(problem, rules, polish=True), past, x, reference)
    assert polished.status is Status.FEASIBLE
    assert polished.moves.sum() <= max(0, rules.max_moves - past_moves(rules, past))
    assert not polished.moves[~largest_of_the_window(rules, past, plain.changes)].any()
    assert (polished.changes[~polished.moves] == 0.0).all()
    repeated = np.diff(np.vstack([past[-1], polished.plan]), axis=0)[~polished.moves]
    assert np.abs(repeated).max(initial=0.0) < 1e-12


def test_a_polished_plan_is_the_best_one_on_its_pattern():
    problem, _, past, x, reference = random_case(0)
    rules = mampc.MoveRules(max_moves=3)
    decision = decide(ours(problem, rules, polish=True), past, x, reference)
    assert decision.moves.sum() == 3
    for j, i in np.argwhere(decision.moves):
        for nudge in (1e-3, -1e-3):
            plan = decision.plan.copy()
            plan[j:, i] += nudge
            assert cost_of(problem, x, past[-1], reference, plan) > decision.objective


@pytest.mark.parametrize("seed", range(6))
def test_a_budget_for_all_moves_gives_plain_mpc(seed):
    problem, rules, past, x, reference = random_case(seed)
    rules = mampc.MoveRules(max_moves=100, sparsity_horizon=rules.sparsity_horizon)
    expected = mampc.MPC(problem)
    expected = expected.step(expected.initial_state(past), x, reference)
    free = decide(ours(problem, rules, tolerance=1e-10, max_iterations=10_000), past, x, reference)
    np.testing.assert_allclose(free.plan, expected.plan, atol=1e-6)
    polished = decide(ours(problem, rules, polish=True), past, x, reference)
    np.testing.assert_allclose(polished.plan, expected.plan, atol=1e-9)


def run(controller, samples, reference):
    """Decisions of a controller on the exact model."""
    model, state = controller.problem.model, controller.initial_state()
    x, decisions = np.zeros(model.n_states), []
    for _ in range(samples):
        decisions.append(controller.step(state, x, reference))
        state, u = decisions[-1].state, decisions[-1].u
        x = model.A @ x + model.B @ (u - model.u_op)
    return decisions


def test_a_budget_of_zero_never_moves_when_polished():
    problem = tank_problem()
    controller = ours(problem, mampc.MoveRules(max_moves=0), polish=True)
    for decision in run(controller, 5, problem.model.y_op + 3.0):
        assert not decision.moves.any()
        np.testing.assert_array_equal(decision.plan, np.full((5, 2), 50.0))


@pytest.mark.parametrize("counted", [2, 3, 5])
def test_no_window_of_a_polished_run_holds_more_moves_than_the_budget(counted):
    problem = tank_problem()
    rules = mampc.MoveRules(max_moves=3, sparsity_horizon=counted)
    decisions = run(ours(problem, rules, polish=True), 30, problem.model.y_op + np.array([2.0, -1.0]))
    moved = np.array([decision.moves[0] for decision in decisions])
    assert moved.any()
    for k, decision in enumerate(decisions):
        assert moved[max(0, k - counted + 1) : k].sum() + decision.moves.sum() <= 3


@pytest.mark.parametrize(("settings", "samples"), [({"warm_up": None}, 3), ({"warm_up": 5}, 5), ({}, 0)])
def test_plain_mpc_warms_up_for_as_many_samples_as_asked(settings, samples):
    problem = tank_problem()
    reference = problem.model.y_op + 1.0
    rules = mampc.MoveRules(max_moves=3, sparsity_horizon=3)
    decisions = run(ours(problem, rules, **settings), 8, reference)
    expected = run(mampc.MPC(problem), 8, reference)
    warm = [decision.status is Status.WARM_UP for decision in decisions]
    assert warm == [k < samples for k in range(8)]
    for ours_, mpc in zip(decisions[:samples], expected, strict=False):
        np.testing.assert_array_equal(ours_.plan, mpc.plan)
        assert ours_.lower_bound == -np.inf


def test_a_sparsity_horizon_of_one_remembers_no_earlier_move_and_a_longer_one_does():
    problem, *_ = random_case(0)
    x, reference, u = np.array([0.3, -0.4, 0.2]), problem.model.y_op + 1.0, problem.model.u_op
    for ns in (1, 2, 3):
        controller = ours(problem, mampc.MoveRules(max_moves=2, sparsity_horizon=ns))
        assert controller.memory == ns
        restless = decide(controller, np.stack([u - 5.0, u]), x, reference)
        rested = decide(controller, np.stack([u, u]), x, reference)
        assert np.allclose(restless.plan, rested.plan, atol=1e-3) is (ns == 1)


def test_the_window_holds_one_past_change_less_than_the_sparsity_horizon():
    inputs = np.array([[1.0], [2.0], [4.0], [4.0], [8.0]])
    rules = mampc.MoveRules(max_moves=4, sparsity_horizon=3)
    np.testing.assert_array_equal(rules.past_changes(inputs), [[0.0], [4.0]])
    assert AdmissiblePatterns(rules, n_inputs=1, control_horizon=10).allowance(inputs).left == 3
    assert AdmissiblePatterns(rules, n_inputs=1, control_horizon=2).allowance(inputs).left == 2


def test_the_next_sample_starts_from_the_shifted_pattern():
    problem, _, past, x, reference = random_case(0)
    rules = mampc.MoveRules(max_moves=5)
    decision = decide(ours(problem, rules), past, x, reference)
    kept = np.where(largest_of_the_window(rules, past[-1:], decision.changes), decision.changes, 0.0)
    assert kept[1:].any()
    np.testing.assert_array_equal(decision.state.guess, np.vstack([kept[1:], np.zeros(2)]))
    controller = ours(problem, rules, tolerance=1e-10, max_iterations=10_000)
    settled = decide(controller, past, x, reference)
    state = controller.initial_state(past)._replace(guess=kept)
    assert controller.step(state, x, reference).iterations < settled.iterations


def test_a_step_is_pure():
    problem, rules, past, x, reference = random_case(1)
    controller = ours(problem, rules, polish=True)
    state = controller.initial_state(past)
    first = controller.step(state, x, reference)
    controller.step(first.state, -x, reference)
    assert same_decision(controller.step(state, x, reference), first)
    twin = pickle.loads(pickle.dumps(controller))
    assert same_decision(twin.step(copy.deepcopy(state), x, reference), first)
    np.testing.assert_array_equal(state.inputs, past)


def test_among_equal_moves_the_first_in_the_order_of_psi_is_kept():
    threshold = HardThreshold(s=2, sparsity_horizon=2, n_inputs=2, n_moves=4)
    magnitude = threshold.magnitude(np.array([[0.0, 1.0]]))  # Psi: u1 past, u1, u1, u2 past, u2, u2
    chosen = threshold.pattern(magnitude, np.array([0.5, 1.0, -1.0, 1.0]))  # (time, input)
    np.testing.assert_array_equal(chosen, [False, False, True, False])


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_numbers_that_are_not_usable_hold_the_inputs_and_the_next_step_is_right(bad):
    problem, rules, past, x, reference = random_case(1)
    controller = ours(problem, rules)
    held = decide(controller, past, np.full_like(x, bad), reference)
    assert held.status is Status.HELD_BAD_MEASUREMENT
    np.testing.assert_array_equal(held.plan, np.tile(past[-1], (4, 1)))
    assert same_decision(
        decide(controller, past, x, reference), decide(ours(problem, rules), past, x, reference)
    )


@pytest.mark.parametrize("polish", [False, True])
def test_move_limits_that_contradict_the_input_range_still_give_inputs_within_the_range(polish):
    problem = tank_problem(limits=mampc.Limits(u_min=0.0, u_max=100.0, du_max=1.0))
    controller = ours(problem, mampc.MoveRules(max_moves=3), polish=polish)
    decision = decide(controller, [120.0, 50.0], np.zeros(4), problem.model.y_op)
    assert not decision.held
    assert (decision.plan >= 0.0).all()
    assert (decision.plan <= 100.0).all()


def test_inputs_outside_their_range_come_back_and_count_as_moves():
    controller = ours(tank_problem(), mampc.MoveRules(max_moves=1, sparsity_horizon=2), polish=True)
    state = controller.initial_state([120.0, 120.0])
    decision = controller.step(state, np.zeros(4), controller.problem.model.y_op)
    np.testing.assert_array_equal(decision.u, [100.0, 100.0])
    np.testing.assert_array_equal(decision.changes[0], [-20.0, -20.0])
    assert not decision.moves[1:].any()


def test_without_any_limit_the_polished_plan_is_the_best_on_its_pattern():
    """No limits at all leave programs without a single bound."""
    problem = tank_problem(limits=mampc.Limits())
    controller = ours(problem, mampc.MoveRules(max_moves=2, sparsity_horizon=2), polish=True)
    rng, u, condensed = np.random.default_rng(0), np.array([50.0, 50.0]), controller.condensed
    for _ in range(30):
        x, reference = rng.standard_normal(4), problem.model.y_op
        decision = decide(controller, u, x, reference)
        assert decision.status in (Status.FEASIBLE, Status.ITERATION_LIMIT)
        assert np.count_nonzero(decision.changes) <= 2
        f = sample_data(condensed, u, x=x, reference=reference).f_moves
        gradient = condensed.H @ decision.changes.ravel() + f
        np.testing.assert_allclose(gradient[decision.moves.ravel()], 0.0, atol=1e-8)


def test_rounding_of_what_was_applied_is_no_move():
    rules = mampc.MoveRules(max_moves=1, sparsity_horizon=3)
    wobbly = np.array([[50.0, 50.0], [50.0 + 1e-12, 50.0], [50.0, 50.0 - 1e-12]])
    assert AdmissiblePatterns(rules, n_inputs=2, control_horizon=5).allowance(wobbly).left == 1


def test_output_limits_are_softened_in_every_round():
    problem = tank_problem(limits=mampc.Limits(u_min=0.0, u_max=100.0, y_max=tank_problem().model.y_op - 1.0))
    decision = decide(
        ours(problem, mampc.MoveRules(max_moves=3)), [50.0, 50.0], np.zeros(4), problem.model.y_op
    )
    assert not decision.held
    assert (decision.u < 50.0).any()


@pytest.mark.parametrize(
    "settings",
    [
        {"penalty": 0.0},
        {"penalty": -1.0},
        {"penalty": np.nan},
        {"penalty": "10"},
        {"tolerance": 0.0},
        {"tolerance": np.inf},
        {"max_iterations": 0},
        {"max_iterations": 2.5},
        {"warm_up": -1},
        {"warm_up": True},
    ],
    ids=str,
)
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(mampc.MampcError, match=r"expected.*received"):
        mampc.Alternating(**settings)


def test_rules_beyond_a_budget_are_kept_by_the_second_step():
    """A fixed point under a price: on the pattern every |d|^2 mu is worth its price."""
    problem, _, past, x, reference = random_case(2)
    prices = (0.0, 0.3, 30.0)
    plans = [
        decide(ours(problem, mampc.MoveRules(price=price), polish=True), past, x, reference)
        for price in prices
    ]
    moves = [int(decision.moves.sum()) for decision in plans]
    assert moves[0] > moves[1] > moves[2] == 0
