"""Targets and costs of inputs: what they cost, where loops come to rest, and what `targets` says of it."""

from dataclasses import replace

import numpy as np
import pytest

import mampc
from builders import cost_of, random_model
from mampc.study import parse_study, run_study, template
from referees import best_on_every_pattern, charge, keeps_rules, objective_of, program_of, scip_bounds
from seeds import seeds

WIDE = mampc.Limits(u_min=-3.0, u_max=3.0)


def mixing(**changes):
    """Two inputs that do the same to one output, the first at twice the second's gain and half its speed."""
    model = mampc.StateSpace.from_first_order(gain=[[2.0, 1.0]], time_constant=[[10.0, 5.0]], dt=1.0)
    settings = {"prediction_horizon": 15, "control_horizon": 3, "tail_horizon": 30.0, "limits": WIDE}
    return mampc.TrackingProblem(model, **settings | changes)


def random_problem(seed, **changes):
    rng = np.random.default_rng(seed)
    model = random_model(seed, m=2, l=1 + seed % 2)
    limits = mampc.Limits(u_min=model.u_op - 1, u_max=model.u_op + rng.uniform(0.2, 1, 2))
    if seed % 3 == 0:
        limits = replace(limits, y_max=model.y_op + 0.5)
    settings = {
        "prediction_horizon": 6, "control_horizon": 3, "limits": limits, "u_target": model.u_op + rng.uniform(-1, 1, 2),
        "u_target_weight": rng.choice([1e-3, 0.3]), "u_cost": rng.choice([1e-3, 0.3]) * rng.uniform(-1, 1, 2),
    }  # fmt: skip
    return mampc.TrackingProblem(model, **settings | changes), rng


def test_the_exact_optimum_is_that_of_brute_force():
    for seed in range(8):
        problem, rng = random_problem(seed)
        rules = mampc.MoveRules(price=float(rng.choice([0.05, 0.5])), max_moves=3)
        model = problem.model
        x, reference = rng.standard_normal(model.n_states), model.y_op + rng.standard_normal(model.n_outputs)
        sparse = mampc.MAMPC(problem, rules)
        state = sparse.initial_state()
        decision = sparse.step(state, x, reference)
        assert decision.status == "optimal"
        plan, past = decision.plan, state.inputs
        assert decision.objective == pytest.approx(
            objective_of(problem, rules, x, past, reference, plan), rel=1e-9
        )
        costs = best_on_every_pattern(problem, rules, x, past[-1], reference)
        prices = [
            charge(rules, pattern) if keeps_rules(rules, past, pattern) else np.inf
            for pattern in np.array(list(np.ndindex(*[2] * 6)), dtype=bool).reshape(-1, 3, 2)
        ]
        assert decision.objective == pytest.approx(min(costs + prices), rel=1e-7)


def test_the_exact_optimum_is_that_of_scip():
    problem, rng = random_problem(1, control_horizon=4)
    rules, model = mampc.MoveRules(price=0.2), problem.model
    sparse = mampc.MAMPC(problem, rules)
    x, reference = rng.standard_normal(model.n_states), model.y_op + 2 * rng.standard_normal(model.n_outputs)
    low, high = scip_bounds(problem, rules, x, model.u_op, reference, 20.0)
    objective = sparse.step(sparse.initial_state(), x, reference).objective
    assert low - 1e-6 <= objective <= high + 1e-6


@pytest.mark.parametrize("method", mampc.METHODS)
def test_every_method_counts_them_and_can_be_certified(method):
    problem, rng = random_problem(3)
    settings = {} if method == "exact" else {"certify": True}
    sparse = mampc.MAMPC(problem, mampc.MoveRules(price=0.1), method=method, **settings)
    state, x = sparse.initial_state(), rng.standard_normal(problem.model.n_states)
    for _ in range(4):
        decision = sparse.step(state, x, problem.model.y_op + 0.5)
        cost = cost_of(problem, x, state.inputs[-1], problem.model.y_op + 0.5, decision.plan)
        assert decision.objective == pytest.approx(cost + 0.1 * decision.moves.sum(), rel=1e-9)
        assert decision.status == "warm_up" or -np.inf < decision.lower_bound <= decision.objective
        state = decision.state


def test_costs_are_least_squares_and_a_linear_term_of_the_program():
    for seed in range(10):
        problem, rng = random_problem(seed, limits=mampc.Limits(u_min=-50.0, u_max=50.0))
        x, reference = rng.standard_normal(problem.model.n_states), problem.model.y_op + 1.0
        program = program_of(problem, x, problem.model.u_op, reference)
        l = problem.model.n_outputs
        d = np.linalg.solve(program.H[l:, l:], -program.f[l:])
        mpc = mampc.MPC(problem)
        decision = mpc.step(mpc.initial_state(), x, reference)
        np.testing.assert_allclose(decision.changes.ravel(), d, atol=1e-9)
        assert decision.objective == pytest.approx(program.constant + 0.5 * program.f[l:] @ d, rel=1e-9)


def test_spare_inputs_rest_at_their_targets():
    problem = mixing(u_target=[0.2, -0.5], u_target_weight=[1e-3, 0.0])
    run = mampc.simulate(problem.model, mampc.Regulator(mampc.MPC(problem)), [1.5], steps=300)
    assert run.u[-1] == pytest.approx([0.2, 1.1], abs=0.01)
    assert run.y[-1] == pytest.approx([1.5], abs=1e-3)


def test_a_cost_moves_the_load_to_the_cheaper_input():
    # A unit of output costs a fifth with the second.
    problem = mixing(u_cost=[0.01, 0.001], limits=mampc.Limits(u_min=0.0, u_max=2.0))
    found = mampc.targets(problem, reference=[3.0])
    assert found.u == pytest.approx([0.5, 2.0], abs=0.01)
    assert found.binding == ("u_max of u2",)
    run = mampc.simulate(problem.model, mampc.Regulator(mampc.MPC(problem)), [3.0], steps=400)
    np.testing.assert_allclose(run.u[-1], found.u, atol=1e-6)


@pytest.mark.parametrize("seed", seeds(12, quick=6))
def test_loops_come_to_rest_where_targets_says(seed):
    problem, rng = random_problem(seed, prediction_horizon=12)
    model = problem.model
    disturbances = {"output_disturbance": 0.3 * rng.standard_normal(model.n_outputs)}
    reference = model.y_op + rng.standard_normal(model.n_outputs)
    found = mampc.targets(problem, disturbances, reference)
    mpc = mampc.MPC(problem)
    state, x = mpc.initial_state(), np.zeros(model.n_states)
    for _ in range(1500):
        decision = mpc.step(state, x, reference, **disturbances)
        state, x = decision.state, model.A @ x + model.B @ (decision.u - model.u_op)
    np.testing.assert_allclose(decision.u, found.u, atol=1e-6)
    np.testing.assert_allclose(x, found.x, atol=1e-6)
    y = model.y_op + model.C @ x + model.D @ (decision.u - model.u_op) + disturbances["output_disturbance"]
    np.testing.assert_allclose(y, found.y, atol=1e-6)
    limits = problem.limits
    at = [f"u_min of {name}" for name in np.array(model.names.inputs)[found.u < limits.u_min + 1e-6]]
    at += [f"u_max of {name}" for name in np.array(model.names.inputs)[found.u > limits.u_max - 1e-6]]
    assert [word for word in found.binding if word.startswith("u_")] == at


def test_targets_of_an_integrating_plant_is_where_its_inflow_is_its_outflow():
    model = mampc.StateSpace([[1.0]], [[0.5, -0.25]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(
        model, prediction_horizon=10, control_horizon=2, u_target=[1.0, 0.0], u_target_weight=[1e-3, 0.0]
    )
    found = mampc.targets(problem, reference=[2.0])
    assert found.u == pytest.approx([1.0, 2.0], abs=1e-6)
    assert found.y == pytest.approx([2.0], abs=1e-6)


def test_a_price_does_not_put_targets_off_for_ever():
    problem = mixing(u_target=[0.0, 0.0], u_target_weight=[0.05, 0.0])
    sparse = mampc.MAMPC(problem, mampc.MoveRules(price=0.5))
    # In balance, far from the target.
    state, x = sparse.initial_state([1.0, -2.0]), problem.model.steady_state([1.0, -2.0])
    for _ in range(40):
        decision = sparse.step(state, x, [0.0])
        state, x = decision.state, problem.model.A @ x + problem.model.B @ decision.u
    # What two moves cost is what 46 samples at this distance cost.
    assert abs(decision.u[0]) < np.sqrt(2 * 0.5 / (46 * 0.05))


def test_batches_make_the_same_moves():
    problem = mixing(u_target=[0.2, -0.5], u_target_weight=[1e-3, 1e-3], u_cost=[0.002, -0.001])
    regulator = mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(price=0.1)))
    batch = mampc.simulate_batch(problem.model, regulator, [1.5], steps=40, seeds=range(3), noise=0.05)
    for seed in range(3):
        run = mampc.simulate(problem.model, regulator, [1.5], steps=40, seed=seed, noise=0.05)
        np.testing.assert_allclose(batch.u[seed], run.u, atol=1e-9)


@pytest.mark.parametrize(("u", "y"), [(1e-6, 1e3), (1e5, 1e-5)])
def test_units_decide_nothing(u, y):
    def decided(u, y):
        model = mampc.StateSpace.from_first_order(
            gain=[[2.0 * y / u, y / u]], time_constant=[[10, 5]], dt=1.0
        )
        problem = mampc.TrackingProblem(
            model, prediction_horizon=15, control_horizon=3, output_weight=1 / y**2, move_weight=0.1 / u**2,
            limits=mampc.Limits(u_min=0.0, u_max=2.0 * u), u_target=[0.3 * u, 0.0], u_target_weight=[0.01 / u**2, 0.0],
            u_cost=[0.0, 0.02 / u],
        )  # fmt: skip
        sparse = mampc.MAMPC(problem, mampc.MoveRules(price=0.1))
        decision = sparse.step(sparse.initial_state([0.5 * u, 0.5 * u]), 0 * model.B[:, 0], [1.5 * y])
        return decision.plan / u, decision.objective, mampc.targets(problem, reference=[1.5 * y]).u / u

    for usual, other in zip(decided(1.0, 1.0), decided(u, y), strict=True):
        np.testing.assert_allclose(other, usual, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"u_target": [1.0, 2.0, 3.0], "u_target_weight": 1.0}, "u_target: expected a scalar or 2 values"),
        ({"u_target": 1.0}, "u_target: expected a u_target_weight above zero"),
        ({"u_target_weight": -1.0}, "u_target_weight: expected no negative weight"),
        ({"u_cost": [1.0, 0.0], "limits": mampc.Limits(u_max=1.0)}, "u_cost: expected a finite u_min"),
        ({"u_cost": -1.0, "limits": mampc.Limits(u_min=1.0)}, "u_cost: expected a finite u_max"),
        ({"u_cost": "cheap"}, "u_cost: expected real numbers"),
    ],
)
def test_bad_input_is_refused_with_what_was_expected(changes, said):
    with pytest.raises(mampc.MampcError, match=said):
        mixing(**changes)


def test_targets_refuses_what_it_does_not_know():
    with pytest.raises(mampc.MampcError, match="disturbances: expected input_disturbance"):
        mampc.targets(mixing(), {"load": 1.0})
    with pytest.raises(mampc.MampcError, match=r"problem: expected a mampc\.TrackingProblem"):
        mampc.targets("tank")


def test_a_weight_alone_pulls_to_the_operating_point():
    problem = mixing(u_target_weight=1e-3)
    np.testing.assert_array_equal(problem.u_target, problem.model.u_op)


def test_a_price_promises_no_largest_offset_beside_targets():
    assert np.isinf(mampc.largest_offset(mixing(u_target_weight=1e-3), mampc.MoveRules(price=0.1))).all()


def test_the_study_template_shows_them():
    text = template().replace("steps = 145", "steps = 20").replace("prbs_order = 8", "prbs_order = 6")
    for key in ("u_target =", "u_target_weight =", "u_cost ="):
        assert f"# {key}" in text
        text = text.replace(f"# {key}", key)
    study = parse_study(text.replace("at = 50", "at = 12").replace("at = 100", "at = 16"))
    assert study.problem.u_cost == [0.01, 0.0]
    outcome = run_study(study.model_copy(update={"controllers": study.controllers[:2]}))
    assert set(outcome.runs["noisy"]) == {"MPC", study.controllers[1].name}
