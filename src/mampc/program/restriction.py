"""The problem with the moves of one pattern alone: all others are zero."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.bounds import Bounds
from mampc.program.least_distance import LeastDistance, Nearest
from mampc.program.sample import Indices


class Restriction:
    """The least-squares problem |U d - target|^2 with d zero off a pattern, with and without limits.

    Input rows at samples where that input does not move repeat earlier ones and are left out.

    Attributes:
        n_violations: of `Bounds`.
        moves: the moves of the pattern, in order, shape (k,).
        bounds: the bounds that are kept, shape (kept,); those of the violations come first.
        rows: bounded quantities per move, violations left out, shape (kept - violations, k).
        violations: the same per violation.
        R: triangular factor of the cost in these moves, shape (k, k).
        reached, missed: orthonormal rows: what the moves can reach of the target, and what not.
        bytes: about the memory it takes, its solver included.

    Args:
        U, bounds: of `CondensedQP`.
        pattern: shape (n_moves,).
        time_limit: seconds that one program may take; None for no limit.
    """

    def __init__(self, U: Array, bounds: Bounds, pattern: BoolArray, time_limit: float | None = None) -> None:
        v = self.n_violations = bounds.n_violations
        n_simple = bounds.n_simple
        self.moves, self._n_bounds, self._cost = np.flatnonzero(pattern), bounds.size, bounds.violation_cost
        move = bounds.move_of_bound
        kept = np.where(move < 0, True, pattern[np.maximum(move, 0)])
        kept[v:n_simple] = pattern[: n_simple - v]
        self.bounds: Indices = np.flatnonzero(kept)
        self.rows = bounds.of_moves[self.bounds[v:] - v][:, self.moves]
        self._n_simple = simple = int(np.count_nonzero(kept[:n_simple])) - v
        violations = bounds.rows[self.bounds[v + simple :] - n_simple, :v]
        self.violations = np.vstack([np.zeros((simple, v)), violations])
        self._time_limit = time_limit
        k = len(self.moves)
        if k == len(U):
            self.R, Q = U, np.eye(k)
        else:
            Q, R = np.linalg.qr(U[:, self.moves], mode="complete")
            self.R = R[:k]
        self.reached, self.missed = Q[:, :k].T, Q[:, k:].T
        self._optimum = np.linalg.solve(self.R, self.reached)
        self.bytes = 4 * (self.rows.nbytes + 20 * len(self.rows)) + 2 * Q.nbytes

    def optimum(self, target: Array) -> Array:
        """The best moves without limits, shape (k,)."""
        moves: Array = self._optimum.dot(target)
        return moves

    def excess(self, target: Array) -> float:
        """What they cost more than the optimum of all moves."""
        missed = self.missed.dot(target)
        return float(missed.dot(missed))

    @cached_property
    def program(self) -> LeastDistance:
        """Its program within the bounds that are kept."""
        return LeastDistance(
            self.R, self.rows, self.violations, self._cost,
            n_simple=self._n_simple, time_limit=self._time_limit,
        )  # fmt: skip

    def solve(self, optimum: Array, lower: Array, upper: Array) -> Nearest:
        """The best moves within limits.

        Args:
            optimum: `optimum` of the sample.
            lower, upper: the bounds that are kept.

        Returns:
            As `LeastDistance`, multipliers being those of all bounds, shape (n_bounds,).
        """
        return self._of_all_bounds(self.program.solve(optimum, lower, upper))

    def nearest(self, target: Array, bounds: Array, cutoff: float = np.inf) -> Nearest:
        """The best moves within limits, if they cost less than the cutoff, with what they cost more than all moves do.

        Args:
            target: of the sample.
            bounds: all lower bounds, and behind them all upper ones, shape (2 n_bounds,).
        """
        k = len(self.moves)
        of_target, which, even = self._of_sample
        values, given = of_target.dot(target), bounds if which is None else bounds.take(which)
        missed, distances = values[k : len(target)], given * even
        distances -= values[len(target) :]
        excess = float(missed.dot(missed)) if len(missed) else 0.0
        nearest = self.program.solve_at(values[:k], distances, given, None, cutoff - excess)
        return self._of_all_bounds(nearest, excess)

    @cached_property
    def _of_sample(self) -> tuple[Array, Indices | None, Array]:
        """What `nearest` needs: optimum, missed, twice the even rows per target; which bounds, if not all; factors."""
        even, every = self.program.even, len(self.bounds) == self._n_bounds
        rows = np.vstack(
            [np.zeros((self.n_violations, len(self.missed.T))), self.program.even_rows @ self._optimum]
        )
        return (
            np.vstack([self._optimum, self.missed, rows, rows]),
            None if every else np.concatenate([self.bounds, self._n_bounds + self.bounds]),
            np.concatenate([even, even]),
        )

    def _of_all_bounds(self, nearest: Nearest, excess: float = 0.0) -> Nearest:
        """The answer with multipliers of all bounds, and the excess counted from elsewhere."""
        moves, own, pulls, status, iterations, violated = nearest
        if pulls is None or len(pulls) == self._n_bounds:
            return nearest._replace(excess=own + excess) if excess else nearest
        multipliers = np.zeros(self._n_bounds)
        multipliers[self.bounds] = pulls
        return Nearest(moves, own + excess, multipliers, status, iterations, violated)


def by_count(patterns: BoolArray) -> Iterator[tuple[Indices, Indices]]:
    """Which patterns have equally many moves, and what these are: shapes (r,) and (r, k), for each k that occurs."""
    counts = patterns.sum(axis=1)
    for k in np.unique(counts).tolist():
        which = np.flatnonzero(counts == k)
        yield which, np.nonzero(patterns[which])[1].reshape(len(which), k)


def excess_table(U: Array, patterns: BoolArray) -> Array:
    """What optima on patterns cost more than the optimum d* of all moves, no limits given.

    Args:
        U: of `CondensedQP`, its columns scaled as d* is.
        patterns: shape (K, n_moves).

    Returns:
        Shape (K, n_moves (n_moves + 1) / 2): to be multiplied by the products d*_i d*_k, i <= k, of `np.triu_indices`.
    """
    rows, columns = np.triu_indices(U.shape[1])
    doubled = np.where(rows == columns, 1.0, 2.0)
    table = np.empty((len(patterns), len(rows)))
    for which, moves in by_count(patterns):
        Q = np.linalg.qr(U[:, moves].transpose(1, 0, 2), mode="complete")[0]
        missed = Q[:, :, moves.shape[1] :].transpose(0, 2, 1)
        V = missed @ np.where(patterns[which][:, None, :], 0.0, U)
        table[which] = (V.transpose(0, 2, 1) @ V)[:, rows, columns] * doubled
    return table
