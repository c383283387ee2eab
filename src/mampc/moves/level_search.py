"""The search over courses of inputs on levels, in the order of time (sphere decoding).

With L the lower triangular factor of the cost, |U d - target|^2 = |L d - t|^2 + what d cannot reach: row p of L holds
no move later than p. So a node, which has decided the moves up to some p, costs at least the squares of its rows
so far, whatever follows; its children are the levels that keep their own square within what the best plan leaves,
and to stay. Moves of inputs without levels stand before all others in the factor: they are free until the levels of
all others are decided, and a program finds them then.

Limits of outputs come in twice: by multipliers, which make another least-squares problem that no course undercuts, so
that a node has the larger of two bounds; and by what the moves decided make of the outputs up to there.

Source of the enumeration: Agrell, Eriksson, Vardy, Zeger: Closest point search in lattices, IEEE Transactions on
Information Theory 48 (2002).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple, TypeAlias

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import KEPT, SMALLER, tie
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.level_outputs import LimitedOutputs, ZonedOutputs
from mampc.program.condensing import CondensedQP
from mampc.program.levels import InputLevels, Timing
from mampc.program.sample import Indices, LeastSquares, Sample

TOGETHER = 4096  # children of nodes that are treated at once
BEAM = 32  # nodes of each move that the first plan is looked for among
NEAREST = 5  # levels that it tries for each
CACHE_BYTES = 64e6  # for the factors of recent patterns
LONG_AGO = -1_000_000  # samples


# The best moves where those of inputs with levels are given, shape (n_moves,), and what they cost; None for none.
Completion: TypeAlias = Callable[[Array], tuple[Array, float] | None]


class Found(NamedTuple):
    """The best course found: its moves, shape (n_moves,), or None; no course left out costs less than `bound`."""

    moves: Array | None
    objective: float
    bound: float
    complete: bool
    visited: int


class Factor(NamedTuple):
    """The cost in some moves.

    Attributes:
        moves: those of inputs with levels, in order, shape (k,).
        free: those of the others, shape (q,).
        L: lower triangular, shape (k, k).
        reached: rows that make t of the target, shape (k, n_moves).
        missed: rows that no move reaches, shape (n_moves - k - q, n_moves).
    """

    moves: Indices
    free: Indices
    L: Array
    reached: Array
    missed: Array


class Past(NamedTuple):
    """What timings look back on: the sample of each input's last move (m,), and of starts so far, from -1 downwards."""

    last: Indices
    starts: tuple[Indices, ...]


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


class LevelSearch:
    """The courses of inputs on levels of one problem.

    Args:
        condensed, admissible: the problem and its rules.
        levels: of the inputs.

    Attributes:
        on_levels: the moves of inputs with levels, shape (n_moves,).
    """

    def __init__(self, condensed: CondensedQP, admissible: AdmissiblePatterns, levels: InputLevels) -> None:
        self.condensed, self.admissible, self.levels = condensed, admissible, levels
        self.on_levels = np.tile([values is not None for values in levels.values], admissible.control_horizon)
        self._factors: OrderedDict[bytes, Factor] = OrderedDict()
        limited = len(condensed.bounds.above) + len(condensed.bounds.below) > 0 and bool(self.on_levels.all())
        self.outputs = LimitedOutputs(condensed) if limited else None
        zoned = condensed.bounds.zones is not None and bool(self.on_levels.all())
        self.zones = ZonedOutputs(condensed) if zoned else None

    def past(self, inputs: Array) -> Past:
        """What the applied inputs, shape (h, m) with the latest last, mean for timings."""
        changes = np.diff(inputs, axis=0)[::-1]
        moved = np.abs(changes) > KEPT * self.condensed.input_prefix
        last = (
            np.where(moved.any(axis=0), -1 - moved.argmax(axis=0), LONG_AGO)
            if len(moved)
            else np.full(inputs.shape[1], LONG_AGO)
        )
        starts = tuple(
            np.zeros(0, dtype=np.intp)
            if timing is None or timing.most is None
            else -1 - np.flatnonzero(moved[:, a] & (changes[:, a] * (timing.on - timing.off) > 0))
            for a, timing in enumerate(self.levels.timings)
        )
        return Past(last, starts)

    def factor(self, pattern: BoolArray) -> Factor:
        """The cost in the moves of a pattern, shape (n_moves,)."""
        key = pattern.tobytes()
        kept = self._factors.get(key)
        if kept is None:
            moves, free = (
                np.flatnonzero(pattern & self.on_levels),
                np.flatnonzero(pattern & ~self.on_levels),
            )
            U = self.condensed.U
            Q, R = np.linalg.qr(U[:, np.concatenate([free, moves[::-1]])], mode="complete")
            q, k = len(free), len(moves)
            kept = Factor(moves, free, R[q : q + k, q:][::-1, ::-1], Q[:, q : q + k].T[::-1], Q[:, q + k :].T)
            self._factors[key] = kept
            if len(self._factors) > CACHE_BYTES / (16 * U.size):
                self._factors.popitem(last=False)
        return kept

    def search(
        self,
        sample: Sample,
        pattern: BoolArray,
        allowance: Allowance,
        past: Past,
        *,
        priced: LeastSquares | None = None,
        completed: Completion | None = None,
        cutoff: float = np.inf,
        deadline: float = np.inf,
        most: float = np.inf,
    ) -> Found:
        """The best course with moves on the pattern, shape (n_moves,), alone.

        Args:
            allowance: what rules allow beside the pattern.
            past: of `past`.
            priced: the problem with limits priced in, which bounds courses too.
            completed: where the pattern has moves of inputs without levels.
            cutoff: courses that cost as much are of no interest.
            deadline: of `perf_counter`.
            most: nodes to visit.
        """
        one = _OneSample(self, sample, self.factor(pattern), allowance, past, priced, completed, cutoff)
        return one.run(deadline, most)


class _OneSample:
    """The search of one sample."""

    def __init__(
        self,
        of: LevelSearch,
        sample: Sample,
        factor: Factor,
        allowance: Allowance,
        past: Past,
        priced: LeastSquares | None,
        completed: Completion | None,
        cutoff: float,
    ) -> None:
        condensed, admissible = of.condensed, of.admissible
        m = self._m = admissible.n_inputs
        self._of, self._rules, self._sample, self._factor = of, admissible, sample, factor
        self._allowance, self._past, self._condensed = allowance, past, condensed
        self._outputs, self._zones, self._completed = of.outputs, of.zones, completed
        self._room = None if of.outputs is None else of.outputs.room(sample)
        self._best: Array | None = None
        self._objective, self._rounding = cutoff, condensed.rounding(sample)
        shape = (admissible.control_horizon, m)
        limits, bounds_now = condensed.problem.limits, sample.bounds_now
        if bounds_now is None:
            self._low, self._high = np.tile(limits.u_min, (shape[0], 1)), np.tile(limits.u_max, (shape[0], 1))
        else:
            self._low, self._high = bounds_now.low + sample.u_previous, bounds_now.high + sample.u_previous
        kept = KEPT * condensed.input_prefix + 1e-14 * np.abs(sample.u_previous)
        self._low, self._high = self._low - kept, self._high + kept
        simple = slice(condensed.n_violations, condensed.bounds.n_simple)
        most = sample.upper[simple] if condensed.bounds.every_move else np.full(condensed.n_moves, np.inf)
        self._du_max, self._min_size = most + np.tile(kept, shape[0]), admissible.min_size
        self._small = SMALLER * condensed.move_prefix
        # Moves of inputs without levels are given by the pattern, and paid.
        self._now = np.bincount(factor.free // m, minlength=shape[0])
        self._used = int((self._now > 0).sum()) if admissible.simultaneous else len(factor.free)
        self._charge = admissible.charge(np.isin(np.arange(condensed.n_moves), factor.free))
        self._few = admissible.priced or admissible.rules.max_moves is not None
        self._few &= not (admissible.simultaneous and self._used)
        squares = [sample.least_squares] + ([] if priced is None else [priced])
        self._t = np.array([factor.reached @ one.target for one in squares])
        missed = np.array([factor.missed @ one.target for one in squares])
        self._base = np.array([one.least for one in squares]) + np.square(missed).sum(axis=1)
        # Fixed inputs: those of the pattern may stay only where limits let them, so that each sample is looked at once.
        order = {int(move): p for p, move in enumerate(factor.moves)}
        self._steps = [(move, order.get(move, -1)) for move in range(condensed.n_moves) if of.on_levels[move]]

    @property
    def _cutoff(self) -> float:
        return self._objective - tie(self._objective, self._rounding)

    def run(self, deadline: float, most: float) -> Found:
        pending, visited = [(0, self._root())], 0
        self._look_ahead(pending[0][1], deadline)
        while pending:
            if perf_counter() > deadline or visited > most:
                open_ = min(float(nodes.bound.min(initial=np.inf)) for _, nodes in pending)
                return Found(self._best, self._objective, min(open_, self._objective), False, visited)
            step, nodes = pending.pop()
            nodes = nodes.take(nodes.bound < self._cutoff)
            if not len(nodes.bound):
                continue
            children, left = self._children(step, nodes)
            if left is not None:
                pending.append((step, left))
            visited += len(children.bound)
            if step + 1 < len(self._steps):
                pending.append((step + 1, children.take(np.argsort(children.bound, kind="stable"))))
            else:
                self._finish(children, deadline)
        return Found(self._best, self._objective, self._objective, True, visited)

    def _look_ahead(self, nodes: Courses, deadline: float) -> None:
        """A first plan, by the best few nodes of each move."""
        for step in range(len(self._steps)):
            nodes = self._children(step, nodes, NEAREST)[0]
            if len(nodes.bound) > BEAM:
                nodes = nodes.take(np.argpartition(nodes.bound, BEAM)[:BEAM])
            if not len(nodes.bound):
                return
        self._finish(nodes, deadline)

    def _root(self) -> Courses:
        u = self._sample.u_previous
        excess: Array = np.zeros((1, 0))
        if self._outputs is not None and self._room is not None:
            at_once = self._outputs.last < 0
            excess = self._outputs.excess(
                np.zeros((1, self._condensed.n_moves)), self._room, at_once, self._outputs.none(1)
            )
        root = Courses(
            np.zeros((1, self._condensed.n_moves)), u[None].copy(), self._t[None].copy(), self._base[None].copy(),
            np.full(1, self._charge), np.full(1, self._used), np.zeros(1, dtype=int),
            self._past.last[None].copy(), excess, np.zeros(1),
        )  # fmt: skip
        if self._zones is not None:
            root.cost[:, 0] += self._zones.cost(root.d, self._sample, self._zones.last < 0)
        root = self._bounded(root)
        return self._with_few_more(0, root) if self._few else root

    def _bounded(self, nodes: Courses) -> Courses:
        own = nodes.cost[:, 0]
        if self._outputs is not None:
            own = own + self._outputs.penalty(nodes.excess)
        return nodes._replace(bound=np.maximum(own, nodes.cost.max(axis=1)) + nodes.charge)

    def _children(
        self, step: int, nodes: Courses, nearest: int | None = None
    ) -> tuple[Courses, Courses | None]:
        """What nodes lead to by one move, as far as it may beat the best plan, and the nodes that have to wait."""
        move, p = self._steps[step]
        j, a = divmod(move, self._m)
        if step == 0 or self._steps[step - 1][0] // self._m != j:
            nodes = nodes._replace(now=np.full_like(nodes.now, self._now[j]))
        u, low, high = nodes.u[:, a], self._low[j, a], self._high[j, a]
        stays = np.flatnonzero((u >= low) & (u <= high))
        rows: Indices = np.zeros(0, dtype=np.intp)
        values: Array = np.zeros(0)
        left = None
        if p >= 0:
            may = self._may_move(j, a, nodes)
            rows, values, first_left = self._levels_within(p, a, j, nodes, may, nearest)
            if first_left < len(nodes.bound):
                left, stays = nodes.take(slice(first_left, None)), stays[stays < first_left]
        children = nodes.take(np.concatenate([stays, rows]))
        d = np.concatenate([np.zeros(len(stays)), values - u[rows]])
        if p >= 0:
            rest = children.rest
            if len(rows):
                rest = rest - d[:, None, None] * self._factor.L[:, p]
            own = rest[:, :, p]
            children = children._replace(rest=rest, cost=children.cost + own * own)
        if len(rows):
            moved = slice(len(stays), None)
            children.d[moved, move] = d[moved]
            children.u[moved, a] = values
            children.last[moved, a] = j
            counted = 1 if not self._rules.simultaneous else (children.now[moved] == 0).astype(int)
            children.used[moved] += counted
            children.charge[moved] += self._rules.price[a] * counted
            children.now[moved] += 1
        last_of_sample = step + 1 == len(self._steps) or self._steps[step + 1][0] // self._m != j
        if self._outputs is not None and self._room is not None and last_of_sample:
            known = self._outputs.last == j
            if known.any():
                children = children._replace(
                    excess=self._outputs.excess(children.d, self._room, known, children.excess)
                )
        if self._zones is not None and last_of_sample:
            children.cost[:, 0] += self._zones.cost(children.d, self._sample, self._zones.last == j)
        children = self._bounded(children)
        children = children.take(children.bound < self._cutoff)
        if p >= 0 and self._few and len(children.bound) and (last_of_sample or not self._rules.simultaneous):
            children = self._with_few_more(p + 1, children)
            children = children.take(children.bound < self._cutoff)
        return children, left

    def _with_few_more(self, p: int, nodes: Courses) -> Courses:
        """The nodes, which have decided p moves, bounded by what no move more, one, or two cost with their prices."""
        rules, L = self._rules, self._factor.L[p:, p:]
        rest = nodes.rest[:, :, p:]
        none = nodes.cost + np.square(rest).sum(axis=2)
        prices = rules.price[self._factor.moves[p:] % self._m]
        one = more = np.full_like(none, np.inf)
        if len(prices) and rules.simultaneous:
            one = more = nodes.cost + prices[0]
        elif len(prices):
            one = none + (prices - np.square(rest @ L) / np.square(L).sum(axis=0)).min(axis=2)
            more = nodes.cost + 2 * prices.min()
        left = (
            self._allowance.left - nodes.used if rules.rules.max_moves is not None else np.full(len(none), 2)
        )
        best = np.where(left[:, None] > 0, np.minimum(none, one), none)
        best = np.where(left[:, None] > 1, np.minimum(best, more), best)
        if self._outputs is not None:
            best[:, 0] += self._outputs.penalty(nodes.excess)
        return nodes._replace(bound=np.maximum(nodes.bound, best.max(axis=1) + nodes.charge))

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
        timing = self._of.levels.timings[a]
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

    def _levels_within(
        self, p: int, a: int, j: int, nodes: Courses, may: BoolArray, nearest: int | None
    ) -> tuple[Indices, Array, int]:
        """Nodes and levels that keep the row p within what the best plan leaves; the first node that has to wait."""
        values, L, move = self._of.levels.values[a], self._factor.L[p, p], self._factor.moves[p]
        assert values is not None
        u, count = nodes.u[:, a], len(nodes.bound)
        room = np.sqrt(np.maximum(self._cutoff - nodes.cost[:, 0] - nodes.charge, 0.0)) / abs(L)
        centre = u + nodes.rest[:, 0, p] / L
        least, most = (
            np.searchsorted(values, self._low[j, a]),
            np.searchsorted(values, self._high[j, a], side="right"),
        )
        first = np.clip(np.searchsorted(values, centre - room), least, most)
        end = np.clip(np.searchsorted(values, centre + room, side="right"), first, most)
        if nearest is not None:
            at = np.searchsorted(values, centre)
            first = np.minimum(np.maximum(first, np.minimum(at - nearest // 2 - 1, most - nearest)), end)
            end = np.minimum(end, np.maximum(first, first + nearest))
        counts = np.where(may, end - first, 0)
        totals = np.cumsum(counts + 1)
        waiting = (
            count if nearest is not None else max(1, int(np.searchsorted(totals, TOGETHER, side="right")))
        )
        waiting = min(waiting, count)
        counts = counts[:waiting]
        rows = np.repeat(np.arange(waiting), counts)
        offset = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        chosen = values[first[rows] + offset]
        size = np.abs(chosen - u[rows])
        kept = (size > self._small[move]) & (size <= self._du_max[move])
        kept &= size >= self._min_size[move] - self._small[move]
        return rows[kept], chosen[kept], waiting

    def _finish(self, courses: Courses, deadline: float) -> None:
        """Take the best of courses that are decided."""
        if not len(courses.bound):
            return
        for row in np.argsort(courses.bound, kind="stable").tolist():
            if courses.bound[row] >= self._cutoff or (self._best is not None and perf_counter() > deadline):
                return
            moves, objective = courses.d[row].copy(), float(courses.bound[row])
            if self._completed is not None:
                completed = self._completed(moves)
                if completed is None:
                    continue
                moves, objective = completed
            if objective < self._cutoff:
                self._best, self._objective = moves, objective
