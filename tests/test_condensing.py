"""The condensed program says what the model and the tracking problem say."""

import numpy as np
import pytest

import mampc
from builders import cost_of, predicted, random_model, random_weight, sample_data, tank_model, tank_problem
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver
from mampc.program.prediction import Prediction
from mampc.program.qp import QPStatus, QuadraticProgram

SEEDS = range(12)


def random_case(seed, **settings):
    """A problem with every option in turn, and one sample's data."""
    rng = np.random.default_rng(seed)
    n, m, l = rng.integers(1, 5), rng.integers(1, 4), rng.integers(1, 4)
    n_p = int(rng.integers(2, 9))
    options = {
        "prediction_horizon": n_p,
        "control_horizon": int(rng.integers(1, n_p + 1)),
        "output_weight": random_weight(rng, l),
        "move_weight": random_weight(rng, m),
        "weigh_first_move": bool(seed % 3 > 0 or m > min(n, l)),  # else the outputs must determine it
    }
    model = random_model(seed, n, m, l, feedthrough=seed % 2 == 0)
    problem = mampc.TrackingProblem(model, **(options | settings))
    return problem, {
        "x": rng.standard_normal(n),
        "u_previous": rng.standard_normal(m),
        "reference": rng.standard_normal((n_p + 1, l) if seed % 4 < 2 else l),
        "input_disturbance": rng.standard_normal(m),
        "output_disturbance": rng.standard_normal(l),
    }


def planned_inputs(problem, given, d):
    return given["u_previous"] + np.cumsum(d.reshape(problem.control_horizon, -1), axis=0)


@pytest.mark.parametrize("seed", SEEDS)
def test_predictions_equal_a_simulation_of_the_model(seed):
    problem, given = random_case(seed, output_weight=1.0)
    condensed = CondensedQP(problem)
    d = np.random.default_rng(seed).standard_normal(condensed.n_moves)
    y = predicted(
        problem.model, given["x"], planned_inputs(problem, given, d), problem.prediction_horizon + 1,
        given["input_disturbance"], given["output_disturbance"],
    )  # fmt: skip
    reference = np.broadcast_to(given["reference"], y.shape)
    free = Prediction(problem, condensed.parameter).free
    p = condensed.parameter.vector(**given | {"reference": reference})
    assert condensed.cost(sample_data(condensed, **given), d) == pytest.approx(
        np.square(reference - y).sum() + d @ condensed.R @ d, rel=1e-12
    )
    predicted_y = problem.model.y_op + (free @ p + condensed.theta @ d).reshape(y.shape)
    np.testing.assert_allclose(predicted_y, y, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("limits", [mampc.Limits(), mampc.Limits(y_min=-0.5, y_max=0.3)], ids=["none", "y"])
def test_the_cost_of_any_moves_equals_the_cost_of_their_plan(seed, limits):
    problem, given = random_case(seed, limits=limits, output_limit_weight=7.0)
    condensed = CondensedQP(problem)
    d = np.random.default_rng(seed).standard_normal(condensed.n_moves)
    expected = cost_of(problem, plan=planned_inputs(problem, given, d), **given)
    assert condensed.cost(sample_data(condensed, **given), d) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_quadratic_form_is_the_cost_less_its_constant_part(seed):
    problem, given = random_case(seed)
    condensed = CondensedQP(problem)
    sample = sample_data(condensed, **given)
    d = np.random.default_rng(seed).standard_normal(condensed.n_moves)
    quadratic = d @ condensed.H @ d / 2 + sample.f_moves @ d
    resting = condensed.cost(sample, np.zeros_like(d))
    assert condensed.cost(sample, d) == pytest.approx(quadratic + resting, rel=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_optimum_without_limits_is_at_hand_in_the_instance(seed):
    problem, given = random_case(seed)
    condensed = CondensedQP(problem)
    sample = sample_data(condensed, **given)
    d = sample.moves
    np.testing.assert_allclose(condensed.H @ d + sample.f_moves, 0.0, atol=1e-9 * np.abs(condensed.H).max())
    np.testing.assert_allclose(sample.inputs, planned_inputs(problem, given, d).ravel())
    assert sample.cost == pytest.approx(condensed.cost(sample, d), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_margins_are_the_distances_of_that_optimum_to_each_bound(seed):
    limits = mampc.Limits(u_min=-1.0, u_max=2.0, du_max=0.5, y_min=-1.0, y_max=1.5)
    problem, given = random_case(seed, limits=limits)
    condensed = CondensedQP(problem)
    sample = sample_data(condensed, **given)
    d = sample.moves
    u = planned_inputs(problem, given, d)
    y = predicted(
        problem.model, given["x"], u, problem.prediction_horizon + 1,
        given["input_disturbance"], given["output_disturbance"],
    )[1:]  # fmt: skip
    distances = [u + 1, 2 - u, 0.5 - d, d + 0.5, y + 1, 1.5 - y]
    nearest = min(distance.min() for distance in distances)
    assert sample.margins.min() == pytest.approx(nearest, abs=1e-9)


def test_a_constant_reference_equals_its_preview():
    problem, given = random_case(3)
    condensed = CondensedQP(problem)
    reference = np.arange(1.0, problem.model.n_outputs + 1)
    previewed = np.tile(reference, (problem.prediction_horizon + 1, 1))
    constant = sample_data(condensed, **given | {"reference": reference}).data
    np.testing.assert_allclose(
        sample_data(condensed, **given | {"reference": previewed}).data, constant, atol=1e-12
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "limits",
    [
        mampc.Limits(u_min=-1.5, u_max=1.2),
        mampc.Limits(u_min=-1.5, u_max=1.2, du_max=0.4, y_max=0.5),
        mampc.Limits(du_max=0.3, y_min=-0.2, y_max=0.6),
    ],
    ids=["u", "all", "du y"],
)
def test_a_restricted_program_equals_the_full_one_with_zeros_forced(seed, limits):
    problem, given = random_case(seed, limits=limits, output_limit_weight=20.0)
    condensed = CondensedQP(problem)
    given["u_previous"] = np.clip(given["u_previous"], -1.0, 1.0)
    sample, v = sample_data(condensed, **given), condensed.n_violations
    pattern = np.random.default_rng(seed).random(condensed.n_moves) < 0.5
    pattern[0] = True
    restriction = condensed.restricted(pattern)
    optimum = restriction.optimum(sample.target)
    part = restriction.solve(optimum, sample.lower[restriction.bounds], sample.upper[restriction.bounds])
    forced = QuadraticProgram(  # the full program, each idle move fixed by a row of its own
        condensed.program.H,
        np.vstack([condensed.program.A, np.eye(v + condensed.n_moves)[v:][~pattern]]),
        condensed.program.n_simple,
    )
    idle = np.zeros((~pattern).sum())
    full = DaqpSolver(forced).solve(sample.f, np.append(sample.lower, idle), np.append(sample.upper, idle))
    assert part.status is full.status is QPStatus.OPTIMAL
    np.testing.assert_allclose(part.moves, full.z[v:][pattern], atol=1e-8)
    moves = np.zeros(condensed.n_moves)
    moves[pattern] = part.moves
    objective = sample.cost + restriction.excess(sample.target) + part.excess
    assert objective == pytest.approx(condensed.cost(sample, moves), rel=1e-9)


def test_a_restricted_program_leaves_out_the_rows_of_inputs_at_rest():
    condensed = CondensedQP(tank_problem())
    pattern = np.zeros(10, dtype=bool)
    pattern[[0, 4, 5]] = True  # u1 at samples 0 and 2, u2 at sample 2
    restriction = condensed.restricted(pattern)
    assert restriction.rows.shape == (3, 3)  # u1 now, and each input where it moves


def test_weights_that_leave_moves_undetermined_are_refused():
    model = mampc.StateSpace([[0.5]], [[1.0, 1.0]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=4, control_horizon=2, move_weight=0.0)
    with pytest.raises(mampc.MampcError, match=r"expected a positive definite.*weight"):
        CondensedQP(problem)


@pytest.mark.filterwarnings("error")
def test_predictions_that_overflow_are_refused():
    model = mampc.StateSpace([[3.0]], [[1.0]], [[1.0]], None, 1.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=1000, control_horizon=2)
    with pytest.raises(mampc.MampcError, match=r"expected.*received.*horizon"):
        CondensedQP(problem)


def closed_loop_by_stepping(problem):
    """Matrix of (x, u_prev) -> their successors under MPC without limits, one unit vector at a time."""
    model, mpc = problem.model, mampc.MPC(problem)
    n, m = model.n_states, model.n_inputs
    columns = []
    for unit in np.eye(n + m):
        state = mpc.initial_state(model.u_op + unit[n:])
        u = mpc.step(state, unit[:n], model.y_op).u - model.u_op
        columns.append(np.concatenate([model.A @ unit[:n] + model.B @ u, u]))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize(("dt", "radius"), [(5.0, 1.115), (10.0, 0.745), (15.0, 0.684)])
def test_the_closed_loop_of_the_tank_has_the_known_spectral_radius(dt, radius):
    condensed = CondensedQP(tank_problem(tank_model(dt)))
    assert np.max(np.abs(condensed.closed_loop_poles())) == pytest.approx(radius, abs=2e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_closed_loop_poles_are_those_of_model_and_controller_in_loop(seed):
    problem, _ = random_case(seed)
    simulated = np.linalg.eigvals(closed_loop_by_stepping(problem))
    poles = CondensedQP(problem).closed_loop_poles()
    np.testing.assert_allclose(np.poly(poles), np.poly(simulated), atol=1e-9)


@pytest.mark.parametrize(("dt", "grows"), [(5.0, True), (10.0, False)])
def test_simulated_mpc_without_limits_grows_or_decays_as_its_poles_say(dt, grows):
    problem = tank_problem(tank_model(dt), limits=mampc.Limits())
    model, mpc = problem.model, mampc.MPC(problem)
    x, state, sizes = np.array([1.0, -1.0, 0.5, 0.0]), mpc.initial_state(), []
    for _ in range(120):
        decision = mpc.step(state, x, model.y_op)
        state, x = decision.state, model.A @ x + model.B @ (decision.u - model.u_op)
        sizes.append(np.linalg.norm(x))
    rate = (sizes[100] / sizes[40]) ** (1 / 60)
    assert rate == pytest.approx(np.max(np.abs(mpc.condensed.closed_loop_poles())), rel=0.02)
    assert bool(rate > 1) is grows
