"""The program as a least distance: how far from the optimum without limits one has to go to keep them.

    minimise   |delta|^2 + sum (l a + c a^2 / 2)
    subject to lower <= [a; rows (optimum + R^-1 delta) + violations a] <= upper

over the distance delta = R (moves - optimum) and the violations a, R the triangular factor of the cost. A solver
meets a Hessian 2 I and rows of length near 1 whatever the problem's condition and units are, and the cost beyond that
of the optimum is a sum of squares.
"""

from __future__ import annotations

from functools import cached_property
from math import frexp, isfinite, ldexp
from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.daqp import ORDINARY, DaqpSolver, each_there, there
from mampc.program.qp import QPSolution, QPStatus, QuadraticProgram
from mampc.program.refinement import refined

SLACK = 1e-12  # of the distance to go: how far a solver may miss a bound
UNCERTAIN = 1e-10  # of the excess: what a solver's slack may be worth before the solution is refined
VIOLATED = 1e-18  # in the solver's units: a violation up to here is rounding
ROUNDING = 1e-15  # of what a sum adds up: how far it may be from the truth
NEWTON = 30  # steps, until it is left at that
DOUBTFUL = 1e4  # condition of R from which on the slack that a solver leaves is looked at


class Nearest(NamedTuple):
    """The best moves within limits, shape (moves,), what they cost more than the optimum without, and multipliers.

    Multipliers, shape (bounds,), are positive at upper bounds. Moves and multipliers are None, and the excess is
    infinite, unless the status is OPTIMAL. Moves are None too where they cost more than is asked for.
    """

    moves: Array | None
    excess: float
    multipliers: Array | None
    status: QPStatus
    iterations: int
    violated: bool = False  # whether some violation is above zero


class NearestOfEach(NamedTuple):
    """`Nearest` of K programs: moves (K, moves) and multipliers (K, bounds), of the OPTIMAL ones alone."""

    moves: Array
    multipliers: Array
    status: list[QPStatus]


class ViolationCost(NamedTuple):
    """What violations a cost: l a + c a^2 / 2, l and c of shape (v,); those with l > 0 stand first and are >= 0."""

    linear: Array
    curvature: Array

    def of(self, violations: Array) -> float:
        return float(
            np.maximum(violations, 0.0).dot(self.linear) + 0.5 * (self.curvature * violations).dot(violations)
        )


class LeastDistance:
    """One such program, to be solved again and again for new optima and bounds.

    Every solve begins anew, from the active bounds given, so that its answer depends on its arguments alone.

    Attributes:
        even: factors of the bounds that make their rows about as long as each other, shape (v + b,).
        even_rows: rows times theirs, shape (b, k).

    Args:
        R: upper triangular factor of the cost in the moves, shape (k, k).
        rows: bounded quantities per move, shape (b, k).
        violations: the same per violation, shape (b, v).
        cost: of the violations.
        n_simple: so many first rows are the first moves themselves; active bounds of these are kept exactly.
        time_limit: seconds that a solve may take; None for no limit.
    """

    def __init__(
        self,
        R: Array,
        rows: Array,
        violations: Array,
        cost: ViolationCost,
        *,
        n_simple: int = 0,
        time_limit: float | None = None,
    ) -> None:
        v, k = violations.shape[1], len(R)
        self._R, self._violations = R, violations
        self._v, self._cost, self._rows, self._n_simple = v, cost, np.ascontiguousarray(rows), n_simple
        self._limited = int(np.count_nonzero(cost.linear))
        self._inverse = np.linalg.solve(R, np.eye(k))
        self._per_violation = np.sqrt(2 / cost.curvature)  # of its coordinate of curvature 2
        A = np.hstack([violations * self._per_violation, rows @ self._inverse])
        length = np.sqrt(np.square(A).sum(axis=1))
        # Powers of two change no digit.
        even = 2.0 ** -np.round(np.log2(np.where(length > 0, length, 1.0)))
        self._A, self.even_rows = A * even[:, None], rows * even[:, None]
        self.even = np.concatenate([1 / self._per_violation, even])
        self._f = np.concatenate([cost.linear * self._per_violation, np.zeros(k)])
        self._ordinary = bool(self._f.dot(self._f) <= ORDINARY**2)
        self._every = np.vstack([np.eye(v, v + k), self._A])  # the violations' own bounds and the rows
        self._of_scale: dict[float, tuple[Array, Array]] = {}
        self._nothing = np.zeros(v + len(A))
        self._nothing.setflags(write=False)
        self._solver = DaqpSolver(
            QuadraticProgram(2 * np.eye(v + k), self._A, v),
            time_limit=time_limit,
            tolerance=SLACK,
            keeps_data=True,
        )

    def solve(self, optimum: Array, lower: Array, upper: Array) -> Nearest:
        """The best moves, given the optimum without limits, shape (k,), and all bounds, shape (v + b,)."""
        bounds = np.concatenate((lower, upper))
        return self.solve_at(optimum, self.distances(optimum, bounds), bounds)

    def solve_at(
        self,
        optimum: Array,
        distances: Array,
        bounds: Array,
        active: Array | None = None,
        cutoff: float = np.inf,
    ) -> Nearest:
        """The same where the `distances` are at hand, lower ones and behind them upper ones, as the bounds stand too.

        Moves that cost no less than the cutoff are left out.
        """
        v, limited, size = self._v, self._limited, len(self.even)
        low, high = distances[:size], distances[size:]
        far = self._far(low, high)
        if far <= 0:
            return Nearest(optimum, 0.0, self._nothing, QPStatus.OPTIMAL, 0)
        scale, f, even = 1.0, self._f, self.even
        # Violations of limits have a size of their own, 1: nothing smaller is enlarged then.
        if far > (1.0 if limited else 0.0) and isfinite(far):
            scale = ldexp(1.0, frexp(far)[1])
            f, even = self._scaled(scale)
            scaled = distances / scale
            low, high = scaled[:size], scaled[size:]
        if self._ordinary:
            sense = None if active is None else there(active, low, high)
            solution = self._solver.solve_anew(f, low, high, sense)
        else:
            self._solver.start(active)
            solution = self._solver.solve(f, low, high)
        z, pull, status, iterations = solution
        if z is None or pull is None:
            if status in (QPStatus.INFEASIBLE, QPStatus.FAILED, QPStatus.ITERATION_LIMIT):
                return self._tried_again(optimum, bounds[:size], bounds[size:], solution)
            return Nearest(None, np.inf, None, status, iterations)
        delta = z[v:] * scale
        excess, violated = float(delta.dot(delta)), limited > 0 and max(z[:limited].tolist()) > VIOLATED
        if violated or v > limited:
            excess += self._cost.of(z[:v] * (scale * self._per_violation))
        multipliers = pull * even
        if self._doubtful:
            slack = np.where(pull > 0, high, low)[v:] - self._A.dot(z)
            if scale * scale * np.abs(pull[v:]).dot(np.abs(slack)) > UNCERTAIN * excess:
                return self._refined(optimum, bounds[:size], bounds[size:], multipliers, iterations)
        if excess >= cutoff:
            return Nearest(None, excess, multipliers, status, iterations, violated)
        moves = self._inverse.dot(delta)
        moves += optimum
        for i, force in enumerate(pull[v : v + self._n_simple].tolist()):
            if force:
                moves[i] = bounds[v + i + size if force > 0 else v + i]
        return Nearest(moves, excess, multipliers, status, iterations, violated)

    def solve_each(
        self, optima: Array, distances: Array, bounds: Array, active: list[Array | None], deadline: float
    ) -> NearestOfEach:
        """`solve_at` for K programs, arrays of K rows; none begins after the deadline, of `perf_counter`."""
        v, K, size = self._v, len(optima), len(self.even)
        low, high, status = distances[:, :size], distances[:, size:], [QPStatus.TIME_LIMIT] * K
        far = np.maximum(low.max(axis=1, initial=-np.inf), -high.min(axis=1, initial=np.inf))
        plain = (far > 0) & (far < np.inf) & (self._ordinary and not self._doubtful)
        enlarged = plain & (far > (1.0 if self._limited else 0.0))
        scale = np.ldexp(1.0, np.where(enlarged, np.frexp(far)[1], 0))[:, None]
        f, low, high = self._f / scale, low / scale, high / scale
        z, pull = np.zeros((K, len(self._f))), np.zeros((K, size))
        started = np.array([self._nothing if flags is None else flags for flags in active])
        senses = each_there(started, low, high)
        alone: dict[int, Nearest] = {}
        for k in range(K):
            if perf_counter() > deadline:
                break
            found = self._solver.solve_anew(f[k], low[k], high[k], senses[k]) if plain[k] else None
            if found is not None and found.z is not None and found.multipliers is not None:
                z[k], pull[k], status[k] = found.z, found.multipliers, QPStatus.OPTIMAL
            elif found is None or found.status is not QPStatus.TIME_LIMIT:
                alone[k] = self.solve_at(optima[k], distances[k], bounds[k], active[k])
                status[k] = alone[k].status
        moves, multipliers = optima + (z[:, v:] * scale) @ self._inverse.T, pull * (scale * self.even)
        force, own = pull[:, v : v + self._n_simple], moves[:, : self._n_simple]
        own[force > 0] = bounds[:, size + v :][:, : self._n_simple][force > 0]
        own[force < 0] = bounds[:, v : v + self._n_simple][force < 0]
        for k, nearest in alone.items():
            moves[k] = multipliers[k] = 0.0
            if nearest.moves is not None and nearest.multipliers is not None:
                moves[k], multipliers[k] = nearest.moves, nearest.multipliers
        return NearestOfEach(moves, multipliers, status)

    def _scaled(self, scale: float) -> tuple[Array, Array]:
        """The linear term of all lengths divided by a power of two, and what its multipliers are multiplied by."""
        kept = self._of_scale.get(scale)
        if kept is None:
            kept = self._of_scale[scale] = self._f / scale, scale * self.even
        return kept

    @cached_property
    def _doubtful(self) -> bool:
        """Whether a solver may spoil the optimum by its slack, for the condition of R."""
        length = np.linalg.norm(self._R, axis=0)
        return bool(len(length) and np.linalg.cond(self._R / length) > DOUBTFUL)

    @cached_property
    def _firm(self) -> BoolArray:
        """The rows without violations, on which alone it depends whether there are moves within all bounds."""
        return np.asarray(~self._violations.any(axis=1))

    @cached_property
    def _within_firm(self) -> DaqpSolver:
        """The shortest moves within these, whatever violations are and whatever the cost is."""
        return DaqpSolver(QuadraticProgram(np.eye(len(self._R)), self._rows[self._firm], 0))

    def _tried_again(self, optimum: Array, lower: Array, upper: Array, failed: QPSolution) -> Nearest:
        """What a solver failed at, made exact from a guess; INFEASIBLE only if there are no moves within bounds.

        Where bounds leave a move one value, rounding alone makes a tight tolerance fail, and where violations are far
        larger than moves, the size of their rows.
        """
        firm = self._within_firm
        low, high = (bounds[self._v :][self._firm] for bounds in (lower, upper))
        far = max(float(low.max(initial=0.0)), -float(high.min(initial=0.0)))
        scale = ldexp(1.0, frexp(far)[1]) if 0 < far < np.inf else 1.0
        firm.start()
        if firm.solve(np.zeros(len(self._R)), low / scale, high / scale).status is QPStatus.INFEASIBLE:
            return Nearest(None, np.inf, None, QPStatus.INFEASIBLE, failed.iterations)
        return self._refined(optimum, lower, upper, self._guess(optimum, lower, upper), failed.iterations)

    def _guess(self, optimum: Array, lower: Array, upper: Array) -> Array:
        """The signs of bounds that may be active: of the values outside their zones by Newton's method.

        Their errors are squares of the moves alone, once it is known on which side of its zone each value is. Far from
        zones as many bounds are active as values count, and each that is not guessed would take a round.
        """
        v, n, guess = self._v, self._limited, np.zeros(len(lower))
        if n == v:
            return guess
        zone, j = np.nonzero(self._violations[:, n:])
        low, high = lower[v + zone], upper[v + zone]
        weight = np.sqrt(self._cost.curvature[n + j] / 2) / np.abs(self._violations[zone, n + j])
        theta = np.hstack([np.zeros((len(zone), n)), self._rows[zone]])
        F, c, A = self._squares(optimum, n)
        others = np.delete(np.arange(len(A)), n + zone)
        kept = others + np.where(others < n, 0, v - n)
        pull: Array = np.zeros(len(others))
        outside = np.where(high < 0, 1.0, np.where(low > 0, -1.0, 0.0))
        for _ in range(NEWTON):
            at = np.flatnonzero(outside)
            squares = np.vstack([F, weight[at, None] * theta[at]])
            target = np.concatenate([c, (weight * np.where(outside > 0, high, low))[at]])
            found = refined(squares, target, A[others], lower[kept], upper[kept], pull)
            if found is None:
                break
            pull, reached, before = found.multipliers, theta @ found.z, outside
            outside = np.where(reached > high, 1.0, np.where(reached < low, -1.0, 0.0))
            if (before == outside).all():
                break
        guess[kept], guess[v + zone] = pull, outside
        return guess

    def _squares(self, optimum: Array, n: int) -> tuple[Array, Array, Array]:
        """F, c and the rows A of `refined` in the first n violations and the moves; A bounds these violations too."""
        k, root = len(self._R), np.sqrt(self._cost.curvature[:n] / 2)
        F, A = np.zeros((n + k, n + k)), np.zeros((n + len(self._rows), n + k))
        F[:n, :n], F[n:, n:] = np.diag(root), self._R
        A[:n, :n], A[n:, :n], A[n:, n:] = np.eye(n), self._violations[:, :n], self._rows
        return F, np.concatenate([-0.5 * self._cost.linear[:n] / root, self._R.dot(optimum)]), A

    def _refined(
        self, optimum: Array, lower: Array, upper: Array, multipliers: Array, iterations: int
    ) -> Nearest:
        """The solution made exact from active bounds, those that multipliers tell; FAILED where that does not end."""
        v = self._v
        better = refined(*self._squares(optimum, v), lower, upper, multipliers)
        if better is None:
            return Nearest(None, np.inf, None, QPStatus.FAILED, iterations)
        moves = better.z[v:]
        delta = self._R.dot(moves) - self._R.dot(optimum)
        limited = self._limited
        excess, violated = float(delta.dot(delta)), bool(limited and better.z[:limited].max() > 0)
        if violated or v > limited:
            excess += self._cost.of(better.z[:v])
        return Nearest(moves, excess, better.multipliers, QPStatus.OPTIMAL, iterations, violated)

    def relaxed(self, distances: Array, multipliers: Array) -> tuple[Array, Array]:
        """The optima with limits priced by multipliers: their delta, and their cost beyond that of the one without.

        Multipliers of shape (..., v + b), `distances` of the bounds, as `distances` gives them.
        """
        pull, v, (low, high) = multipliers / self.even, self._v, distances.reshape(2, -1)
        gradient = pull.dot(self._every)
        gradient += self._f
        square = 0.25 * _products(gradient, gradient)
        kept = _products(pull, np.where(pull > 0, high, low))
        # Where moves are nearly the same, squares far above the cost cancel each other: no bound may gain by that.
        lost = gradient.shape[-1] * ROUNDING * (square + abs(kept))
        return -0.5 * gradient[..., v:], -square - kept - lost

    def distances(self, optimum: Array, bounds: Array) -> Array:
        """The bounds, lower ones and behind them upper ones, as distances from the optimum."""
        even, rows = self._of_both
        distances = bounds * even
        distances -= rows.dot(optimum)
        return distances

    @cached_property
    def _of_both(self) -> tuple[Array, Array]:
        """Factors of lower and upper bounds, and how much nearer both come per move."""
        rows = np.vstack([np.zeros((self._v, len(self._R))), self.even_rows])
        return np.concatenate([self.even, self.even]), np.vstack([rows, rows])

    def _far(self, low: Array, high: Array) -> float:
        """How far the optimum is from what it should keep; not above zero where it keeps all bounds."""
        if len(low) == self._v:  # no bounds but those of the violations, which begin at zero
            return 0.0
        return max(float(low[low.argmax()]), -float(high[high.argmin()]))


def _products(a: Array, b: Array) -> Array:
    """Scalar products of vectors along the last axis, one or many."""
    products: Array = a.dot(b) if a.ndim == 1 else np.einsum("...i,...i->...", a, b)
    return products
