"""Courses of inputs on levels, decided in the order of time, and the moves that they may make next."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import KEPT, SMALLER
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.condensing import CondensedQP
from mampc.program.levels import InputLevels, Timing
from mampc.program.sample import Indices, Sample

TOGETHER = 4096  # children of nodes that are treated at once
LONG_AGO = -1_000_000  # samples


class Past(NamedTuple):
    """What timings look back on: the sample of each input's last move (m,), and of starts so far, from -1 downwards."""

    last: Indices
    starts: tuple[Indices, ...]


def past_of(inputs: Array, levels: InputLevels, input_prefix: Array) -> Past:
    """What the applied inputs, shape (h, m) with the latest last, mean for timings."""
    changes = np.diff(inputs, axis=0)[::-1]
    moved = np.abs(changes) > KEPT * input_prefix
    last = (
        np.where(moved.any(axis=0), -1 - moved.argmax(axis=0), LONG_AGO)
        if len(moved)
        else np.full(inputs.shape[1], LONG_AGO)
    )
    starts = tuple(
        np.zeros(0, dtype=np.intp)
        if timing is None or timing.most is None
        else -1 - np.flatnonzero(moved[:, a] & (changes[:, a] * (timing.on - timing.off) > 0))
        for a, timing in enumerate(levels.timings)
    )
    return Past(last, starts)


class Found(NamedTuple):
    """The best course found: its moves, shape (n_moves,), or None; no course left out costs less than `bound`."""

    moves: Array | None
    objective: float
    bound: float
    complete: bool
    visited: int


class Courses(NamedTuple):
    """Nodes: courses decided up to some move; K of them.

    Attributes:
        d: moves decided, others zero, shape (K, n_moves).
        u: inputs after them, shape (K, m).
        rest: t - L d of each least-squares problem, shape (K, problems, k).
        cost: squares of the rows decided, shape (K, problems).
        charge, used: prices and moves of the budget so far, shape (K,).
        now: moves at the sample that is being decided, shape (K,).
        last: sample of each input's last move, shape (K, m).
        excess: scaled violation of each output so far, shape (K, outputs).
        bound: shape (K,).
    """

    d: Array
    u: Array
    rest: Array
    cost: Array
    charge: Array
    used: Array
    now: Array
    last: Indices
    excess: Array
    bound: Array

    def take(self, rows: Indices | BoolArray | slice) -> Courses:
        return Courses._make([part[rows] for part in self])


class NextMoves:
    """Of one sample.

    Args:
        condensed, admissible, levels: the problem, its rules, and the levels of its inputs.
        sample: its limits.
        allowance: what rules allow.
        past: what timings look back on.
    """

    def __init__(
        self,
        condensed: CondensedQP,
        admissible: AdmissiblePatterns,
        levels: InputLevels,
        sample: Sample,
        allowance: Allowance,
        past: Past,
    ) -> None:
        m = self._m = admissible.n_inputs
        self._rules, self._levels, self._allowance, self._past = admissible, levels, allowance, past
        shape = (admissible.control_horizon, m)
        limits, bounds_now = condensed.problem.limits, sample.bounds_now
        if bounds_now is None:
            low, high = np.tile(limits.u_min, (shape[0], 1)), np.tile(limits.u_max, (shape[0], 1))
        else:
            low, high = bounds_now.low + sample.u_previous, bounds_now.high + sample.u_previous
        kept = KEPT * condensed.input_prefix + 1e-14 * np.abs(sample.u_previous)
        self._low, self._high = low - kept, high + kept
        simple = slice(condensed.n_violations, condensed.bounds.n_simple)
        most = sample.upper[simple] if condensed.bounds.every_move else np.full(condensed.n_moves, np.inf)
        self.du_max, self._min_size = most + np.tile(kept, shape[0]), admissible.min_size
        self._small = SMALLER * condensed.move_prefix

    def within(self, a: int, first: int, end: int | None, values: Array) -> BoolArray:
        """Which values input a may have from sample `first` to before `end`, shape (values,)."""
        low, high = self._low[first:end, a], self._high[first:end, a]
        return np.asarray((values >= low.max(initial=-np.inf)) & (values <= high.min(initial=np.inf)))

    def same(self, a: int, values: Array, value: float) -> BoolArray:
        """Which values of input a are one value but for rounding, shape (values,)."""
        return np.asarray(np.abs(values - value) <= self._small[a])

    def allows(self, move: int, size: Array) -> BoolArray:
        """Whether a move may be of these sizes."""
        least = self._min_size[move] - self._small[move]
        return np.asarray((size > self._small[move]) & (size <= self.du_max[move]) & (size >= least))

    def staying(self, j: int, a: int, nodes: Courses) -> Indices:
        """The nodes that may leave input a at sample j where it is."""
        u = nodes.u[:, a]
        return np.flatnonzero((u >= self._low[j, a]) & (u <= self._high[j, a]))

    def _may_move(self, j: int, a: int, nodes: Courses) -> BoolArray:
        """Which nodes may move input a at sample j."""
        rules, allowance = self._rules, self._allowance
        may: BoolArray = np.full(len(nodes.bound), j >= allowance.frozen[a])
        if rules.per_step < self._m:
            may &= nodes.now < rules.per_step
        if rules.rules.max_moves is not None:
            counted = 1 if not rules.simultaneous else (nodes.now == 0).astype(int)
            may &= nodes.used + counted <= allowance.left
        since = j - nodes.last[:, a]
        if rules.rules.dwell > 1:
            may &= (since >= rules.rules.dwell) | (nodes.last[:, a] < 0)
        timing = self._levels.timings[a]
        if timing is not None:
            may &= self._is_due(timing, j, a, nodes, since)
        return may

    def _is_due(self, timing: Timing, j: int, a: int, nodes: Courses, since: Indices) -> BoolArray:
        is_on = np.abs(nodes.u[:, a] - timing.on) < np.abs(nodes.u[:, a] - timing.off)
        due: BoolArray = since >= np.where(is_on, timing.min_on, timing.min_off)
        if timing.most is not None:
            first = j - timing.window + 1
            starts = np.count_nonzero(self._past.starts[a] >= first)
            made = nodes.d[:, a :: self._m][:, max(first, 0) : j] * (timing.on - timing.off) > 0
            due &= is_on | (starts + made.sum(axis=1) < timing.most)
        return due

    def levels_within(
        self, j: int, a: int, nodes: Courses, centre: Array, room: Array, nearest: int | None
    ) -> tuple[Indices, Array, int]:
        """Nodes and the levels that input a may move to at sample j; the first node that has to wait.

        Within `room` of `centre`, both of shape (K,); with `nearest` only so many of each.
        """
        values, move = self._levels.values[a], j * self._m + a
        assert values is not None
        values = values[self.within(a, j, j + 1, values)]
        rows, index, waiting = windows(values, centre, room, nearest, self._may_move(j, a, nodes))
        chosen = values[index]
        kept = self.allows(move, np.abs(chosen - nodes.u[rows, a]))
        return rows[kept], chosen[kept], waiting


def windows(
    values: Array,
    centre: Array,
    room: Array,
    nearest: int | None,
    may: BoolArray | None = None,
    together: int = TOGETHER,
) -> tuple[Indices, Indices, int]:
    """Nodes and indices of values, which are in order, within `room` of `centre`; the first node that has to wait.

    Both of shape (K,); with `nearest` only so many values of each node, and none of those that may not, shape (K,).
    Else about so many values `together`.
    """
    most, count = len(values), len(centre)
    first = np.searchsorted(values, centre - room)
    end = np.maximum(np.searchsorted(values, centre + room, side="right"), first)
    if nearest is not None:
        at = np.searchsorted(values, centre)
        first = np.minimum(np.maximum(first, np.minimum(at - nearest // 2 - 1, most - nearest)), end)
        end = np.minimum(end, np.maximum(first, first + nearest))
    counts = end - first if may is None else np.where(may, end - first, 0)
    totals = np.cumsum(counts + 1)
    waiting = count if nearest is not None else max(1, int(np.searchsorted(totals, together, side="right")))
    waiting = min(waiting, count)
    counts = counts[:waiting]
    rows = np.repeat(np.arange(waiting), counts)
    offset = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    return rows, first[rows] + offset, waiting
