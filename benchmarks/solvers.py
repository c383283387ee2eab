"""Rows of the benchmark that measure a step against other solvers on the same samples, at size A.

Each solver is set up once and given the linear term and the bounds of every sample, as one would do in a loop; what it
takes to get there, and from its answer to inputs, is not counted, while a step of ours is whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import casadi
import daqp
import numpy as np
import osqp
import piqp
from scipy import sparse as matrices

import mampc
from measuring import Asked, Row, closed_loop, interleaved, steps_of, tank_problem

BUDGET = mampc.MoveRules(max_moves=4)
BINARY = 16  # daqp's flag
CURVED = 1e-3  # of the binaries, relative to the mean of the moves': daqp wants a strictly convex program


class Instance(NamedTuple):
    """One sample's program: lower <= (z[:n_simple], A z) <= upper."""

    f: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


def instances(controller, asked: Sequence[Asked]) -> list[Instance]:
    """The programs of plain MPC, violations before the moves."""
    condensed, found = controller.condensed, []
    for a in asked:
        u_previous = a.state.inputs[-1]
        vector = condensed.parameter.vector(a.x, u_previous, a.reference, a.output_disturbance)
        sample = condensed.sample(vector, u_previous)
        found.append(Instance(sample.f.copy(), sample.lower.copy(), sample.upper.copy()))
    return found


def rows_of(program) -> np.ndarray:
    """All bounded quantities per variable."""
    return np.vstack([np.eye(program.n_simple, program.n_variables), program.A])


class Daqp:
    """daqp itself, which starts from the active bounds of the last sample."""

    def __init__(self, program, first: Instance) -> None:
        self.model = daqp.Model()
        self.model.settings = {"primal_tol": 1e-9}
        wide = np.full(program.n_bounds, 1e30)
        nothing = np.zeros(program.n_variables)
        self.model.setup(program.H, nothing, program.A, wide, -wide, np.zeros(len(wide), np.intc))

    def solve(self, instance: Instance) -> np.ndarray:
        self.model.update(f=instance.f, blower=instance.lower, bupper=instance.upper)
        return self.model.solve()[0]


class Piqp:
    """PIQP with dense matrices, at its own tolerances; it drops rows that are unbounded when it is set up."""

    def __init__(self, program, first: Instance) -> None:
        H, rows = np.asfortranarray(program.H), np.asfortranarray(rows_of(program))
        self.solver = piqp.DenseSolver()
        self.solver.setup(H, first.f, G=rows, h_l=first.lower, h_u=first.upper)

    def solve(self, instance: Instance) -> np.ndarray:
        self.solver.update(c=instance.f, h_l=instance.lower, h_u=instance.upper)
        self.solver.solve()
        return self.solver.result.x


class Osqp:
    """OSQP at tolerances of 1e-6, warm."""

    def __init__(self, program, first: Instance) -> None:
        rows, wide = matrices.csc_matrix(rows_of(program)), np.full(program.n_bounds, 1e30)
        self.solver = osqp.OSQP()
        self.solver.setup(
            matrices.csc_matrix(np.triu(program.H)), np.zeros(program.n_variables), rows, -wide, wide,
            verbose=False, eps_abs=1e-6, eps_rel=1e-6, max_iter=100_000,
        )  # fmt: skip

    def solve(self, instance: Instance) -> np.ndarray:
        self.solver.update(q=instance.f, l=instance.lower, u=instance.upper)
        return self.solver.solve().x


class CasadiDaqp:
    """daqp as CasADi calls it."""

    def __init__(self, program, first: Instance) -> None:
        self.H, self.A = casadi.DM(program.H), casadi.DM(program.A)
        self.n_simple, self.unbounded = (
            program.n_simple,
            np.full(program.n_variables - program.n_simple, np.inf),
        )
        shapes = {"h": self.H.sparsity(), "a": self.A.sparsity()}
        self.solver = casadi.conic("qp", "daqp", shapes, {"print_time": False, "daqp": {"primal_tol": 1e-9}})

    def solve(self, instance: Instance) -> np.ndarray:
        n, lower, upper = self.n_simple, instance.lower, instance.upper
        answer = self.solver(
            h=self.H, g=instance.f, a=self.A, lba=lower[n:], uba=upper[n:],
            lbx=np.concatenate([lower[:n], -self.unbounded]), ubx=np.concatenate([upper[:n], self.unbounded]),
        )  # fmt: skip
        return np.asarray(answer["x"]).ravel()


class BranchAndBound:
    """daqp's own branch and bound on the big-M form of the sparse problem, z = (moves, binaries)."""

    def __init__(self, condensed, most: int) -> None:
        program, limits, n = condensed.program, condensed.problem.limits, condensed.n_moves
        largest = np.tile(limits.u_max - limits.u_min, condensed.problem.control_horizon)
        self.curvature = CURVED * np.diag(program.H).mean()
        H = np.zeros((2 * n, 2 * n))
        H[:n, :n], H[n:, n:] = program.H, self.curvature * np.eye(n)
        none, eye = np.zeros((len(program.A), n)), np.eye(n)
        first, simple = np.eye(program.n_simple, n), np.zeros((program.n_simple, n))
        A = np.vstack(
            [
                np.hstack([first, simple]), np.hstack([program.A, none]), np.hstack([eye, -np.diag(largest)]),
                np.hstack([-eye, -np.diag(largest)]), np.hstack([np.zeros(n), np.ones(n)]),
            ]
        )  # fmt: skip
        self.n, self.most, self.wide, self.H = n, most, largest, program.H
        n_bounds = 2 * n + len(A)
        self.sense = np.zeros(n_bounds, np.intc)
        self.sense[n : 2 * n] = BINARY
        self.model = daqp.Model()
        self.model.settings = {"primal_tol": 1e-9}
        high = np.concatenate([largest, np.ones(n), np.full(len(A), 1e30)])
        low = np.concatenate([-largest, np.zeros(n), np.full(len(A), -1e30)])
        self.model.setup(H, np.zeros(2 * n), A, high, low, self.sense)

    def data(self, instance: Instance) -> dict[str, np.ndarray]:
        n, ones = self.n, np.ones(self.n)
        return {
            "f": np.concatenate([instance.f, -0.5 * self.curvature * ones]),
            "blower": np.concatenate([-self.wide, 0 * ones, instance.lower, np.full(2 * n + 1, -1e30)]),
            "bupper": np.concatenate([self.wide, ones, instance.upper, np.zeros(2 * n), [self.most]]),
            "sense": self.sense,
        }

    def solve(self, data: dict[str, np.ndarray]) -> np.ndarray:
        self.model.update(**data)
        return self.model.solve()[0][: self.n]

    def cost(self, data: dict[str, np.ndarray], moves: np.ndarray) -> float:
        return float(moves @ (0.5 * self.H @ moves + data["f"][: self.n]))


def limited_problem() -> mampc.TrackingProblem:
    """Output limits are active at every step: below every reference of the run."""
    plant = mampc.plants.QuadrupleTank()
    y_max = plant.output(plant.steady_state()) - 2.0
    return tank_problem(limits=mampc.Limits(u_min=0.0, u_max=100.0, y_max=y_max))


def step_against_bare_daqp() -> Row:
    """A whole MPC step with active output limits against the bare solver on its programs."""
    mpc = mampc.MPC(limited_problem())
    asked = closed_loop(mpc)
    programs = instances(mpc, asked)
    bare, ours = Daqp(mpc.condensed.program, programs[0]), steps_of(mpc, asked)
    theirs = [partial(bare.solve, instance) for instance in programs]
    times = interleaved([(ours, theirs)] * 60)
    apart = difference(mpc, ours, theirs)
    return Row(
        "A, output limits active: MPC step / bare warm daqp, update(f and bounds) + solve",
        "at most 6", f"{times.ratio:.2f}", f"{times}; moves differ by {apart:.0e}", times.ratio <= 6,
    )  # fmt: skip


def difference(controller, ours: Sequence[Callable], theirs: Sequence[Callable]) -> float:
    v = controller.condensed.n_violations
    return max(np.abs(a().changes.ravel() - b()[v:]).max() for a, b in zip(ours, theirs, strict=True))


def solver_against_step(name: str, solver: type) -> Row:
    """Another solver on the programs with active output limits against our whole step."""
    mpc = mampc.MPC(limited_problem())
    asked = closed_loop(mpc)
    programs = instances(mpc, asked)
    rival, ours = solver(mpc.condensed.program, programs[0]), steps_of(mpc, asked)
    theirs = [partial(rival.solve, instance) for instance in programs]
    times = interleaved([(theirs, ours)] * 20)
    apart = difference(mpc, ours, theirs)
    return Row(
        f"A, output limits active: {name}, its solve alone / MPC step", "at least 1", f"{times.ratio:.2f}",
        f"{times}; moves differ by {apart:.0e}", times.ratio >= 1,
    )  # fmt: skip


def branch_and_bound_against_exact() -> Row:
    """daqp's branch and bound against the exact step, on samples of the closed loop."""
    controller = mampc.MAMPC(tank_problem(), BUDGET)
    asked = closed_loop(controller)[::3]
    rival = BranchAndBound(controller.condensed, BUDGET.max_moves)
    data = [rival.data(instance) for instance in instances(controller, asked)]
    ours, theirs = steps_of(controller, asked), [partial(rival.solve, one) for one in data]
    times = interleaved([([solve], [step] * 10) for solve, step in zip(theirs, ours, strict=True)])
    costs = [
        (rival.cost(one, step().changes.ravel()), rival.cost(one, solve()))
        for one, step, solve in zip(data, ours, theirs, strict=True)
    ]
    excess = [(its - best) / max(1.0, abs(best)) for best, its in costs]
    theirs_more, ours_more = max(0.0, max(excess)), max(0.0, -min(excess))
    return Row(
        "A, 4 of 10 moves: daqp's branch and bound (big-M, its solve alone) / exact step", "at least 10",
        f"{times.ratio:.0f}", f"{times}; its plans cost up to {theirs_more:.0e} more, ours up to {ours_more:.0e}",
        times.ratio >= 10,
    )  # fmt: skip


ROWS: list[Callable[[], Row]] = [
    step_against_bare_daqp,
    partial(solver_against_step, "PIQP (dense)", Piqp),
    partial(solver_against_step, "OSQP at 1e-6", Osqp),
    partial(solver_against_step, "daqp through CasADi", CasadiDaqp),
    branch_and_bound_against_exact,
]
