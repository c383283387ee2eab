"""Relaxations of the sparse problem that are quadratic programs: every move within an interval, at a price per unit.

A move that costs p unless it is zero, and is at most M, costs at least p |d| / M. With the signs of the moves known
that is linear; a sign that the program contradicts is turned round and the program solved again. Any multipliers
give a valid bound, so that a few rounds do.
"""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import active_bounds
from mampc.program.least_distance import LeastDistance
from mampc.program.qp import UNBOUNDED, QPStatus
from mampc.program.sample import Indices, Sample

ROUNDS = 6  # of turning signs


class Multipliers(NamedTuple):
    """What the limits of a relaxed program cost, and its moves; nothing but the status without an answer.

    Attributes:
        rows: of the violations' and all rows' bounds, positive at upper bounds; none of single moves.
        pulls: of the intervals of single moves, their price per unit included, shape (n,).
        free: moves whose interval is more than one value, shape (n,).
        moves: shape (n,).
        status: how the program ended.
    """

    rows: Array
    pulls: Array
    free: BoolArray
    moves: Array
    status: QPStatus = QPStatus.OPTIMAL

    @property
    def active(self) -> bool:
        """Whether they are worth a term."""
        return bool(self.rows.any() or self.pulls[self.free].any())

    @property
    def infeasible(self) -> bool:
        """Whether no moves keep the limits."""
        # Data are finite here: bad ones are bounds that cross.
        return self.status in (QPStatus.INFEASIBLE, QPStatus.BAD_DATA)

    @property
    def solved(self) -> bool:
        return self.status is QPStatus.OPTIMAL


class Relaxation:
    """One solver for all of them, in the moves of `order` alone.

    Args:
        condensed: the problem.
        order: moves, shape (n,).
        factor: of the cost in these moves, shape (n, n).
        time_limit: seconds that one program may take; None for no limit.
    """

    def __init__(
        self, condensed: CondensedQP, order: Indices, factor: Array, time_limit: float | None = None
    ) -> None:
        bounds = condensed.bounds
        self.order, self.n_moves, self.n_simple = order, condensed.n_moves, bounds.n_simple
        n, v = len(order), bounds.n_violations
        self.moves = slice(v, v + n)
        self.inverse = np.linalg.inv(factor)
        self.program = LeastDistance(
            factor,
            np.vstack([np.eye(n), bounds.rows[:, v:][:, order]]),
            np.vstack([np.zeros((n, v)), bounds.rows[:, :v]]),
            bounds.violation_cost,
            n_simple=n,
            time_limit=time_limit,
        )

    def at(self, sample: Sample, optimum: Array, deadline: float = np.inf) -> SampleRelaxation:
        """Those of one sample, given the optimum without limits in these moves, shape (n,).

        No signs are turned after the deadline, of `perf_counter`.
        """
        return SampleRelaxation(self, sample, optimum, deadline)


class SampleRelaxation:
    """The relaxed programs of one sample; each starts from the active bounds of the last one."""

    def __init__(self, of: Relaxation, sample: Sample, optimum: Array, deadline: float) -> None:
        self._of, self._optimum, self._deadline = of, optimum, deadline
        v, n_simple, none = of.moves.start, of.n_simple, np.zeros(len(optimum))
        self._lower = np.concatenate((sample.lower[:v], none, sample.lower[n_simple:]))
        self._upper = np.concatenate((sample.upper[:v], none, sample.upper[n_simple:]))
        self._distances = of.program.distances(optimum, self._lower, self._upper)
        self._active: Array | None = None
        self._signs = np.where(optimum < 0, -1.0, 1.0)

    def solve(self, low: Array, high: Array) -> Multipliers:
        """With the moves between low and high, shape (n,)."""
        return self._solve(self._optimum, low, high)

    def solve_priced(self, low: Array, high: Array, up: Array, down: Array) -> Multipliers:
        """The same at a price per unit up and one per unit down, shape (n,)."""
        priced = (up > 0) | (down > 0)
        if not priced.any():
            return self.solve(low, high)
        sign, inverse, rounds = self._signs, self._of.inverse, ROUNDS
        while True:
            sign = np.where(low >= 0, 1.0, np.where(high <= 0, -1.0, sign))
            positive = sign > 0
            slope = np.where(positive, up, -down)
            found = self._solve(
                self._optimum - 0.5 * (inverse @ (slope @ inverse)),
                np.where(priced & positive, np.maximum(low, 0.0), low),
                np.where(priced & ~positive, np.minimum(high, 0.0), high),
            )
            if not found.solved:
                return found
            pulls = found.pulls + slope
            # At zero the price of the other direction has to hold the move there too.
            turned = priced & np.where(positive, (pulls < -down) & (low < 0), (pulls > up) & (high > 0))
            rounds -= 1
            if not rounds or not turned.any() or perf_counter() > self._deadline:
                self._signs = sign
                return found._replace(pulls=pulls, free=low < high)
            sign = np.where(turned, -sign, sign)

    def _solve(self, optimum: Array, low: Array, high: Array) -> Multipliers:
        lower, upper = self._lower.copy(), self._upper.copy()
        lower[self._of.moves], upper[self._of.moves] = low, high
        nearest = self._of.program.solve(optimum, lower, upper, self._active)
        if nearest.moves is None or nearest.multipliers is None:
            self._active, none = None, np.zeros(0)
            return Multipliers(none, none, none != 0, none, nearest.status)
        self._active, rows = active_bounds(nearest.multipliers), nearest.multipliers.copy()
        rows[self._of.moves] = 0.0
        return Multipliers(rows, nearest.multipliers[self._of.moves], low < high, nearest.moves)

    def priced(self, rows: Array, pulls: Array) -> tuple[Array, float]:
        """What multipliers of rows and pulls at the moves add to the target and to the least cost without limits."""
        multipliers = rows.copy()
        multipliers[self._of.moves] = pulls
        return self._of.program.relaxed(self._distances, multipliers)

    def of_bounds(self, multipliers: Array | None) -> Multipliers | None:
        """Multipliers of the problem's bounds, shape (n_bounds,), as those of a relaxation."""
        if multipliers is None:
            return None
        of = self._of
        v, n_simple, every = of.moves.start, of.n_simple, np.zeros(of.n_moves)
        every[: n_simple - v] = multipliers[v:n_simple]
        pulls = every[of.order]
        rows = np.concatenate((multipliers[:v], np.zeros(len(pulls)), multipliers[n_simple:]))
        return Multipliers(rows, pulls, pulls != 0, pulls)

    def with_moves(self, sample: Sample, free: BoolArray) -> Array | None:
        """Multipliers of the problem's bounds, shape (n_bounds,), with only the moves `free`, shape (n_moves,)."""
        of = self._of
        v, n_simple = of.moves.start, of.n_simple
        low, high = np.full(of.n_moves, -UNBOUNDED), np.full(of.n_moves, UNBOUNDED)
        low[: n_simple - v], high[: n_simple - v] = sample.lower[v:n_simple], sample.upper[v:n_simple]
        low, high = np.where(free, low, 0.0)[of.order], np.where(free, high, 0.0)[of.order]
        found = self.solve(low, high)
        if not found.solved:
            return None
        pulls = np.zeros(of.n_moves)
        pulls[of.order] = np.where(found.free, found.pulls, 0.0)
        return np.concatenate((found.rows[:v], pulls[: n_simple - v], found.rows[of.moves.stop :]))
