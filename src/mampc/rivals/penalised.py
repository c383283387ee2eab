"""MPC with a penalty that makes moves or inputs sparse: one class for the family, the penalty an object.

    minimise   J(d) + penalty(z / size)    within the limits

with z the moves d ("minimum attention"), or the inputs less their steady target, v = u - u_s ("hands off"). Norms go
to a conic solver. For a separable penalty the program in (violations, d, t), |z| <= t, has its majoriser for linear and
quadratic terms, and is solved again at each new point until the objective settles. Entries that are nothing beside the
largest are zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, as_number, as_vector, as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Status
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.l1 import with_sizes
from mampc.methods.method import HELD_BY, Plan
from mampc.program.daqp import DaqpSolver
from mampc.program.prediction import Prediction
from mampc.program.problem import TrackingProblem
from mampc.program.qp import UNBOUNDED, QuadraticProgram
from mampc.program.sample import Sample
from mampc.program.steady import Steady, SteadyTarget
from mampc.program.tail import square_root
from mampc.rivals.norms import Norm, NormsSolver
from mampc.rivals.penalties import Norms, Separable

CURVATURE = 1e-7  # of t, relative to the moves' in units of size: daqp wants a strictly convex program
ZERO = 1e-5  # of the largest |z| / size: below it an entry is none
NEARLY = (1e-1, 1e-2, 1e-3, 1e-4)  # of the same, from a conic solver: below it an entry may be none
ROUNDED = 1e-9  # of the moves without penalty: how far inputs may be beyond bounds for rounding
ON = ("moves", "inputs")
TERMINALS = (None, "riccati")


class Penalised(Controller):
    """Model predictive control with a sparsity penalty.

    Args:
        problem: see `TrackingProblem`.
        penalty: one of `mampc.rivals`: `L1`, `GroupL2`, `CLOT`, `ElasticNet`, `SCAD`, `MCP`, `LogSum`.
        on: "moves", or "inputs" about the steady target of reference and disturbances.
        terminal: None, or "riccati": |x_np - x_s|^2_P with P of the infinite-horizon LQ problem with the problem's
            weights (the move weight on inputs). With `on="inputs"` and `L1` this is lasso-MPC (Gallieri and
            Maciejowski 2012); with nc = np the sparse quadratic
            regulator (Jovanovic and Lin 2013).
        rounds: majorisers at most.
        tolerance: relative; stop when the objective falls by no more.

    Raises:
        MampcError: an unknown setting, or a model whose Riccati equation has no stabilising solution.
    """

    def __init__(
        self, problem: TrackingProblem, *, penalty: Separable | Norms, on: str = "moves", terminal: str | None = None,
        rounds: int = 200, tolerance: float = 1e-9,
    ) -> None:  # fmt: skip
        super().__init__(problem)
        if not isinstance(penalty, Separable | Norms):
            raise MampcError(f"penalty: expected one of mampc.rivals, received {type(penalty).__name__}")
        if on not in ON or terminal not in TERMINALS:
            raise MampcError(
                f"expected on one of {ON} and terminal one of {TERMINALS}, received {on!r} and {terminal!r}"
            )
        self.penalty, self._on_inputs = penalty, on == "inputs"
        self._rounds = as_whole("rounds", rounds, 1)
        self._tolerance = as_number("tolerance", tolerance, 0.0)
        m, n_c = problem.model.n_inputs, problem.control_horizon
        self._size = np.tile(as_vector("size", penalty.size, m, 0.0, exclusive=True), n_c)
        self._target = SteadyTarget(problem, self.condensed.parameter)
        self._terminal = _Terminal(problem, self.condensed.parameter) if terminal else None
        n = self.condensed.n_moves
        self._z = (self.condensed.cumulate if self._on_inputs else np.eye(n)) / self._size[:, None]
        self._H_beside = self._terminal.H if self._terminal is not None else np.zeros((n, n))
        self._norms: list[tuple[float, list[int]]] = []
        if isinstance(penalty, Norms):
            self._norms = penalty.norms(*self._shape)
            self._conic = self._with_norms()
        self._kept: tuple[bytes, DaqpSolver] | None = None

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """The optimum for norms and convex penalties, a stationary point for concave ones."""
        if sample.frozen is not None:  # plain MPC while inputs are in manual
            return self._unrestricted(sample, state)
        p = sample.parameter
        z0: Array = np.zeros(self.condensed.n_moves)
        f: Array = np.zeros(self.condensed.n_moves)
        if self._on_inputs or self._terminal is not None:
            steady = self._target.at(p)
            if self._on_inputs:
                z0 = np.tile(sample.u_previous - steady.u, self.problem.control_horizon) / self._size
            if self._terminal is not None:
                f = self._terminal.linear(p, steady)
        if isinstance(self.penalty, Separable):
            plan = self._majorised(self.penalty, sample, z0, f)
        else:
            plan = self._of_norms(sample, z0, f)
        return plan

    def _of_norms(self, sample: Sample, z0: Array, f: Array) -> Plan:
        """The optimum for a sum of norms; f is linear in the moves and beside the tracking cost, as below."""
        v = self.condensed.n_violations
        linear = sample.f.copy()
        linear[v:] += f
        constants = [z0[entries] for _, entries in self._norms]
        solution = self._conic.solve(linear, sample.lower, sample.upper, constants)
        if solution.z is None:
            return Plan(None, HELD_BY[solution.status], solution.iterations)
        d = solution.z[v:]
        value, unit = self._value(sample, d, z0, f), self._sizes(sample.moves, z0).max()
        room = self._excess(sample, d)
        for share in NEARLY:  # the central path comes near zero only: zero is better where it is the optimum
            sparse = self._without_nothing(d, z0, share, unit)
            if self._value(sample, sparse, z0, f) <= value and (self._excess(sample, sparse) <= room).all():
                return Plan(sparse, Status.SETTLED, solution.iterations)
        return Plan(self._without_nothing(d, z0), Status.SETTLED, solution.iterations)

    def _excess(self, sample: Sample, d: Array) -> Array:
        """By how much rows of inputs are beyond their bounds, at least what rounding may add, shape (rows,)."""
        program, v = self.condensed.program, self.condensed.n_violations
        of_inputs = ~program.A[:, :v].any(axis=1)
        rows, low, high = (
            one[of_inputs]
            for one in (program.A, sample.lower[program.n_simple :], sample.upper[program.n_simple :])
        )
        at, size = rows[:, v:] @ d, np.abs(rows[:, v:]) @ np.abs(sample.moves)
        return np.maximum(np.maximum(at - high, low - at), ROUNDED * size)

    def _majorised(self, penalty: Separable, sample: Sample, z0: Array, f: Array) -> Plan:
        """Majorise and minimise, from the plan without penalty on."""
        n, v = self.condensed.n_moves, self.condensed.n_violations
        lower = np.concatenate([sample.lower, z0, -z0])
        upper = np.concatenate([sample.upper, np.full(2 * n, UNBOUNDED)])
        d, last, status = sample.moves, np.inf, Status.ITERATION_LIMIT
        for rounds in range(1, self._rounds + 1):
            c, q = (term.ravel() for term in penalty.majoriser(self._sizes(d, z0)))
            linear = np.concatenate([sample.f, c])
            linear[v : v + n] += f + self._z.T @ (q * z0)
            solver = self._solver_for(q)
            solver.start()
            solution = solver.solve(linear, lower, upper)
            if solution.z is None:
                if rounds == 1:
                    return Plan(None, HELD_BY[solution.status], rounds)
                break
            d = solution.z[v : v + n]
            value = self._value(sample, d, z0, f)
            if not penalty.repeated or last - value <= self._tolerance * abs(value):
                status = Status.SETTLED
                break
            last = value
        return Plan(self._without_nothing(d, z0), status, rounds)

    def _sizes(self, d: Array, z0: Array) -> Array:
        """a of the penalty, shape (nc, m)."""
        return np.abs(self._z @ d + z0).reshape(self._shape)

    def _value(self, sample: Sample, d: Array, z0: Array, f: Array) -> float:
        beside = d @ (0.5 * self._H_beside @ d + f)
        return float(self.condensed.cost(sample, d) + beside + self.penalty.value(self._sizes(d, z0)))

    def _with_norms(self) -> NormsSolver:
        """The solver for the norms beside the problem in (violations, d)."""
        program, v = self.condensed.program, self.condensed.n_violations
        H = program.H.copy()
        H[v:, v:] += self._H_beside
        rows = np.hstack([np.zeros((len(self._z), v)), self._z])
        norms = [Norm(weight, rows[entries]) for weight, entries in self._norms]
        return NormsSolver(QuadraticProgram(H, program.A, program.n_simple), norms)

    def _solver_for(self, q: Array) -> DaqpSolver:
        """The solver for quadratic terms q; it stays while they do."""
        key = q.tobytes()
        if self._kept is None or self._kept[0] != key:
            curvature = CURVATURE * (np.diag(self.condensed.H) * self._size**2).mean()
            H = self._z.T @ (q[:, None] * self._z) + self._H_beside
            program = with_sizes(self.condensed, self._z, H, np.full(len(q), curvature))
            self._kept = key, DaqpSolver(program, tolerance=1e-9 * np.sqrt(CURVATURE))
        return self._kept[1]

    def _without_nothing(self, d: Array, z0: Array, share: float = ZERO, unit: float = 0.0) -> Array:
        """The moves with entries of z that are nothing beside the largest, or beside a unit, exactly zero."""
        z = self._z @ d + z0
        largest = max(np.abs(z).max(), np.abs(z0).max(), unit)
        z = np.where(np.abs(z) <= share * largest, 0.0, z)
        if not self._on_inputs:
            return np.where(z == 0.0, 0.0, d)
        moves: Array = np.linalg.solve(self._z, z - z0)
        moved = np.abs(moves / self._size)
        moves[moved <= share * moved.max()] = 0.0
        return moves


class _Terminal:
    """|x_np - x_s|^2_P as a quadratic function of the moves."""

    def __init__(self, problem: TrackingProblem, parameter: Any) -> None:
        from scipy.linalg import solve_discrete_are

        model, n_p, n_c = problem.model, problem.prediction_horizon, problem.control_horizon
        m = model.n_inputs
        Q = model.C.T @ problem.output_weight @ model.C
        try:
            P = solve_discrete_are(model.A, model.B[:, :m], Q, problem.move_weight)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise MampcError(
                f"terminal: expected a model whose Riccati equation has a stabilising solution, received: {error}"
            ) from None
        self._parameter = parameter
        prediction = Prediction(problem, parameter)
        self._root = square_root((P + P.T) / 2)
        response = prediction.state_response
        self._of_moves = self._root @ np.hstack([response[n_p - j][:, :m] for j in range(n_c)])
        self._power, self._response = prediction.final_power, response[-1]
        self.H = 2 * self._of_moves.T @ self._of_moves

    def linear(self, p: Array, steady: Steady) -> Array:
        """The linear term in the moves; H is the Hessian."""
        at = self._parameter
        applied = np.concatenate([p[at.u_deviation] + p[at.input_disturbance], p[at.measured_disturbance]])
        free = self._power @ p[at.x] + self._response @ applied
        linear: Array = 2 * self._of_moves.T @ (self._root @ (free - steady.x))
        return linear
