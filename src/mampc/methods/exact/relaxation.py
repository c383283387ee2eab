"""Relaxations of the sparse problem that are quadratic programs: every move within an interval, at a price per unit.

A move that costs p unless it is zero, and is at most M, costs at least p |d| / M. With the signs of the moves known
that is linear; a sign that the program contradicts is turned round and the program solved again. Any multipliers
give a valid bound, so that a few rounds do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import active_bounds
from mampc.program.least_distance import LeastDistance
from mampc.program.qp import UNBOUNDED, QPStatus
from mampc.program.sample import Indices, Sample

ROUNDS = 6  # of turning signs
INFEASIBLE = (QPStatus.INFEASIBLE, QPStatus.BAD_DATA)  # data are finite here: bad ones are bounds that cross


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
        return self.status in INFEASIBLE

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

        None is solved after the deadline, of `perf_counter`.
        """
        return SampleRelaxation(self, sample, optimum, deadline)


class Start(NamedTuple):
    """Where a program starts: active bounds, or None for none, and the signs of its moves, shape (n,)."""

    active: Array | None
    signs: Array


class RelaxedMany(NamedTuple):
    """K relaxed programs, as `Multipliers` has one; rows, pulls and moves are zero without an answer.

    Attributes:
        status: K of them.
        rows: shape (K, bounds).
        pulls, moves: shape (K, n).
        starts: for programs alike, K of them.
    """

    status: list[QPStatus]
    rows: Array
    pulls: Array
    moves: Array
    starts: list[Start]

    @property
    def solved(self) -> BoolArray:
        return np.array([status is QPStatus.OPTIMAL for status in self.status])

    @property
    def infeasible(self) -> BoolArray:
        return np.array([status in INFEASIBLE for status in self.status])

    @property
    def out_of_time(self) -> bool:
        return QPStatus.TIME_LIMIT in self.status

    @property
    def without_answer(self) -> list[int]:
        """The programs that may have an answer which was not found."""
        return [k for k, status in enumerate(self.status) if status not in (QPStatus.OPTIMAL, *INFEASIBLE)]


def alone(found: Multipliers, start: Start) -> RelaxedMany:
    """One relaxed program as one of many."""
    return RelaxedMany([found.status], found.rows[None], found.pulls[None], found.moves[None], [start])


class SampleRelaxation:
    """The relaxed programs of one sample.

    Attributes:
        start: of the next single program: the last one's end.
    """

    def __init__(self, of: Relaxation, sample: Sample, optimum: Array, deadline: float) -> None:
        self._of, self._optimum, self._deadline = of, optimum, deadline
        v, n_simple, none = of.moves.start, of.n_simple, np.zeros(len(optimum))
        self._lower = np.concatenate((sample.lower[:v], none, sample.lower[n_simple:]))
        self._upper = np.concatenate((sample.upper[:v], none, sample.upper[n_simple:]))
        self._distances = of.program.distances(optimum, np.concatenate((self._lower, self._upper)))
        self.start = Start(None, np.where(optimum < 0, -1.0, 1.0))

    def solve(self, low: Array, high: Array) -> Multipliers:
        """With the moves between low and high, shape (n,)."""
        none = np.zeros(len(low))
        return self.solve_priced(low, high, none, none)

    def solve_priced(self, low: Array, high: Array, up: Array, down: Array) -> Multipliers:
        """The same at a price per unit up and one per unit down, shape (n,)."""
        found = self.solve_many(low[None], high[None], up[None], down[None], [self.start])
        self.start = found.starts[0]
        return Multipliers(found.rows[0], found.pulls[0], low < high, found.moves[0], found.status[0])

    def solve_many(self, low: Array, high: Array, up: Array, down: Array, starts: list[Start]) -> RelaxedMany:
        """The same for K programs at once, all of shape (K, n). Past the deadline no more are solved."""
        program, own, K = self._of.program, self._of.moves, len(low)
        status, active = [QPStatus.TIME_LIMIT] * K, [start.active for start in starts]
        multipliers, moves = np.zeros((K, len(program.even))), np.zeros(low.shape)
        priced, sign = (up > 0) | (down > 0), np.array([start.signs for start in starts])
        sign = np.where(low >= 0, 1.0, np.where(high <= 0, -1.0, sign))
        pulls, rows = np.zeros(low.shape), np.arange(K)
        for _ in range(ROUNDS):
            upwards, downwards = priced[rows] & (sign[rows] > 0), priced[rows] & (sign[rows] < 0)
            least, most = low[rows], high[rows]
            slope = np.where(upwards, up[rows], np.where(downwards, -down[rows], 0.0))
            optima, distances, bounds = self._data(
                np.where(upwards, np.maximum(least, 0.0), least),
                np.where(downwards, np.minimum(most, 0.0), most),
                slope,
            )
            found = program.solve_each(
                optima, distances, bounds, [active[row] for row in rows], self._deadline
            )
            solved = np.array([ended is QPStatus.OPTIMAL for ended in found.status])
            multipliers[rows[solved]], moves[rows[solved]] = found.multipliers[solved], found.moves[solved]
            flags = active_bounds(found.multipliers)
            for k, row in enumerate(rows.tolist()):
                if solved[k]:
                    status[row], active[row] = QPStatus.OPTIMAL, flags[k]
                elif status[row] is not QPStatus.OPTIMAL and found.status[k] is not QPStatus.TIME_LIMIT:
                    status[row], active[row] = found.status[k], None
            pull = multipliers[rows, own] + slope
            pulls[rows[solved]] = pull[solved]
            # At zero the price of the other direction has to hold the move there too.
            turned = upwards & (pull < -down[rows]) & (least < 0)
            turned |= downwards & (pull > up[rows]) & (most > 0)
            turned &= solved[:, None]
            sign[rows] = np.where(turned, -sign[rows], sign[rows])
            rows = rows[turned.any(axis=1)]
            if not len(rows):
                break
        multipliers[:, own] = 0.0
        ends = [Start(*end) for end in zip(active, sign, strict=True)]
        return RelaxedMany(status, multipliers, pulls, moves, ends)

    def _data(self, low: Array, high: Array, slope: Array) -> tuple[Array, Array, Array]:
        """Optima, distances and bounds of programs at these slopes of the cost, as `solve_at` takes them."""
        of, even = self._of, self._of.program.even
        optima = self._optimum - 0.5 * ((slope @ of.inverse) @ of.inverse.T)
        bounds = np.empty((len(low), 2, len(even)))
        bounds[:, 0], bounds[:, 1] = self._lower, self._upper
        bounds[:, 0, of.moves], bounds[:, 1, of.moves] = low, high
        distances = bounds * even
        distances[:, :, of.moves.start :] -= (optima @ of.program.even_rows.T)[:, None]
        return optima, distances.reshape(len(low), -1), bounds.reshape(len(low), -1)

    def priced(self, rows: Array, pulls: Array) -> tuple[Array, Array]:
        """What multipliers of rows and pulls at the moves, (..., n), add to the target and to the least cost."""
        multipliers = rows.copy()
        multipliers[..., self._of.moves] = pulls
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
