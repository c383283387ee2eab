"""The search over courses of inputs on levels, in the order of time (sphere decoding).

With L the lower triangular factor of the cost, |U d - target|^2 = |L d - t|^2 + what d cannot reach: row p of L holds
no move later than p. So a node, which has decided the moves up to some p, costs at least the squares of its rows
so far, whatever follows; its children are the levels that keep their own square within what the best plan leaves,
and to stay. Moves of inputs without levels stand before all others in the factor: they are free until the levels of
all others are decided, and a program finds them then.

Limits of outputs come in twice: by multipliers, which make another least-squares problem that no course undercuts, so
that a node has the larger of two bounds; and by what the moves decided make of the outputs up to there.

Where no rule looks at how a course begins, its end is decided first (see `last_first`); this search takes over where
what that finds goes beyond limits of outputs.

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
from mampc.base.tolerances import tie
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.courses import Courses, Found, NextMoves, Past, past_of
from mampc.moves.last_first import LastFirst, ValueFactor
from mampc.moves.level_outputs import LimitedOutputs, ZonedOutputs
from mampc.program.condensing import CondensedQP
from mampc.program.levels import InputLevels
from mampc.program.sample import Indices, LeastSquares, Sample

BEAM = 32  # nodes of each move that the first plan is looked for among
NEAREST = 5  # levels that it tries for each
MANY = 20  # levels of an input, above which patterns are fewer than courses
CACHE_BYTES = 64e6  # for the factors of recent patterns


# The best moves where those of inputs with levels are given, shape (n_moves,), and what they cost; None for none.
Completion: TypeAlias = Callable[[Array], tuple[Array, float] | None]


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
        self._values: OrderedDict[bytes, ValueFactor] = OrderedDict()
        limited = len(condensed.bounds.above) + len(condensed.bounds.below) > 0
        self.outputs = LimitedOutputs(condensed) if limited else None
        self.zones = None if condensed.bounds.zones is None else ZonedOutputs(condensed)

        # What is known of a course from its start alone has to be decided in the order of time.
        self._last_first = self.zones is None and not (
            admissible.simultaneous or admissible.per_step < admissible.n_inputs or any(levels.timings)
        )

    @property
    def rounding_cost(self) -> float:
        """What it costs on average to round a move to a level where later moves make up for it, in prices.

        Infinite where some move has no price, and where an input has so few levels that courses are soon searched.
        """
        m, price = self.admissible.n_inputs, self.admissible.price
        factor = self.factor(np.ones(self.condensed.n_moves, dtype=bool))
        few = any(values is not None and len(values) < MANY for values in self.levels.values)
        if few or not len(factor.moves) or not (price[factor.moves % m] > 0).all():
            return np.inf
        widths = np.array([
            0.0 if values is None or len(values) < 2 else (values[-1] - values[0]) / (len(values) - 1)
            for values in self.levels.values
        ])  # fmt: skip
        lost = np.square(np.diag(factor.L) * widths[factor.moves % m]) / 12
        return float((lost / price[factor.moves % m]).mean())

    def past(self, inputs: Array) -> Past:
        """What the applied inputs, shape (h, m) with the latest last, mean for timings."""
        return past_of(inputs, self.levels, self.condensed.input_prefix)

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

    def _of_values(self, pattern: BoolArray) -> ValueFactor:
        """The cost in the values after the moves of a pattern, shape (n_moves,)."""
        key = pattern.tobytes()
        kept = self._values.get(key)
        if kept is None:
            U = self.condensed.U
            kept = self._values[key] = ValueFactor(U, np.flatnonzero(pattern), self.admissible.n_inputs)
            if len(self._values) > CACHE_BYTES / (16 * U.size):
                self._values.popitem(last=False)
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
        paid: bool = False,
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
            paid: whether courses that make fewer moves than the pattern has are left to patterns of their own, so that
                all of them are paid.
            cutoff: courses that cost as much are of no interest.
            deadline: of `perf_counter`.
            most: nodes to visit.
        """
        if completed is None and self._last_first:
            factor = self._of_values(pattern & self.admissible.open(allowance))
            ends = LastFirst(
                self.condensed, self.admissible, self.levels,
                sample, factor, allowance, past, priced, paid, cutoff,
            )  # fmt: skip
            found = ends.run(deadline, most, lambda moves: self._keeps_limits(sample, moves))
            if found is not None:
                return found
        one = _OneSample(self, sample, self.factor(pattern), allowance, past, priced, completed, paid, cutoff)
        return one.run(deadline, most)

    def _keeps_limits(self, sample: Sample, moves: Array) -> bool:
        """Whether outputs are within their limits with these moves."""
        if self.outputs is None:
            return True
        room, every, none = self.outputs.room(sample), self.outputs.last >= -1, self.outputs.none(1)
        return not (self.outputs.excess(moves[None], room, every, none) > 0).any()


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
        paid: bool,
        cutoff: float,
    ) -> None:
        condensed, admissible = of.condensed, of.admissible
        m = self._m = admissible.n_inputs
        self._of, self._rules, self._sample, self._factor = of, admissible, sample, factor
        self._allowance, self._past, self._condensed = allowance, past, condensed
        # What moves without levels make of outputs is known with a course that is complete.
        self._completed = completed
        self._outputs, self._zones = (of.outputs, of.zones) if completed is None else (None, None)
        self._room = None if self._outputs is None else self._outputs.room(sample)
        self._best: Array | None = None
        self._objective, self._rounding = cutoff, condensed.rounding(sample)
        self._next = NextMoves(condensed, admissible, of.levels, sample, allowance, past)
        # Moves of inputs without levels are given by the pattern, and paid.
        self._now = np.bincount(factor.free // m, minlength=admissible.control_horizon)
        self._used = int((self._now > 0).sum()) if admissible.simultaneous else len(factor.free)
        given = np.concatenate([factor.free, factor.moves]) if paid else factor.free
        self._charge = admissible.charge(np.isin(np.arange(condensed.n_moves), given))
        self._paid = paid
        self._price: Array = np.zeros(m) if paid else admissible.price
        self._few = (admissible.priced and not paid) or admissible.rules.max_moves is not None
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
        root, visited = self._root(), 0
        pending = [(0, root.take(root.bound < self._cutoff))]
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
            if not len(nodes.bound):
                return
            nodes = self._children(step, nodes, NEAREST)[0]
            if len(nodes.bound) > BEAM:
                nodes = nodes.take(np.argpartition(nodes.bound, BEAM)[:BEAM])
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
        if self._completed is None and not self._free_may_stay():
            return root.take(slice(0))
        root = self._bounded(root)
        return self._with_few_more(0, root) if self._few else root

    def _free_may_stay(self) -> bool:
        """Whether limits let inputs without levels be where they are throughout."""
        u, values = self._sample.u_previous, self._of.levels.values
        return all(self._next.within(a, 0, None, u[a]).all() for a in range(self._m) if values[a] is None)

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
        u, stays = nodes.u[:, a], self._next.staying(j, a, nodes)
        rows: Indices = np.zeros(0, dtype=np.intp)
        values: Array = np.zeros(0)
        left = None
        if p >= 0:
            pivot = self._factor.L[p, p]
            room = np.sqrt(np.maximum(self._cutoff - nodes.cost[:, 0] - nodes.charge, 0.0)) / abs(pivot)
            centre = u + nodes.rest[:, 0, p] / pivot
            rows, values, first_left = self._next.levels_within(j, a, nodes, centre, room, nearest)
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
            children.charge[moved] += self._price[a] * counted
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
        prices = self._price[self._factor.moves[p:] % self._m]
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
            elif self._paid:
                objective += self._rules.charge(moves != 0) - self._charge
            if objective < self._cutoff:
                self._best, self._objective = moves, objective
