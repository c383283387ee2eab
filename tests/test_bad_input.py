"""Constructors check everything once, and say what they expected and what they received."""

import subprocess
import sys

import numpy as np
import pytest

import mampc
from builders import tank_model, tank_problem

NAN, INF = np.nan, np.inf
REFUSED = r"(?s)expected.*received"


def refuses(build, *arguments, **options):
    with pytest.raises(mampc.MampcError, match=REFUSED):
        build(*arguments, **options)


def by_name(options):
    return ", ".join(f"{name}={value!r}" for name, value in options.items())


@pytest.mark.parametrize(
    "options",
    [
        {"u_min": [0.0, 0.0, 0.0]},
        {"u_max": [[1.0, 1.0]]},
        {"u_min": NAN},
        {"u_max": [1.0, NAN]},
        {"u_min": INF},
        {"u_max": -INF},
        {"u_min": "low"},
        {"u_min": [1.0, [2.0]]},
        {"u_min": 1j},
        {"u_min": 2.0, "u_max": 1.0},
        {"u_min": [0.0, 2.0], "u_max": [1.0, 1.0]},
        {"y_min": 2.0, "y_max": 1.0},
        {"y_max": [1.0]},
        {"y_min": NAN},
        {"du_max": -1.0},
        {"du_max": NAN},
        {"du_max": [1.0, 1.0, 1.0]},
    ],
    ids=by_name,
)
def test_limits_that_no_plan_could_keep_or_read_are_refused(options):
    refuses(tank_problem, limits=mampc.Limits(**options))


@pytest.mark.parametrize(
    "options",
    [
        {"prediction_horizon": 0},
        {"prediction_horizon": -3},
        {"prediction_horizon": 10.0},
        {"prediction_horizon": "10"},
        {"prediction_horizon": True, "control_horizon": 1},
        {"prediction_horizon": 10**6},
        {"prediction_horizon": None},
        {"control_horizon": 0},
        {"control_horizon": 11},
        {"control_horizon": 2.5},
        {"output_weight": -1.0},
        {"output_weight": NAN},
        {"output_weight": [1.0, 1.0, 1.0]},
        {"output_weight": [[1.0, 0.5], [0.0, 1.0]]},
        {"output_weight": [[1.0, 2.0], [2.0, 1.0]]},
        {"output_weight": np.eye(3)},
        {"output_weight": "one"},
        {"move_weight": -0.1},
        {"move_weight": [INF, 1.0]},
        {"move_weight": [0.1]},
        {"move_weight": None},
        {"limits": (0.0, 100.0)},
        {"limits": None},
        {"output_limit_weight": 0.0},
        {"output_limit_weight": -1.0},
        {"output_limit_weight": INF},
        {"output_limit_weight": "high"},
    ],
    ids=by_name,
)
def test_a_tracking_problem_that_makes_no_sense_is_refused(options):
    refuses(tank_problem, **options)


def test_a_tracking_problem_too_large_for_the_memory_is_refused():
    many_outputs = mampc.StateSpace([[0.5]], [[1.0]], np.ones((60, 1)), None, 1.0)
    refuses(mampc.TrackingProblem, many_outputs, prediction_horizon=100, control_horizon=5)
    many_inputs = mampc.StateSpace([[0.5]], np.ones((1, 60)), [[1.0]], None, 1.0)
    refuses(mampc.TrackingProblem, many_inputs, prediction_horizon=100, control_horizon=50)


@pytest.mark.parametrize("model", [None, "tank", np.eye(2), mampc.linearise(mampc.plants.QuadrupleTank())])
def test_a_tracking_problem_wants_a_discrete_model(model):
    refuses(mampc.TrackingProblem, model, prediction_horizon=10, control_horizon=5)


@pytest.mark.parametrize(
    "options",
    [
        {"max_moves": -1},
        {"max_moves": 2.5},
        {"max_moves": "3"},
        {"max_moves": True},
        {"max_moves": NAN},
        {"sparsity_horizon": 0},
        {"sparsity_horizon": -2},
        {"sparsity_horizon": 1.5},
        {"sparsity_horizon": None},
        {"sparsity_horizon": 10**9},
        {"price": True},
        {"price": [True, False]},
        {"min_size": True},
        {"blocks": ((1, 2), (1, 1))},
    ],
    ids=by_name,
)
def test_move_rules_out_of_range_are_refused(options):
    refuses(mampc.MoveRules, **options)


@pytest.mark.parametrize(
    "options",
    [
        {"disturbance": "state"},
        {"disturbance": None},
        {"measurement_noise": 0.0},
        {"measurement_noise": -1.0},
        {"measurement_noise": NAN},
        {"measurement_noise": [1.0, 1.0, 1.0]},
        {"drift": 0.0},
        {"drift": [0.1, INF]},
        {"drift": "slow"},
        {"input_noise": 0.0},
        {"input_noise": [1.0]},
        {"disturbance": "input", "drift": [0.1, 0.1, 0.1]},
    ],
    ids=by_name,
)
def test_a_kalman_filter_out_of_range_is_refused(options):
    refuses(mampc.KalmanFilter.offset_free, tank_model(), **options)


def test_a_kalman_filter_wants_a_discrete_model_with_enough_inputs():
    refuses(mampc.KalmanFilter.offset_free, mampc.linearise(mampc.plants.QuadrupleTank()))
    refuses(mampc.KalmanFilter.offset_free, "tank")
    narrow = mampc.StateSpace([[0.5]], [[1.0]], [[1.0], [2.0]], None, 1.0)
    refuses(mampc.KalmanFilter.offset_free, narrow, disturbance="input")


def test_a_regulator_wants_a_controller_and_an_estimator_of_its_dimensions():
    mpc = mampc.MPC(tank_problem())
    smaller = mampc.StateSpace([[0.5]], [[1.0]], [[1.0]], None, 10.0)
    refuses(mampc.Regulator, mpc, mampc.KalmanFilter.offset_free(smaller))
    refuses(mampc.Regulator, mpc, "kalman")
    refuses(mampc.Regulator, mpc.problem)
    refuses(mampc.Regulator, "mpc")


def test_a_controller_wants_a_problem_rules_and_a_method_it_knows():
    problem, rules = tank_problem(), mampc.MoveRules(max_moves=3)
    for wrong in (None, problem.model, "tank"):
        refuses(mampc.MPC, wrong)
        refuses(mampc.MAMPC, wrong, rules)
    refuses(mampc.MAMPC, problem, None)
    refuses(mampc.MAMPC, problem, 3)
    for method in ("newton", "", None, 7, mampc.Alternating):
        refuses(mampc.MAMPC, problem, rules, method=method)


def test_a_state_of_something_else_is_refused():
    problem = tank_problem()
    mpc, sparse = mampc.MPC(problem), mampc.MAMPC(problem, mampc.MoveRules(max_moves=3, sparsity_horizon=4))
    x, reference = np.zeros(problem.model.n_states), problem.model.y_op
    for state in (None, [1.0, 2.0], mampc.Regulator(mpc).initial_state()):
        refuses(mpc.step, state, x, reference)
        refuses(sparse.step, state, x, reference)
    loop = mampc.Regulator(mpc)
    for state in (None, mpc.initial_state()):
        refuses(loop.step, state, reference, reference)
    refuses(mpc.step, sparse.initial_state(), x, reference)
    refuses(sparse.step, mpc.initial_state(), x, reference)


@pytest.mark.parametrize(
    "u_previous",
    [
        [1.0],
        [1.0, NAN],
        [1.0, INF],
        np.ones((2, 3)),
        np.ones((1, 1, 2)),
        np.empty((0, 2)),
        "rest",
        [1.0, [2.0]],
    ],
    ids=str,
)
def test_inputs_applied_so_far_that_cannot_be_are_refused(u_previous):
    mpc = mampc.MPC(tank_problem())
    refuses(mpc.initial_state, u_previous)
    refuses(mampc.Regulator(mpc).initial_state, u_previous)


@pytest.mark.parametrize("y", [[1.0], [1.0, NAN], "level", np.ones((2, 2))], ids=str)
def test_a_measured_rest_that_cannot_be_is_refused(y):
    refuses(mampc.Regulator(mampc.MPC(tank_problem())).initial_state, [50.0, 50.0], y)


@pytest.mark.parametrize("number", [10**400, 16**5000, -(16**5000)], ids=["1e400", "16^5000", "-16^5000"])
@pytest.mark.parametrize("option", ["move_weight", "tail_horizon", "prediction_horizon"])
def test_numbers_of_very_many_digits_are_refused(option, number):
    refuses(tank_problem, **{option: number})


def test_importing_mampc_leaves_out_heavy_modules_and_what_no_loop_needs():
    heavy = ["scipy", "matplotlib", "pandas", "plotly", "typer", "mampc.identification", "mampc.compare"]
    code = f"import sys, mampc; print([name for name in {heavy} if name in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_every_public_name_is_there_and_no_other():
    for module in (mampc, mampc.plants):
        assert [name for name in module.__all__ if not hasattr(module, name)] == []
        assert set(module.__all__) <= set(dir(module))
        assert not hasattr(module, "MCP")
