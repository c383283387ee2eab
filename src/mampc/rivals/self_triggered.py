"""Self-triggered minimum attention with linear constraints (Donkers, Tabuada and Heemels 2011, 2014).

When the inputs move, they are chosen to be held as long as possible, and among those nearest to the LQ law's: h is the
largest of 1..h_max for which some constant input keeps a control Lyapunov function below its decay at every sample of
the hold,

    |P z_{k+i}|_inf <= beta rho^i |P z_k|_inf,    i = 1..h,    z = (x - x_s, u - u_s)

and without beta at i = h, since else an input under which nothing decays might be held again and again; one small
program per h. P comes from the closed loop of the LQ law: its errors and moves to come are an infinity norm that
decays along it. Where not even h = 1 can be kept, one step of MPC is made.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Status
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.method import Plan
from mampc.program.daqp import DaqpSolver
from mampc.program.problem import TrackingProblem
from mampc.program.qp import UNBOUNDED, QuadraticProgram
from mampc.program.sample import Sample
from mampc.program.steady import SteadyTarget
from mampc.program.tail import square_root
from mampc.rivals.rules import Rule

NEAR = 1e-6  # of the state's size in P at a unit input: nearer to the target there is nothing left to decay
UNREACHED = 1e-8  # of what an input of its size does to the mode that it moves the most: nothing
NEAREST = 1e-6  # weight of inputs beside that of moves
FASTEST, SLOWEST = 0.9, 0.99  # decay by itself
MOST_AHEAD = 300  # samples of the LQ law
LASTS = 1e-3  # share that a mode keeps from sample to sample; faster ones are dead times or as good as gone


class SelfTriggered(Rule):
    """Inputs are held for as long as a Lyapunov function can be made to decay with them constant.

    Args:
        controller: what moves where the decay cannot be kept; its problem's weights give the LQ law.
        longest: h_max >= 1, samples.
        overshoot: beta >= 1, by how much the bound may start above the function.
        decay: rho below 1 per sample, slower than the LQ law decays; default half way from that to 1, 0.9 to 0.99.

    Raises:
        MampcError: a model that cannot be stabilised.
    """

    def __init__(
        self, controller: Controller, *, longest: int = 20, overshoot: float = 1.5, decay: float | None = None
    ) -> None:
        super().__init__(controller)
        self._longest = as_whole("longest", longest, 1, 1000)
        self._beta = as_number("overshoot", overshoot, 1.0)
        if decay is not None and not as_number("decay", decay, 0.0, exclusive=True) < 1:
            raise MampcError(f"decay: expected below 1, received {decay}")
        self._law = law = _law_of(self.problem, decay)
        self._target = SteadyTarget(self.problem, self.condensed.parameter)
        powers, moved = [law.A], [law.B]
        for _ in range(1, self._longest):
            powers.append(law.A @ powers[-1])
            moved.append(law.A @ moved[-1])
        self._solvers: dict[int, DaqpSolver] = {}  # by the samples of a hold
        self._free, self._forced = law.P @ np.array(powers), law.P @ np.array(moved)

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """The hold that was decided, as long as it lasts and the target stays; else the longest one anew."""
        p, memory = sample.parameter, state.memory
        steady = self._target.at(p)
        u, m = sample.u_previous, len(sample.u_previous)
        reference = p[self.condensed.parameter.reference.start :]
        if memory is not None and memory[0] > 0 and np.array_equal(memory[1:], reference):
            plan = self._only(np.zeros(m), Plan(None, Status.FEASIBLE, 0))
            return plan._replace(memory=np.concatenate([[memory[0] - 1], memory[1:]]))
        error = np.concatenate([p[self.condensed.parameter.x] - steady.x, (u - steady.u) / self._law.unit])
        held, move = self._longest_hold(error, *self.first_moves(sample))
        if move is None or sample.frozen is not None:
            plan = self.controller.plan(sample, state)
            if plan.moves is None:
                return plan
            plan = self._only(plan.moves[:m], plan)
        else:
            plan = self._only(self._law.unit * move, Plan(None, Status.FEASIBLE, held))
        return plan._replace(memory=np.concatenate([[max(held, 1) - 1], reference]))

    def _longest_hold(self, error: Array, least: Array, most: Array) -> tuple[int, Array | None]:
        """h, and the move (m,), in units, that keeps the decay for so long: none if holding does."""
        size, none = float(np.abs(self._law.P @ error).max()), np.zeros(len(least))
        reach = np.abs(self._forced).max()
        if size <= NEAR * max(reach, 1e-300):
            return self._longest, none
        end = size * self._law.rho ** np.arange(1, self._longest + 1)
        level, drift = self._beta * end, self._free @ error
        largest = np.abs(drift).max(axis=1)
        beyond = np.flatnonzero(largest > level)
        within = beyond[0] if len(beyond) else len(level)
        holds = np.flatnonzero(largest[:within] <= end[:within])
        low, high = (int(holds[-1]) + 1 if len(holds) else 0), self._longest
        found: Array | None = none if low else None
        while low < high:
            middle = (low + high + 1) // 2
            levels = np.append(level[: middle - 1], end[middle - 1])
            move = self._program(error, drift[:middle], levels, least, most)
            if move is None:
                high = middle - 1
            else:
                low, found = middle, move
        return low, found

    def _program(self, error: Array, drift: Array, level: Array, least: Array, most: Array) -> Array | None:
        """The move, nearest to that of the LQ law, that keeps |drift + forced move| <= level, in units; or None."""
        h, unit, size = len(level), self._law.unit, level[0]
        if h not in self._solvers:
            rows = self._forced[:h].reshape(-1, len(unit))
            self._solvers[h] = DaqpSolver(QuadraticProgram(np.eye(len(unit)), rows, len(unit)))
        free, within = drift.ravel(), np.repeat(level, drift.shape[1])
        low = np.concatenate([least / unit, -within - free]) / size
        high = np.concatenate([most / unit, within - free]) / size
        solver = self._solvers[h]
        solver.start()
        solution = solver.solve(
            self._law.K @ error / size, np.maximum(low, -UNBOUNDED), np.minimum(high, UNBOUNDED)
        )
        return None if solution.z is None else size * solution.z


class _Law(NamedTuple):
    """Moves -K z, in units, of the state z = (x - x_s, (u - u_s) / unit), z+ = A z + B move; |P z|_inf falls by rho."""

    A: Array
    B: Array
    K: Array
    P: Array
    rho: float
    unit: Array


def _law_of(problem: TrackingProblem, decay: float | None) -> _Law:
    """The LQ law with a problem's weights, and a norm of what errors and moves are to come under it.

    Rows of P are rho^-i H (A - B K)^i, with H of weighted outputs and moves, until further ones are combinations of
    these with weights of 1 together. So the norm falls by rho a sample under the law, and counts in units of the cost
    whatever the states' units are. Modes that inputs do not reach, such as a load that fades, count for nothing: no
    input decides them.
    """
    from scipy.linalg import solve_discrete_are

    model, weights = problem.model, np.diag(problem.move_weight)
    n, m = model.n_states, model.n_inputs
    unit = 1 / np.sqrt(np.where(weights > 0, weights, 1.0))
    A = np.block([[model.A, model.B[:, :m] * unit], [np.zeros((m, n)), np.eye(m)]])
    B = np.vstack([model.B[:, :m] * unit, np.eye(m)])
    output = square_root(problem.output_weight) @ np.hstack([model.C, model.D[:, :m] * unit])
    R = unit[:, None] * problem.move_weight * unit
    Q = output.T @ output
    Q[n:, n:] += NEAREST * np.eye(m)  # where outputs leave inputs free, these return to their target
    try:
        S = solve_discrete_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise MampcError(
            f"SelfTriggered: expected a model that an LQ law stabilises, received one with: {error}"
        ) from None
    K = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
    closed = A - B @ K
    values, vectors = np.linalg.eig(closed)
    left = _unreached(A, B / np.sqrt(np.diag(B.T @ S @ B) + np.diag(R)))
    size = np.abs(left).max(initial=0.0)
    reached = np.abs(left @ vectors).max(axis=0, initial=0.0) <= UNREACHED * size
    own = vectors[:, ~reached]
    if len(left) != own.shape[1]:
        raise MampcError("SelfTriggered: expected a model whose inputs reach all of its lasting modes")
    only = np.eye(len(A)) - (own @ np.linalg.solve(left @ own, left)).real if len(left) else np.eye(len(A))
    slowest = float(np.abs(values[reached]).max(initial=0.0))
    rho = min(max(0.5 * (1 + slowest), FASTEST), SLOWEST) if decay is None else decay
    rows = ahead = np.vstack([output, square_root(R) @ K]) @ only
    for _ in range(MOST_AHEAD):
        ahead = ahead @ closed / rho
        parts = ahead @ np.linalg.pinv(rows)
        left_out = np.abs(ahead - parts @ rows).max()
        if np.abs(parts).sum(axis=1).max() <= 1 and left_out <= UNREACHED * np.abs(rows).max():
            break
        rows = np.vstack([rows, ahead])
    return _Law(A, B, K, rows, rho, unit)


def _unreached(A: Array, B: Array) -> Array:
    """Left eigenvectors of the lasting modes that inputs do not reach, one a row."""
    values, vectors = np.linalg.eig(A.T)
    reach = np.abs(vectors.T @ B).max(axis=1, initial=0.0)
    unreached = (reach <= UNREACHED * reach.max(initial=0.0)) & (np.abs(values) > LASTS)
    left: Array = vectors.T[unreached]
    return left
