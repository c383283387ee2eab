"""The cost in least squares form, and with limits priced in.

With U = Q L, L lower triangular, for the U of `condensing` and moves in the order of time, the moves d cost

    J(d) = |L d - c|^2 + rest,    c = Q' target

a sum of squares over the free optimum d* = L^-1 c, so that nothing cancels. Multipliers mu of limits A d <= b and
pulls s at the moves change c and rest alone:

    J(d) + mu'(A d - b) + s'd = |L d - c - D|^2 + rest + mu'(A d* - b) + s'd* - |D|^2,    D = -1/2 L^-T (A'mu + s)

A move d_i of price p_i between l_i and h_i that may also be zero, at no price, costs at least

    p_i [d_i != 0] >= s_i d_i + min(0, p_i - max(s_i l_i, s_i h_i))

The last term counts for moves that are still to be decided, and only for as many as the budget leaves.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.relaxation import Multipliers, SampleRelaxation
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.condensing import CondensedQP
from mampc.program.qp import UNBOUNDED
from mampc.program.sample import Indices, Sample

MOST_TERMS = 8  # that nodes are bounded with
UNLIMITED = 1e15  # no limit of an input is as large
UNEVEN = 1e4  # condition of U from which a step of refinement pays
NORMAL_EQUATIONS = 1e6  # condition of U from which on normal equations have no digits left


class Squares:
    """The least squares of the moves in `order`, for every sample.

    Attributes:
        order: indices of the moves, in time, shape (n,).
        L: lower triangular, and a column of zeros behind it, so that the move -1 is none; shape (n, n + 1).
        inverse: of L, shape (n, n).
        normal: L' L, shape (n + 1, n + 1).
        curvature: its diagonal, shape (n,).
        refined: whether solutions of normal equations need a second step.
        orthogonal: whether they have no digits left, so that every node is worked out anew by a QR.
    """

    def __init__(self, condensed: CondensedQP, order: Indices) -> None:
        self.condensed, self.order = condensed, order
        n = len(order)
        Q, triangle = np.linalg.qr(condensed.U[:, order[::-1]])  # later moves lead
        signs = np.where(np.diag(triangle) < 0, -1.0, 1.0)
        self._Q = np.ascontiguousarray((Q * signs)[:, ::-1])
        self.L = np.zeros((n, n + 1))
        self.L[:, :n] = (signs[:, None] * triangle)[::-1, ::-1]
        self.normal = self.L.T @ self.L
        self.curvature = np.diag(self.normal)[:n]
        self.inverse = np.linalg.inv(self.L[:, :n])
        self.refined = condensed.condition > UNEVEN
        self.orthogonal = condensed.condition > NORMAL_EQUATIONS

    def at(self, sample: Sample) -> tuple[Array, float, Array]:
        """c, shape (n,), rest, and the free optimum, shape (n,)."""
        c = sample.target @ self._Q
        missed = sample.target - self._Q @ c
        return c, sample.cost + float(missed @ missed), self.inverse @ c


class Terms:
    """The cost of one sample with limits priced in by several multipliers, one a column; the first without.

    Attributes:
        ids: of the columns.
        latest: the column of the latest.
        c: shape (n, K).
        rest: shape (K,).
        s: pulls, shape (n + 1, K); the move -1 has none.
        support: the largest s d of each move, shape (n + 1, K).
    """

    def __init__(
        self,
        admissible: AdmissiblePatterns,
        relaxation: SampleRelaxation,
        domain: Domain,
        c: Array,
        rest: float,
    ) -> None:
        self._admissible, self._relaxation, self._domain = admissible, relaxation, domain
        self._c, self._rest = c, rest
        n = len(self._c)
        self.ids: list[int] = []
        self._made = 0
        self.c, self.rest, self.s = np.empty((n, 0)), np.empty(0), np.empty((n + 1, 0))
        self.support = np.empty((n + 1, 0))
        self._later: list[Array] = [np.empty((n + 1, 0)) for _ in range(3)]
        self._put(self._c, self._rest, np.zeros(n))

    def add(self, found: Multipliers) -> None:
        """Take one more term, in place of the oldest but the first where there are too many."""
        s = np.where(self._domain.bounded & found.free, found.pulls, 0.0)
        self._put(*self.priced(found.rows, s), s)

    def drop_latest(self) -> None:
        """Forget the latest of terms that are few."""
        assert self.latest == len(self.ids) - 1
        last = slice(self.latest)
        self.ids.pop()
        self.c, self.s, self.support, self.rest = (
            self.c[:, last], self.s[:, last], self.support[:, last], self.rest[last],
        )  # fmt: skip
        self._later = [table[:, last] for table in self._later]
        self.latest -= 1

    def at_root(self, left: int, more: int = 1) -> float:
        """The bound before anything is decided, where so many moves are left, of which so many are made at least."""
        return float((self.rest + self.later(0, np.array([left]), None, more)[0]).max())

    def priced(self, rows: Array, s: Array) -> tuple[Array, Array]:
        """c and rest with these multipliers of rows, shape (..., rows), and the pulls s, shape (..., n)."""
        shift, excess = self._relaxation.priced(rows, s)
        return self._c + shift, self._rest + excess

    def _put(self, c: Array, rest: float | Array, s: Array) -> None:
        self._made += 1
        support = self._domain.support(s)
        tables = self._bounds_of_later(support)
        s, support = np.append(s, 0.0), np.append(support, 0.0)
        column = self.latest = len(self.ids)
        if column == MOST_TERMS:
            column = self.latest = 1 + self._made % (MOST_TERMS - 1)
            self.ids[column] = self._made
            for array, new in zip(
                (self.c, self.s, self.support, *self._later), (c, s, support, *tables), strict=True
            ):
                array[:, column] = new
            self.rest[column] = rest
            return
        self.ids.append(self._made)
        self.c, self.s = np.column_stack([self.c, c]), np.column_stack([self.s, s])
        self.support = np.column_stack([self.support, support])
        self.rest = np.append(self.rest, rest)
        self._later = [np.column_stack([kept, new]) for kept, new in zip(self._later, tables, strict=True)]

    def _bounds_of_later(self, support: Array) -> tuple[Array, Array, Array]:
        """For the moves from i on, i = 0..n: the least that any number of them, and the least that one of them adds.

        And what the moves of i's own sample add from i on where moving at this sample is paid for. Each (n + 1,).
        """
        of, order = self._admissible, self._domain.order
        n = len(support)
        all_later, one_later, own = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1)
        if not of.simultaneous:
            adds = of.price[order % of.n_inputs] - support
            all_later[:n] = np.cumsum(np.minimum(adds, 0.0)[::-1])[::-1]
            one_later[:n] = np.minimum.accumulate(adds[::-1])[::-1]
            return all_later, one_later, own
        total, least, inside, at = 0.0, np.inf, 0.0, -1
        for i in range(n - 1, -1, -1):
            if order[i] // of.n_inputs != at:
                at = order[i] // of.n_inputs
                if i < n - 1:
                    total, least = all_later[i + 1], one_later[i + 1]
                inside = 0.0
            inside += support[i]
            own[i] = -inside
            all_later[i] = total + min(0.0, of.price[0] - inside)
            one_later[i] = min(least, of.price[0] - inside)
        return all_later, one_later, own

    def later(self, level: int, left: Indices, paid: BoolArray | None, more: int = 1) -> Array:
        """What the moves from `level` on add at least where so many or more are made, shape (N, K).

        Args:
            left: how many moves, as budget and price count them, each node may still make, shape (N,).
            paid: with simultaneous counting, whether moving at the sample of `level` is paid for.
        """
        everything, one, own = (table[level] for table in self._later)
        adds: Array = np.where(one < 0, np.maximum(everything, left[:, None] * one), more * one)
        if paid is None or not paid.any():
            return adds
        following = self._domain.next_sample[level]
        everything, one = self._later[0][following], self._later[1][following]
        after = np.where(one < 0, np.maximum(everything, left[:, None] * one), 0.0)
        return np.where(paid[:, None], own + after, adds)


class Domain:
    """What each move may be, whatever the others are, at one sample; in the order of the tree.

    Attributes:
        order: indices of the moves, shape (n,).
        low, high: least and largest move, shape (n,); of size `UNBOUNDED` and more where there is no limit.
        input_low, input_high: least and largest input after the move, from now on, shape (n,).
        bounded: whether a move has both limits.
        up, down: at least so much of a move's price comes with each unit of it, shape (n,).
        next_sample: the first move of the sample after that of each move, shape (n,).
    """

    def __init__(
        self,
        condensed: CondensedQP,
        admissible: AdmissiblePatterns,
        order: Indices,
        sample: Sample,
        allowance: Allowance,
    ) -> None:
        v, n_simple, m = condensed.n_violations, condensed.bounds.n_simple, condensed.problem.model.n_inputs
        n = condensed.n_moves
        self.order = order
        input_low, input_high = np.full(n, -UNBOUNDED), np.full(n, UNBOUNDED)
        rows = condensed.bounds.input_rows
        inputs = condensed.bounds.move_of_bound[rows]
        input_low[inputs], input_high[inputs] = sample.lower[rows], sample.upper[rows]
        low, high = np.full(n, -UNBOUNDED), np.full(n, UNBOUNDED)
        own = n_simple - v
        if condensed.bounds.every_move:
            low[:own], high[:own] = sample.lower[v:n_simple], sample.upper[v:n_simple]
        else:
            input_low[:m], input_high[:m] = sample.lower[v:n_simple], sample.upper[v:n_simple]
        before_low = np.concatenate((np.zeros(m), input_low[:-m]))
        before_high = np.concatenate((np.zeros(m), input_high[:-m]))
        low, high = np.maximum(low, input_low - before_high), np.minimum(high, input_high - before_low)
        open_ = admissible.open(allowance)
        low, high = np.where(open_, low, 0.0)[order], np.where(open_, high, 0.0)[order]
        self.low, self.high = low, high
        self.input_low, self.input_high = input_low[order], input_high[order]
        self.bounded = (low > -UNLIMITED) & (high < UNLIMITED)
        at = order // m
        self.next_sample = np.searchsorted(at, at, side="right")
        price = admissible.price[order % m]
        if admissible.simultaneous:
            price = price / np.bincount(at)[at]
        self.up = np.where(self.bounded & (high > 0), price / np.where(high > 0, high, 1.0), 0.0)
        self.down = np.where(self.bounded & (low < 0), price / np.where(low < 0, -low, 1.0), 0.0)

    def support(self, s: Array) -> Array:
        """The largest s d of each move, which may be zero, shape (n,)."""
        return np.asarray(np.maximum(np.maximum(s * self.low, s * self.high), 0.0))
