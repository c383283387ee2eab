"""The daqp back end: right answers, and one test for each of daqp's sharp edges."""

import copy
import pickle
import re
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import clarabel
import numpy as np
import pytest
from scipy import sparse

from mampc import MampcError
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import QPStatus, QuadraticProgram


def random_program(seed, n=6, rows=8, n_simple=4):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, n))
    return QuadraticProgram(root @ root.T + 0.1 * np.eye(n), rng.standard_normal((rows, n)), n_simple)


def random_data(program, rng):
    """A linear term and bounds around zero that are active at the optimum."""
    f = 5 * rng.standard_normal(program.n_variables)
    return f, -rng.uniform(0.1, 1, program.n_bounds), rng.uniform(0.1, 1, program.n_bounds)


def by_clarabel(program, f, lower, upper):
    rows = np.vstack([np.eye(program.n_simple, program.n_variables), program.A])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(program.H)), f, sparse.csc_matrix(np.vstack([rows, -rows])),
        np.concatenate([upper, -lower]), [clarabel.NonnegativeConeT(2 * len(rows))], settings,
    )  # fmt: skip
    return np.array(solver.solve().x)


@pytest.fixture
def program():
    return random_program(0)


@pytest.fixture
def data(program):
    return random_data(program, np.random.default_rng(1))


def solves_right(solver, data):
    """Whether a solver, whatever it went through, answers as a fresh one does."""
    solution, fresh = solver.solve(*data), DaqpSolver(solver.program).solve(*data)
    return solution.status is QPStatus.OPTIMAL and np.allclose(solution.z, fresh.z, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(10))
def test_a_warm_solver_agrees_with_an_interior_point_solver(seed):
    program, rng = random_program(seed), np.random.default_rng(seed + 100)
    solver = DaqpSolver(program)
    for _ in range(5):
        data = random_data(program, rng)
        np.testing.assert_allclose(solver.solve(*data).z, by_clarabel(program, *data), rtol=0, atol=1e-7)


def test_a_bound_broken_by_less_than_daqps_default_tolerance_is_still_kept():
    t = 1e2  # H is so skewed that a violation of 5e-7 moves the second variable by 5e-5
    program = QuadraticProgram(np.linalg.inv([[1.0, t], [t, t**2 + 1]]), np.empty((0, 2)), 2)
    f = -program.H @ [5e-7, 0.0]
    z = DaqpSolver(program).solve(f, np.full(2, -1e3), np.array([0.0, 1e3])).z
    np.testing.assert_allclose(z, [0.0, -5e-7 * t], rtol=0, atol=1e-8)


def test_crossed_bounds_are_bad_data_and_the_next_solve_is_right(program, data):
    f, lower, upper = data
    solver = DaqpSolver(program)
    for i in range(program.n_bounds):
        crossed = lower.copy()
        crossed[i] = upper[i] + 1
        assert solver.solve(f, crossed, upper).status is QPStatus.BAD_DATA
        assert solves_right(solver, data)


@pytest.mark.parametrize("solve", ["solve", "solve_anew"])
def test_equations_that_are_nearly_the_same_are_not_called_crossed_bounds(solve):
    """A controller would take the first for a failure, and the second for a plan that cannot be."""
    A = np.array([[1.0, 0.0], [1.0, 1e-7], [1.0, 1.0]])
    b = A @ np.ones(2)
    status = getattr(DaqpSolver(QuadraticProgram(np.eye(2), A, 0)), solve)(np.zeros(2), b, b).status
    assert status in (QPStatus.OPTIMAL, QPStatus.FAILED)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_linear_term_that_is_not_finite_is_bad_data_and_the_next_solve_is_right(program, data, bad):
    f, lower, upper = data
    solver = DaqpSolver(program)
    assert solver.solve(np.where(np.arange(len(f)) == 2, bad, f), lower, upper).status is QPStatus.BAD_DATA
    assert solves_right(solver, data)


@pytest.mark.parametrize("which", ["lower", "upper"])
def test_a_bound_that_is_not_a_number_is_bad_data_and_the_next_solve_is_right(program, data, which):
    f, lower, upper = (array.copy() for array in data)
    (lower if which == "lower" else upper)[5] = np.nan
    solver = DaqpSolver(program)
    solution = solver.solve(f, lower, upper)
    assert solution.status is QPStatus.BAD_DATA
    assert solution.z is None
    assert solves_right(solver, data)


def test_infinite_bounds_bound_nothing(program, data):
    free = np.full(program.n_bounds, np.inf)
    z = DaqpSolver(program).solve(data[0], -free, free).z
    np.testing.assert_allclose(program.H @ z, -data[0], atol=1e-9)


@pytest.mark.parametrize("position", [0, 1, 2])
@pytest.mark.parametrize("change", [lambda a: a[:-1], lambda a: a[None], lambda a: np.append(a, 0.0)])
def test_wrong_shapes_raise_and_the_next_solve_is_right(program, data, position, change):
    solver = DaqpSolver(program)
    wrong = [change(array) if i == position else array for i, array in enumerate(data)]
    with pytest.raises(MampcError, match=r"expected.*received"):
        solver.solve(*wrong)
    assert solves_right(solver, data)


def test_arrays_with_strides_are_read_as_what_they_show(program, data):
    strided = [np.repeat(array, 3)[::3] for array in data]
    assert not any(array.flags.c_contiguous for array in strided)
    expected = DaqpSolver(program).solve(*data).z
    np.testing.assert_array_equal(DaqpSolver(program).solve(*strided).z, expected)
    wide = np.repeat(np.repeat(program.H, 2, axis=0), 2, axis=1)[::2, ::2]
    views = QuadraticProgram(wide, np.asfortranarray(program.A), program.n_simple)
    np.testing.assert_array_equal(DaqpSolver(views).solve(*data).z, expected)


def test_arrays_changed_by_the_caller_do_not_leak_into_any_answer(program, data):
    mine = [array.copy() for array in data]
    solver = DaqpSolver(program)
    solution = solver.solve(*mine)
    z, pull = solution.z.copy(), solution.multipliers.copy()
    for array, spoiled in zip(mine, (np.nan, 7.0, -7.0), strict=True):
        array[:] = spoiled
    assert solves_right(solver, data)
    solver.solve(-data[0], *data[1:])
    np.testing.assert_array_equal(solution.z, z)
    np.testing.assert_array_equal(solution.multipliers, pull)


def test_multipliers_are_positive_at_upper_and_negative_at_lower_bounds():
    program = QuadraticProgram(np.eye(2), np.array([[1.0, -1.0]]), 2)
    wide = np.array([1.0, 1.0, 9.0])
    solution = DaqpSolver(program).solve(np.array([-3.0, 5.0]), -wide, wide)
    np.testing.assert_allclose(solution.z, [1.0, -1.0])
    np.testing.assert_allclose(solution.multipliers, [2.0, -4.0, 0.0])
    solution = DaqpSolver(program).solve(np.array([-3.0, 5.0]), -9 * wide, np.array([9.0, 9.0, 2.0]))
    np.testing.assert_allclose(solution.z, [0.0, -2.0])
    np.testing.assert_allclose(solution.multipliers, [0.0, 0.0, 3.0])


def test_threads_that_share_a_solver_all_get_right_answers(program):
    solver, rng = DaqpSolver(program), np.random.default_rng(3)
    problems = [random_data(program, rng) for _ in range(400)]
    expected = [solver.solve(*data).z for data in problems]
    with ThreadPoolExecutor(2) as pool:
        answers = list(pool.map(lambda data: solver.solve(*data).z, problems))
    np.testing.assert_allclose(answers, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
def test_a_copy_solves_like_its_original_and_apart_from_it(program, data, duplicate):
    solver = DaqpSolver(program, time_limit=5.0, iteration_limit=77)
    solver.solve(*data)
    twin = duplicate(solver)
    assert twin.solve(np.full(program.n_variables, np.nan), *data[1:]).status is QPStatus.BAD_DATA
    assert solves_right(twin, data)
    assert solves_right(solver, data)
    assert twin.__getstate__()["settings"] == solver.__getstate__()["settings"]


@pytest.mark.parametrize("H", [np.diag([1.0, -1.0]), np.diag([1.0, 0.0]), np.ones((2, 2)), np.zeros((2, 2))])
def test_a_hessian_that_is_not_positive_definite_is_refused(H):
    with pytest.raises(MampcError, match=r"expected a positive definite.*received"):
        QuadraticProgram(H, np.empty((0, 2)), 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_hessian_that_is_not_finite_is_refused(bad):
    with pytest.raises(MampcError, match=r"expected.*received"):
        QuadraticProgram(np.diag([1.0, bad]), np.empty((0, 2)), 0)


def test_an_infeasible_solve_says_so_and_never_poisons_the_next():
    row = np.array([[1.0, 2.0, -1.0]])
    solver = DaqpSolver(QuadraticProgram(np.eye(3), np.vstack([row, row]), 1))
    data = np.array([1.0, -2.0, 3.0]), np.array([-0.5, -2.0, -3.0]), np.array([0.5, 3.0, 2.0])
    for _ in range(3):
        solution = solver.solve(data[0], np.array([-1.0, 0.4, -0.5]), np.array([1.0, 0.5, -0.4]))
        assert solution.status is QPStatus.INFEASIBLE
        assert solution.z is None
        assert solution.multipliers is None
        assert solves_right(solver, data)


def test_the_iteration_limit_is_reported_and_never_poisons_the_next(program, data):
    needed = DaqpSolver(program).solve(*data).iterations
    assert needed > 2
    solver = DaqpSolver(program, iteration_limit=2)
    solution = solver.solve(*data)
    assert solution.status is QPStatus.ITERATION_LIMIT
    assert solution.z is None
    wide = np.full(program.n_bounds, 1e6)
    np.testing.assert_allclose(program.H @ solver.solve(data[0], -wide, wide).z, -data[0], atol=1e-9)


def test_residuals_without_a_solution_are_infinite(program, data):
    f, lower, upper = data
    nothing = DaqpSolver(program).solve(f, upper, lower)
    assert program.primal_residual(lower, upper, nothing) == np.inf
    assert program.dual_residual(f, nothing) == np.inf
    assert program.duality_gap(lower, upper, nothing) == np.inf


def test_numpy_which_daqps_wheel_does_not_ask_for_is_a_dependency_of_ours():
    pyproject = Path(__file__).parents[1] / "pyproject.toml"
    wanted = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]["dependencies"]
    assert {"numpy", "daqp"} <= {re.split(r"[^\w.-]", line)[0] for line in wanted}
