"""Branch and bound over move patterns, in the order of time.

A node has decided the moves up to some move i of the time-major order: those of S are made, the others
not. All later moves are relaxed to be free, at no price and without limits. Their elimination leaves a
quadratic in S alone: with H = U U' (U upper triangular) and y = U^-1 f, the relaxed optimum is

    -1/2 sum_{t > i} y_t^2 - 1/2 f~_S' (H~_SS)^-1 f~_S,    H~ = U_i U_i',  f~ = U_i y_i

where U_i is the leading block of U. Early moves matter most and late ones little, so that few nodes
survive: this relaxation is what makes the search fast. Many nodes of one level are treated in one batch.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np

from mampc.arrays import Array, BoolArray
from mampc.condensing import CondensedQP
from mampc.patterns import Admissible, Past

CHUNK = 256  # nodes treated at once
KEPT_LEVELS = 300  # levels whose matrices are kept, for problems with no more moves than this

Indices = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


class Nodes(NamedTuple):
    """Nodes of one level, one a row.

    Attributes:
        chosen: positions of the moves made, padded with -1, shape (N, width).
        used: moves made, as the budget counts them.
        charge: their price.
        last: sample of each input's last move, negative in the past, shape (N, m).
        now: moves made at the sample of the next move to decide.
        bound: relaxed optimum, prices included.
    """

    chosen: Indices
    used: Indices
    charge: Array
    last: Indices
    now: Indices
    bound: Array

    def take(self, rows: Indices | BoolArray) -> Nodes:
        return Nodes._make(array[rows] for array in self)


class PatternTree:
    """The search tree of one problem; `search` runs it for one sample's linear term."""

    def __init__(self, condensed: CondensedQP, admissible: Admissible) -> None:
        self.admissible = admissible
        self._order = np.flatnonzero(admissible.candidates)
        self.H = condensed.H[np.ix_(self._order, self._order)]
        n = len(self._order)
        self._U = np.ascontiguousarray(np.linalg.cholesky(self.H[::-1, ::-1])[::-1, ::-1])
        self._U_inverse = np.linalg.inv(self._U)
        self._levels: list[Array | None] = [None] * n
        self._sizes = np.append(admissible.min_size[self._order], 0.0)
        price = admissible.price
        self._least_price = float(price.min())

    def search(
        self, f: Array, past: Past, cutoff: float, deadline: float, leaf: Callable[[BoolArray, float], float]
    ) -> float:
        """Visit every admissible pattern that may cost less than the cutoff.

        Args:
            f: linear term, shape (n_moves,).
            past: what the applied moves leave.
            cutoff: patterns at or above it (relative to no moves, prices included) are of no interest.
            deadline: of `perf_counter`.
            leaf: called with a pattern, shape (n_moves,), and its bound, best bound first; returns the new cutoff.

        Returns:
            A lower bound over everything that was not visited: infinite when the search is complete.
        """
        of, order = self.admissible, self._order
        n = len(order)
        f = f[order]
        y = self._U_inverse @ f
        tail = np.append(-0.5 * np.cumsum((y * y)[::-1])[::-1], 0.0)  # relaxed optimum of the moves from i on
        rest = np.array(past.rest, dtype=np.intp)
        root = Nodes(
            np.full((1, 0), -1), np.zeros(1, np.intp), np.zeros(1), (rest - of.rules.dwell)[None],
            np.zeros(1, np.intp), np.array([tail[0] + self._least_price]),
        )  # fmt: skip
        pending = [(0, root)] if past.left > 0 and n else []
        while pending:
            if perf_counter() > deadline:
                return float(min(nodes.bound.min() for _, nodes in pending))
            level, nodes = pending.pop()
            nodes = nodes.take(nodes.bound < cutoff)
            if not len(nodes.bound):
                continue
            if len(nodes.bound) > CHUNK:
                by_bound = np.argsort(nodes.bound, kind="stable")
                pending.append((level, nodes.take(by_bound[CHUNK:])))
                nodes = nodes.take(by_bound[:CHUNK])
            children, including = self._children(level, nodes, past)
            if including:
                made = slice(len(children.used) - including, None)
                values = self._values(children.chosen[made], f) + children.charge[made]
                for row in np.argsort(values, kind="stable").tolist():
                    if values[row] >= cutoff:
                        break
                    pattern = np.zeros(of.n_moves, dtype=bool)
                    chosen = children.chosen[made][row]
                    pattern[order[chosen[chosen >= 0]]] = True
                    cutoff = leaf(pattern, float(values[row]))
                    if perf_counter() > deadline:  # these nodes bound their descendants, this leaf among them
                        return float(min(some.bound.min() for _, some in [*pending, (level, nodes)]))
            if level + 1 == n:
                continue
            children = self._growable(level, children, past)
            if not len(children.used):
                continue
            further = np.full(len(children.used), self._least_price)
            if of.simultaneous:
                further[children.now > 0] = 0.0
            relaxed = tail[level + 1] + self._relaxed(level, children.chosen, y)
            children = children._replace(bound=relaxed + children.charge + further)
            pending.append((level + 1, children.take(children.bound < cutoff)))
        return np.inf

    def _children(self, level: int, nodes: Nodes, past: Past) -> tuple[Nodes, int]:
        """The nodes without and, after them, with the level's move, and how many the latter are."""
        of = self.admissible
        j, a = divmod(int(self._order[level]), of.n_inputs)
        counts = (nodes.now == 0) | (not of.simultaneous)
        may = (
            (nodes.used + counts <= past.left)
            & (nodes.now < of.per_step)
            & (j >= nodes.last[:, a] + of.rules.dwell)
        )
        made = nodes.take(may)
        chosen = np.hstack([made.chosen, np.full((len(made.used), 1), level)])
        if np.ndim(made.chosen) and made.chosen.shape[1]:
            # Keep the rows packed: the new move goes behind the last one.
            width = (made.chosen >= 0).sum(axis=1)
            chosen[:, -1] = -1
            chosen[np.arange(len(width)), width] = level
        made_counts = counts[may]
        last = made.last.copy()
        last[:, a] = j
        made = Nodes(
            chosen,
            made.used + made_counts,
            made.charge + of.price[a] * made_counts,
            last,
            made.now + 1,
            made.bound,
        )
        left_out = nodes._replace(chosen=np.hstack([nodes.chosen, np.full((len(nodes.used), 1), -1)]))
        together = Nodes(*(np.concatenate(pair) for pair in zip(left_out, made, strict=True)))
        width = int((together.chosen >= 0).sum(axis=1).max(initial=0))
        together = together._replace(chosen=together.chosen[:, :width])
        return together, len(made.used)

    def _growable(self, level: int, nodes: Nodes, past: Past) -> Nodes:
        """The nodes that may still get a move after this level, with `now` for the next move."""
        of = self.admissible
        if self._order[level + 1] // of.n_inputs != self._order[level] // of.n_inputs:
            nodes = nodes._replace(now=np.zeros_like(nodes.now))
        spent = nodes.used >= past.left
        if of.simultaneous:
            spent &= nodes.now == 0
        return nodes.take(~spent)

    def _values(self, chosen: Indices, f: Array) -> Array:
        """The bound of each pattern with no further move."""
        return self._minimum(self.H, f, chosen)

    def _relaxed(self, level: int, chosen: Indices, y: Array) -> Array:
        """The part of the relaxed optimum that belongs to the moves made, all later moves being free."""
        U = self._U[: level + 1, : level + 1]
        H = self._levels[level]
        if H is None:
            H = U @ U.T
            if len(self._levels) <= KEPT_LEVELS:
                self._levels[level] = H
        return self._minimum(H, U @ y[: level + 1], chosen)

    def _minimum(self, H: Array, f: Array, chosen: Indices) -> Array:
        """min over the chosen moves of 1/2 d' H d + f' d, at least as large as their least sizes demand."""
        size, width = chosen.shape
        if not width:
            return np.zeros(size)
        none = chosen < 0
        linear = np.where(none, 0.0, f[chosen])
        matrices = H[chosen[:, :, None], chosen[:, None, :]]
        matrices[none[:, :, None] | none[:, None, :]] = 0.0
        matrices[:, np.arange(width), np.arange(width)] += none
        if not self.admissible.sized:
            optima = -np.linalg.solve(matrices, linear[:, :, None])[:, :, 0]
            values: Array = 0.5 * (linear * optima).sum(axis=1)
            return values
        inverses = np.linalg.inv(matrices)
        optima = -(inverses @ linear[:, :, None])[:, :, 0]
        short = np.maximum(self._sizes[chosen] - np.abs(optima), 0.0)  # -1 has size zero
        lift = 0.5 * (short * short / np.einsum("nii->ni", inverses)).max(axis=1)
        return np.asarray(0.5 * (linear * optima).sum(axis=1) + lift)
