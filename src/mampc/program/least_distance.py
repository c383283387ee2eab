"""The program as a least distance: how far from the optimum without limits one has to go to keep them.

    minimise   |delta|^2 + w sum (a + a^2 / 2)
    subject to lower <= [a; rows (optimum + R^-1 delta) + violations a] <= upper

over the distance delta = R (moves - optimum) and the violations a, R the triangular factor of the cost. A solver
meets a Hessian 2 I and rows of length near 1 whatever the problem's condition and units are, and the cost beyond that
of the optimum is a sum of squares.
"""

from __future__ import annotations

from math import frexp, isfinite
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import UNBOUNDED, QPStatus, QuadraticProgram


class Nearest(NamedTuple):
    """The best moves within limits, shape (moves,), what they cost more than the optimum without, and multipliers.

    Multipliers, shape (bounds,), are positive at upper bounds. Moves and multipliers are None, and the excess is
    infinite, unless the status is OPTIMAL.
    """

    moves: Array | None
    excess: float
    multipliers: Array | None
    status: QPStatus
    iterations: int
    violated: bool = False  # whether some violation is above zero


class LeastDistance:
    """One such program, to be solved again and again for new optima and bounds.

    Every solve begins anew, from the active bounds given, so that its answer depends on its arguments alone.

    Args:
        R: upper triangular factor of the cost in the moves, shape (k, k).
        rows: bounded quantities per move, shape (b, k).
        violations: the same per violation, shape (b, v).
        weight: w.
        n_simple: so many first rows are the first moves themselves; active bounds of these are kept exactly.
        time_limit: seconds that a solve may take; None for no limit.
    """

    def __init__(
        self,
        R: Array,
        rows: Array,
        violations: Array,
        weight: float,
        *,
        n_simple: int = 0,
        time_limit: float | None = None,
    ) -> None:
        v, k = violations.shape[1], len(R)
        self._v, self._weight, self._rows, self._n_simple = v, weight, np.ascontiguousarray(rows), n_simple
        self._inverse = np.linalg.solve(R, np.eye(k))
        self._per_violation = np.sqrt(2 / weight)  # of its coordinate in which its curvature is 2 as well
        A = np.hstack([violations * self._per_violation, rows @ self._inverse])
        length = np.sqrt(np.square(A).sum(axis=1))
        # Powers of two change no digit.
        even = 2.0 ** -np.round(np.log2(np.where(length > 0, length, 1.0)))
        self._A = A * even[:, None]
        self._even = np.concatenate([np.full(v, 1 / self._per_violation), even])
        self._f = np.concatenate([np.full(v, weight * self._per_violation), np.zeros(k)])
        self._solver = DaqpSolver(QuadraticProgram(2 * np.eye(v + k), self._A, v), time_limit=time_limit)

    def solve(self, optimum: Array, lower: Array, upper: Array, active: Array | None = None) -> Nearest:
        """The best moves, given the optimum without limits, shape (k,), and all bounds, shape (v + b,)."""
        low, high = self._from_optimum(optimum, lower, upper)
        if active is not None:  # a bound that went away since cannot be started from
            active = np.where(
                (active > 1) & (lower <= -UNBOUNDED) | (active == 1) & (upper >= UNBOUNDED), 0.0, active
            )
        scale = self._scale(low, high)
        self._solver.start(active)
        solution = self._solver.solve(self._f / scale, low / scale, high / scale)
        if solution.z is None or solution.multipliers is None:
            return Nearest(None, np.inf, None, solution.status, solution.iterations)
        v, z = self._v, solution.z * scale
        delta, excess, violated = z[v:], 0.0, False
        if v and z[:v].max() > 0:
            violated = True
            a = np.maximum(z[:v] * self._per_violation, 0.0)
            excess = self._weight * float(a.sum() + 0.5 * a.dot(a))
        excess += float(delta.dot(delta))
        multipliers = solution.multipliers * self._even * scale
        moves = optimum + self._inverse.dot(delta)
        simple = slice(v, v + self._n_simple)
        pull = multipliers[simple]
        at_bound = np.where(pull > 0, upper[simple], lower[simple])
        moves[: self._n_simple] = np.where(pull == 0, moves[: self._n_simple], at_bound)
        return Nearest(moves, excess, multipliers, solution.status, solution.iterations, violated)

    def relaxed(self, optimum: Array, lower: Array, upper: Array, multipliers: Array) -> tuple[Array, float]:
        """The optimum with limits priced by multipliers: its delta, and its cost beyond that of the optimum without."""
        low, high = self._from_optimum(optimum, lower, upper)
        pull, v = multipliers / self._even, self._v
        gradient = self._f + pull[v:].dot(self._A)
        gradient[:v] += pull[:v]
        excess = (
            -0.25 * gradient.dot(gradient) - np.maximum(pull, 0.0).dot(high) - np.minimum(pull, 0.0).dot(low)
        )
        return -0.5 * gradient[v:], float(excess)

    def _from_optimum(self, optimum: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
        """The bounds as distances from the optimum."""
        low, high, reached = lower.copy(), upper.copy(), self._rows.dot(optimum)
        low[self._v :] -= reached
        high[self._v :] -= reached
        low *= self._even
        high *= self._even
        return low, high

    def _scale(self, low: Array, high: Array) -> float:
        """A power of two near the distance to go, which makes the solver's absolute tolerances relative.

        Violations have a size of their own, 1: nothing smaller is enlarged then.
        """
        if len(low) == self._v:
            return 1.0
        far = max(float(low[self._v :].max()), -float(high[self._v :].min()))
        if not (isfinite(far) and far > (1.0 if self._v else 0.0)):
            return 1.0
        return float(2.0 ** frexp(far)[1])
