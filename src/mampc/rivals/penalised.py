"""MPC with a penalty that makes moves or inputs sparse: one class for the family, the penalty an object.

    minimise   J(d) + penalty(z / size)    within the limits

with z the moves d ("minimum attention"), or the inputs less their steady target, v = u - u_s ("hands off"). The
program in (violations, d, t), |z| <= t, has the penalty's majoriser for linear and quadratic terms; it is solved again
at each new point until the objective settles. Entries that are nothing beside the largest are zero.
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
from mampc.program.qp import UNBOUNDED
from mampc.program.sample import Sample
from mampc.program.steady import Steady, SteadyTarget
from mampc.program.tail import square_root
from mampc.rivals.penalties import Penalty

CURVATURE = 1e-7  # of t, relative to the moves' in units of size: daqp wants a strictly convex program
ZERO = 1e-5  # of the largest |z| / size: below it an entry is none
VANISHING = 1e-3  # of the largest: where a norm goes on shrinking below it, it goes to zero
PATIENCE = 5  # rounds before a norm is believed to vanish
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
        self, problem: TrackingProblem, *, penalty: Penalty, on: str = "moves", terminal: str | None = None,
        rounds: int = 200, tolerance: float = 1e-9,
    ) -> None:  # fmt: skip
        super().__init__(problem)
        if not isinstance(penalty, Penalty):
            raise MampcError(f"penalty: expected one of mampc.rivals, received {type(penalty).__name__}")
        if on not in ON or terminal not in TERMINALS:
            raise MampcError(
                f"expected on one of {ON} and terminal one of {TERMINALS}, received {on!r} and {terminal!r}"
            )
        self.penalty, self._on_inputs = penalty, on == "inputs"
        self._rounds = as_whole("rounds", rounds, 1)
        self._tolerance = as_number("tolerance", tolerance, 0.0)
        m, n_c = problem.model.n_inputs, problem.control_horizon
        size = as_vector("size", penalty.size, m)
        if not (size > 0).all():
            raise MampcError(f"size: expected values above 0, received {penalty.size!r}")
        self._size = np.tile(size, n_c)
        self._target = SteadyTarget(problem, self.condensed.parameter)
        self._terminal = _Terminal(problem, self.condensed.parameter) if terminal else None
        n = self.condensed.n_moves
        self._z = (self.condensed.cumulate if self._on_inputs else np.eye(n)) / self._size[:, None]
        self._kept: tuple[bytes, DaqpSolver] | None = None

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """Majorise and minimise, from the plan without penalty on."""
        if sample.frozen is not None:  # plain MPC while inputs are in manual
            return self._unrestricted(sample, state)
        n, v = self.condensed.n_moves, self.condensed.n_violations
        p = sample.parameter
        needs_target = self._on_inputs or self._terminal is not None
        steady = self._target.at(p) if needs_target else None
        z0 = np.zeros(n)
        if self._on_inputs and steady is not None:
            z0 = np.tile(sample.u_previous - steady.u, self.problem.control_horizon) / self._size
        f_terminal: Array = np.zeros(n)
        H_terminal: Array = np.zeros((n, n))
        if self._terminal is not None and steady is not None:
            f_terminal, H_terminal = self._terminal.terms(p, steady)
        lower = np.concatenate([sample.lower, z0, -z0])
        upper = np.concatenate([sample.upper, np.full(2 * n, UNBOUNDED)])
        d, rounds, last = sample.moves, 0, np.inf
        vanished, before, largest = np.zeros(n, dtype=bool), np.zeros(n), 0.0
        beyond = 10 * (np.abs(sample.f_moves) * self._size).max() + self.penalty.weight
        for rounds in range(1, self._rounds + 1):
            a = np.abs(self._z @ d + z0).reshape(self._shape)
            if rounds == 1:  # what is zero by chance would stay so
                a = np.maximum(a, VANISHING * a.max())
            c, q = (term.ravel() for term in self.penalty.majoriser(a))
            # Quadratic terms alone never reach zero: a norm that vanishes gets an l1 weight beyond any gradient.
            norm = np.divide(self.penalty.weight, q, out=np.full(n, np.inf), where=(c == 0) & (q > 0))
            if rounds == 1:
                largest = norm[np.isfinite(norm)].max(initial=0.0)  # with no penalty on
            elif rounds > PATIENCE:
                vanished |= (norm < VANISHING * largest) & (norm < before)
            before = norm
            c, q = np.where(vanished, beyond, c), np.where(vanished, 0.0, q)
            f = np.concatenate([sample.f, c])
            f[v : v + n] += f_terminal + self._z.T @ (q * z0)
            solver = self._solver_for(q, H_terminal)
            solver.start()
            solution = solver.solve(f, lower, upper)
            if solution.z is None:
                if rounds == 1:
                    return Plan(None, HELD_BY[solution.status], rounds)
                break
            d = solution.z[v : v + n]
            value = self._value(sample, d, z0, f_terminal, H_terminal)
            still = (
                2 * PATIENCE if np.isfinite(norm).any() else 1
            )  # rounds in which a norm may begin to vanish
            settled = last - value <= self._tolerance * abs(value) and rounds > still
            if not self.penalty.repeated or settled:
                break
            last = value
        settled = rounds < self._rounds
        status = Status.SETTLED if settled else Status.ITERATION_LIMIT
        return Plan(self._without_nothing(d, z0), status, rounds)

    def _value(self, sample: Sample, d: Array, z0: Array, f: Array, H: Array) -> float:
        a = np.abs(self._z @ d + z0).reshape(self._shape)
        return float(self.condensed.cost(sample, d) + d @ (0.5 * H @ d + f) + self.penalty.value(a))

    def _solver_for(self, q: Array, H_terminal: Array) -> DaqpSolver:
        """The solver for quadratic terms q; it stays while they do."""
        key = q.tobytes()
        if self._kept is None or self._kept[0] != key:
            curvature = CURVATURE * (np.diag(self.condensed.H) * self._size**2).mean()
            H = self._z.T @ (q[:, None] * self._z) + H_terminal
            program = with_sizes(self.condensed, self._z, H, np.full(len(q), curvature))
            self._kept = key, DaqpSolver(program, tolerance=1e-9 * np.sqrt(CURVATURE))
        return self._kept[1]

    def _without_nothing(self, d: Array, z0: Array) -> Array:
        """The moves with entries of z that are nothing beside the largest exactly zero."""
        z = self._z @ d + z0
        largest = max(np.abs(z).max(), np.abs(z0).max())
        z = np.where(np.abs(z) <= ZERO * largest, 0.0, z)
        if not self._on_inputs:
            return np.where(z == 0.0, 0.0, d)
        moves: Array = np.linalg.solve(self._z, z - z0)
        moved = np.abs(moves / self._size)
        moves[moved <= ZERO * moved.max()] = 0.0
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
        self._H = 2 * self._of_moves.T @ self._of_moves

    def terms(self, p: Array, steady: Steady) -> tuple[Array, Array]:
        """Linear and quadratic term in the moves."""
        at = self._parameter
        applied = np.concatenate([p[at.u_deviation] + p[at.input_disturbance], p[at.measured_disturbance]])
        free = self._power @ p[at.x] + self._response @ applied
        return 2 * self._of_moves.T @ (self._root @ (free - steady.x)), self._H
