"""The search over courses of inputs on levels that decides their ends first.

With the values of the inputs for unknowns in place of moves, |U d - target|^2 = |R v - y|^2 + what no course can
reach, R upper triangular: row p holds no value before v_p. The last values hold for the rest of the horizon and weigh
most, so that few levels come into question for them; what the first samples of a course do is small beside that. A
node, which has decided the values from some p on, costs at least the squares of its rows.

What is left to decide leads from the present inputs to these values. An input that is elsewhere by then takes a move
at least, or as many as limits of moves ask for. If each takes one at most and none takes more, one of few courses is
left, which differ in when inputs move: they are all priced. Any other course has one move more, or two if it leaves an
input that is where it has to be.

Values are counted from the present inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from math import prod
from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.base.tolerances import tie
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.courses import TOGETHER, Found, NextMoves, Past, windows
from mampc.program.condensing import CondensedQP
from mampc.program.levels import InputLevels
from mampc.program.sample import Indices, LeastSquares, Sample

BEAM = 16  # nodes of each value that the first plan is looked for among
NEAREST = 5  # levels that it tries for each
COURSES = 1000  # that are priced for one node
AT_ONCE = 2**17  # courses that are priced at once
WAITING = 2**24  # numbers in the nodes that wait
LATER = 1_000_000  # samples


class _Ends(NamedTuple):
    """Nodes: K ends of courses.

    Attributes:
        v: values decided, others zero, shape (K, k).
        at: the first one decided of each input, zero if there is none, shape (K, m).
        since: the sample of the first move decided of each input, shape (K, m).
        rest: y - R v of each least-squares problem, shape (K, problems, k).
        cost: squares of the rows decided, shape (K, problems).
        charge, used: prices and number of the moves decided, shape (K,).
        bound: shape (K,).
    """

    v: Array
    at: Array
    since: Indices
    rest: Array
    cost: Array
    charge: Array
    used: Indices
    bound: Array

    def take(self, rows: Indices | BoolArray | slice) -> _Ends:
        return _Ends._make([part[rows] for part in self])


class ValueFactor:
    """The cost in the values after some moves, each of which holds until the next move of its input.

    Args:
        U: factor of the cost in all moves, shape (rows, n_moves).
        moves: shape (k,).
        m: inputs.

    Attributes:
        moves: shape (k,).
        later: the next move of the same input, as a position, -1 for none, shape (k,).
        first: whether it is the first one of its input, shape (k,).
        own: positions of each input's moves.
        complete: the last position from which on every input that moves has a value.
        Q: orthonormal columns, shape (rows, k).
        R: upper triangular, shape (k, k).
    """

    def __init__(self, U: Array, moves: Indices, m: int) -> None:
        k, at = len(moves), np.full(m, -1)
        self.moves, self.own = moves, [np.flatnonzero(moves % m == a) for a in range(m)]
        self.later, self.first = np.full(k, -1), np.ones(k, dtype=bool)
        for p in range(k - 1, -1, -1):
            self.later[p], at[moves[p] % m] = at[moves[p] % m], p
        self.first[self.later[self.later >= 0]] = False
        self.complete = int(np.flatnonzero(self.later < 0).min(initial=k))
        self.Q, self.R = np.linalg.qr(U[:, moves] - U[:, moves[self.later]] * (self.later >= 0))

    def jumps(self, p: int, a: int) -> Array:
        """What courses of input a that jump by one add to the rows before p, shape (p, jumps).

        At each of its values there, and not before p.
        """
        columns = self.R[:p, self.own[a][: self.before(p, a)]]
        return np.hstack([np.cumsum(columns[:, ::-1], axis=1)[:, ::-1], np.zeros((p, 1))])

    def before(self, p: int, a: int) -> int:
        """How many values of input a there are before p."""
        return int(np.searchsorted(self.own[a], p))


class LastFirst:
    """The search of one sample, as `LevelSearch.search` has it, and the factor in the moves that may be made."""

    def __init__(
        self,
        condensed: CondensedQP,
        rules: AdmissiblePatterns,
        levels: InputLevels,
        sample: Sample,
        factor: ValueFactor,
        allowance: Allowance,
        past: Past,
        priced: LeastSquares | None,
        paid: bool,
        cutoff: float,
    ) -> None:
        self._sample, self._factor, self._rules, self._paid = sample, factor, rules, paid
        self._m, self._u = rules.n_inputs, sample.u_previous
        self._left = allowance.left if rules.rules.max_moves is not None else None
        self._best: Array | None = None
        self._objective, self._rounding = cutoff, condensed.rounding(sample)
        pattern = np.isin(np.arange(condensed.n_moves), factor.moves)
        self._charge = rules.charge(pattern) if paid else 0.0
        self._price: Array = np.zeros(self._m) if paid else rules.price
        squares = [sample.least_squares] + ([] if priced is None else [priced])
        targets = np.array([one.target for one in squares])
        self._y = targets @ factor.Q
        self._base = np.array([one.least for one in squares])
        self._base += np.square(targets - self._y @ factor.Q.T).sum(axis=1)
        self._next = NextMoves(condensed, rules, levels, sample, allowance, past)
        # Nodes of every value wait at once.
        self._together = min(TOGETHER, WAITING // max(len(factor.moves), 1) ** 2)
        self._most = self._next.du_max.reshape(-1, self._m).max(axis=0)
        # The present input, which need not be a level, stands for the level that it is at.
        self._own: list[Array] = []
        self._is_level: list[bool] = []
        for a, values in enumerate(levels.values):
            own: Array = np.zeros(0) if values is None else values  # those without levels do not move
            same = self._next.same(a, own, self._u[a])
            self._own.append(np.sort(np.append(own[~same], self._u[a])))
            self._is_level.append(bool(same.any()))
        self._values = [self._values_after(p) for p in range(len(factor.moves))]

    @property
    def _cutoff(self) -> float:
        return self._objective - tie(self._objective, self._rounding)

    def _values_after(self, p: int) -> Array:
        """What the input may be after a move, counted from the present input, in order."""
        factor, m = self._factor, self._m
        move, later = int(factor.moves[p]), int(factor.later[p])
        j, a = divmod(move, m)
        end = None if later < 0 else int(factor.moves[later]) // m
        v: Array = self._own[a][self._next.within(a, j, end, self._own[a])] - self._u[a]
        before = factor.moves[: p + 1]
        v = v[np.abs(v) <= self._next.du_max[before[before % m == a]].sum()]
        return v[(v == 0) | self._next.allows(move, np.abs(v))] if factor.first[p] else v

    def run(self, deadline: float, most: float, keeps: Callable[[Array], bool]) -> Found | None:
        """The best course; deadline of `perf_counter`, and nodes to visit.

        None where moves do not keep limits of outputs, of which ends say too little: the first ones or the best ones.
        """
        root, visited = self._root(), 0
        if self._may_stay([None] * self._m):
            self._finish(root._replace(cost=root.cost + np.square(root.rest).sum(axis=2)))  # without moves
        pending = [(len(self._factor.moves) - 1, root.take(root.bound < self._cutoff))]
        self._look_ahead(pending[0][1])
        if self._best is not None and not keeps(self._best):
            return None
        while pending:
            if perf_counter() > deadline or visited > most:
                break
            p, nodes = pending.pop()
            nodes = nodes.take(nodes.bound < self._cutoff)
            if not len(nodes.bound):
                continue
            if p < 0:
                self._finish(nodes)
                continue
            children, left = self._children(p, nodes)
            if left is not None:
                pending.append((p, left))
            visited += len(children.bound)
            pending.append((p - 1, children.take(np.argsort(children.bound, kind="stable"))))
        if self._best is not None and not keeps(self._best):
            return None
        open_ = min((float(nodes.bound.min(initial=np.inf)) for _, nodes in pending), default=np.inf)
        return Found(self._best, self._objective, min(open_, self._objective), not pending, visited)

    def _look_ahead(self, nodes: _Ends) -> None:
        """A first plan, by the best few nodes of each value."""
        for p in range(len(self._factor.moves) - 1, -1, -1):
            if not len(nodes.bound):
                return
            nodes = self._children(p, nodes, NEAREST)[0]
            if len(nodes.bound) > BEAM:
                nodes = nodes.take(np.argpartition(nodes.bound, BEAM)[:BEAM])
        self._finish(nodes)

    def _root(self) -> _Ends:
        m, moves = self._m, self._factor.moves
        first = [int(moves[own[0]]) // m if len(own) else None for own in self._factor.own]
        base = self._base[None].copy()
        root = _Ends(
            np.zeros((1, len(moves))), np.zeros((1, m)), np.full((1, m), LATER), self._y[None].copy(), base,
            np.full(1, self._charge), np.zeros(1, dtype=np.intp), base.max(axis=1) + self._charge,
        )  # fmt: skip
        return root.take(slice(int(self._may_stay(first))))

    def _may_stay(self, until: Sequence[int | None]) -> bool:
        """Whether inputs may be where they are before these samples, None for all."""
        return all(self._next.within(a, 0, end, self._u[a : a + 1]).all() for a, end in enumerate(until))

    def _children(self, p: int, nodes: _Ends, nearest: int | None = None) -> tuple[_Ends, _Ends | None]:
        """What nodes lead to by one value, as far as it may beat the best plan, and the nodes that have to wait."""
        factor, dwell = self._factor, self._rules.rules.dwell
        later, (j, a) = int(factor.later[p]), divmod(int(factor.moves[p]), self._m)
        pivot, values = factor.R[p, p], self._values[p]
        others = self._needed(nodes.at) @ np.where(np.arange(self._m) == a, 0.0, self._price)
        room = np.sqrt(np.maximum(self._cutoff - nodes.cost[:, 0] - nodes.charge - others, 0.0)) / abs(pivot)
        rows, index, waiting = windows(
            values, nodes.rest[:, 0, p] / pivot, room, nearest, together=self._together
        )
        v, before, since = values[index], nodes.at[rows, a], nodes.since[rows, a]
        moved: BoolArray = np.zeros(len(rows), dtype=bool)
        kept = ~moved
        if later >= 0:
            i = int(factor.moves[later]) // self._m
            moved = v != before
            kept = ~moved | self._next.allows(int(factor.moves[later]), np.abs(v - before))
            kept &= ~moved | (since - i >= dwell)
            if not self._is_level[a]:
                kept &= ~moved | (before != 0)  # there is no way back
            since = np.where(moved, i, since)
        if factor.first[p]:
            kept &= (v == 0) | (since - j >= dwell)
        left = nodes.take(slice(waiting, None)) if waiting < len(nodes.bound) else None
        rows, v, moved, since = rows[kept], v[kept], moved[kept], since[kept]
        at = nodes.at[rows]
        at[:, a] = v
        cost = nodes.cost[rows] + np.square(nodes.rest[rows, :, p] - pivot * v[:, None])
        charge, used = nodes.charge[rows] + self._price[a] * moved, nodes.used[rows] + moved
        needed = self._needed(at)
        bound = cost.max(axis=1) + charge + needed @ self._price
        may: BoolArray = bound < self._cutoff
        if self._left is not None:
            may &= used + needed.sum(axis=1) <= self._left
        children = nodes.take(rows[may])._replace(
            at=at[may], cost=cost[may], charge=charge[may], used=used[may], bound=bound[may]
        )
        v = v[may]
        children.v[:, p], children.since[:, a] = v, since[may]
        children = children._replace(rest=children.rest - v[:, None, None] * factor.R[:, p])
        if 0 < p <= factor.complete and not self._paid and len(children.bound):
            children = self._with_few_more(p, children, nearest is not None)
            children = children.take(children.bound < self._cutoff)
        return children, left

    def _needed(self, at: Array) -> Array:
        """How many moves inputs take at least to these values, shape (K, m)."""
        return np.asarray(np.maximum(np.ceil(np.abs(at) / self._most), at != 0))

    def _with_few_more(self, p: int, nodes: _Ends, every: bool) -> _Ends:
        """The nodes bounded by what it costs to move no more than they have to, and by a move more.

        Those alone that this may rule out, or `every` one.
        """
        moving, needed = nodes.at != 0, self._needed(nodes.at)
        moves = np.where(moving, 1, 2)
        extra: Array = moves * self._price
        if self._left is not None:
            left = self._left - nodes.used - needed.sum(axis=1)
            extra = np.where(moves <= left[:, None], extra, np.inf)
        more = extra.min(axis=1)
        paid, bound = nodes.charge + moving @ self._price, nodes.bound.copy()
        looked = np.flatnonzero((needed <= 1).all(axis=1) & (every | (bound + more >= self._cutoff)))
        sets = moving[looked] @ 2 ** np.arange(self._m)
        for each in np.unique(sets):
            alike = looked[sets == each]
            inputs = np.flatnonzero(moving[alike[0]]).tolist()
            if (courses := prod(self._factor.before(p, a) + 1 for a in inputs)) > COURSES:
                continue
            own = [self._factor.jumps(p, a) for a in inputs]
            for rows in np.array_split(alike, 1 + len(alike) * courses // AT_ONCE):
                least = _least_squares(nodes.rest[rows, :, :p], nodes.at[rows][:, inputs], own)
                least = (nodes.cost[rows] + np.minimum(least, more[rows, None])).max(axis=1) + paid[rows]
                bound[rows] = np.maximum(bound[rows], least)
        return nodes._replace(bound=bound)

    def _finish(self, courses: _Ends) -> None:
        """Take the best of courses that are decided."""
        if not len(courses.bound):
            return
        later, moves = self._factor.later, self._factor.moves
        followed = np.flatnonzero(later >= 0)
        d = np.zeros((len(courses.bound), self._rules.n_moves))
        d[:, moves] = courses.v
        d[:, moves[later[followed]]] -= courses.v[:, followed]
        objective = courses.cost[:, 0] + courses.charge + (courses.at != 0) @ self._price
        if self._paid:
            objective += self._rules.charges(d != 0) - self._charge
        best = int(objective.argmin())
        if objective[best] < self._cutoff:
            self._best, self._objective = d[best].copy(), float(objective[best])


def _least_squares(rest: Array, size: Array, jumps: list[Array]) -> Array:
    """The least squares, shape (K, problems), where inputs jump once by their sizes.

    Args:
        rest: rows without jumps, shape (K, problems, p).
        size: of each input's jump, shape (K, inputs).
        jumps: of each input, what it adds to the rows if it is of size one, shape (p, times).
    """
    times = [jump.shape[1] for jump in jumps]

    def along(values: Array, *axes: int) -> Array:
        return values.reshape(*values.shape[:2], *[n if a in axes else 1 for a, n in enumerate(times)])

    squares, n = np.square(rest).sum(axis=2), len(jumps)
    total, added = along(squares), squares.copy()
    for a, jump in enumerate(jumps):
        s, own = size[:, a, None, None], np.square(jump).sum(axis=0)
        total = total + along(s * (s * own - 2 * (rest @ jump)), a)
        added += np.square(s[:, 0]) * own.max()
    for a, b in combinations(range(n), 2):
        s = 2 * size[:, a, None, None, None] * size[:, b, None, None, None]
        total = total + along(s * (jumps[a].T @ jumps[b]), a, b)
    # Large squares may cancel each other: no bound may gain by what rounding leaves of them. The products' sizes sum up
    # to n + 1 times what was added at most, and a sum of k products is wrong by k half units of each.
    lost = (n + 1) / 2 * (rest.shape[2] + n * n + 4) * np.finfo(float).eps * added
    least: Array = total.reshape(*squares.shape, -1).min(axis=2) - lost
    return least
