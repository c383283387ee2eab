"""Branch and bound over move patterns, in the order of time.

A node has decided the moves up to some move i of the time-major order: those of S are made, the others
not. All later moves are relaxed to be free, at no price and without limits. Their elimination leaves a
quadratic in S alone: with H = U U' (U upper triangular) and y = U^-1 f, the relaxed optimum is

    -1/2 sum_{t > i} y_t^2 - 1/2 f~_S' (H~_SS)^-1 f~_S,    H~ = U_i U_i',  f~ = U_i y_i

where U_i is the leading block of U. Early moves matter most and late ones little, so that few nodes
survive: this relaxation is what makes the search fast. Many nodes of one level are treated in one batch.

Limits are priced into f by multipliers. No multipliers suit all nodes, so each is bounded with several, and takes
the largest bound: those of leaves solved lately, and of the program that the most promising node of a batch
relaxes to.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import NamedTuple, Protocol

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.condensing import CondensedQP
from mampc.program.sample import LeastSquares

CHUNK = 256  # nodes treated at once
KEPT_LEVELS = 300  # levels whose matrices are kept, for problems with no more moves than this
MOST_TERMS = 8  # linear terms that nodes are bounded with

Indices = np.ndarray[tuple[int, ...], np.dtype[np.intp]]
Priced = LeastSquares  # the cost with limits priced in


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

    def take(self, rows: Indices | BoolArray | slice) -> Nodes:
        return Nodes._make(array[rows] for array in self)


class Terms:
    """Linear terms with limits priced in, one a column; the first is that without prices.

    Attributes:
        f: shape (n, K).
        y: U^-1 f, shape (n, K).
        tail: relaxed optimum of the moves from i on, constants included, shape (n + 1, K).
    """

    def __init__(self, f: Array, constant: float, U_inverse: Array) -> None:
        self.f = f[:, None]
        self.y = U_inverse @ self.f
        free = -0.5 * np.cumsum((self.y * self.y)[::-1], axis=0)[::-1]
        self.tail = np.vstack([free, np.zeros((1, 1))]) + constant

    def add(self, new: Terms) -> Terms:
        """Take one more term, in place of the oldest but the first where there are too many; returns it."""
        drop = 2 if self.f.shape[1] == MOST_TERMS else 1
        for name in ("f", "y", "tail"):
            kept = getattr(self, name)
            setattr(self, name, np.hstack([kept[:, :1], kept[:, drop:], getattr(new, name)]))
        return new


class Oracle(Protocol):
    """What a search asks of the sample at hand; patterns have shape (n_moves,)."""

    def leaf(self, pattern: BoolArray) -> tuple[float, Priced | None]:
        """Try a pattern: the new cutoff, and its limits priced in if any are active."""

    def relaxed(self, free: BoolArray) -> Priced | None:
        """The limits priced in that are active when these moves are free, if any are."""


class PatternTree:
    """The search tree of one problem; `search` runs it for one sample's linear term."""

    def __init__(self, condensed: CondensedQP, admissible: AdmissiblePatterns) -> None:
        self.admissible, self._condensed = admissible, condensed
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
        self, priced: Sequence[Priced], past: Allowance, cutoff: float, deadline: float, oracle: Oracle
    ) -> float:
        """Visit every admissible pattern that may cost less than the cutoff.

        Args:
            priced: the cost, and those with limits priced in, if any.
            past: what the applied moves leave.
            cutoff: patterns at or above it (prices included) are of no interest.
            deadline: of `perf_counter`.
            oracle: `leaf` is called with patterns, best bound first.

        Returns:
            A lower bound over everything that was not visited: infinite when the search is complete.
        """
        of, n = self.admissible, len(self._order)
        terms, *others = map(self._terms, priced)
        for other in others:
            terms.add(other)
        rest = np.array(past.frozen, dtype=np.intp)
        root = Nodes(
            np.full((1, 0), -1), np.zeros(1, np.intp), np.zeros(1), (rest - of.rules.dwell)[None],
            np.zeros(1, np.intp), np.array([terms.tail[0].max() + self._least_price]),
        )  # fmt: skip
        pending = [(0, root)] if past.left > 0 and n else []
        while pending:
            if perf_counter() > deadline:
                return _least_bound(pending)
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
                made = children.take(slice(len(children.used) - including, None))
                cutoff = self._try(made, terms, cutoff, deadline, oracle)
                if (
                    perf_counter() > deadline
                ):  # these nodes bound their descendants, those just tried among them
                    return _least_bound([*pending, (level, nodes)])
            if level + 1 == n:
                continue
            children = self._growable(level, children, past)
            if len(children.used):
                bound = self._bound(level, children, terms, cutoff, oracle)
                pending.append((level + 1, children._replace(bound=bound).take(bound < cutoff)))
        return np.inf

    def _try(self, made: Nodes, terms: Terms, cutoff: float, deadline: float, oracle: Oracle) -> float:
        """Try the patterns of these nodes with no further move, best bound first; returns the new cutoff."""

        def values_for(terms: Terms) -> Array:
            values: Array = (self._minimum(self.H, terms.f, made.chosen) + terms.tail[-1]).max(axis=1)
            return values + made.charge

        values = values_for(terms)
        while values[row := int(values.argmin())] < cutoff and perf_counter() <= deadline:
            cutoff, limits = oracle.leaf(self._pattern(made.chosen[row]))
            values[row] = np.inf
            if limits is None:
                continue
            np.maximum(values, values_for(terms.add(self._terms(limits))), out=values)
            # Where a pattern does not move, its multipliers say little of those that do: price all that are left.
            if (left := values < cutoff).any():
                limits = oracle.relaxed(self._pattern(made.chosen[left]))
                if limits is not None:
                    np.maximum(values, values_for(terms.add(self._terms(limits))), out=values)
        return cutoff

    def _bound(self, level: int, children: Nodes, terms: Terms, cutoff: float, oracle: Oracle) -> Array:
        """The bounds of nodes that have decided the moves up to `level`."""
        further = np.full(len(children.used), self._least_price)
        if self.admissible.simultaneous:
            further[children.now > 0] = 0.0
        further += children.charge
        bound = np.maximum(children.bound, self._relaxed(level, children.chosen, terms) + further)
        row = int(bound.argmin())
        if terms.f.shape[1] > 1 and bound[row] < cutoff:  # limits matter at this sample
            free = self._pattern(children.chosen[row])
            free[self._order[level + 1 :]] = True
            limits = oracle.relaxed(free)
            if limits is not None:
                latest = terms.add(self._terms(limits))
                bound = np.maximum(bound, self._relaxed(level, children.chosen, latest) + further)
        return np.asarray(bound)

    def _terms(self, priced: Priced) -> Terms:
        f, constant = self._condensed.linear(priced)
        return Terms(f[self._order], constant, self._U_inverse)

    def _pattern(self, chosen: Indices) -> BoolArray:
        """The moves made at nodes `chosen`, shape (n_moves,)."""
        pattern = np.zeros(self.admissible.n_moves, dtype=bool)
        pattern[self._order[chosen[chosen >= 0]]] = True
        return pattern

    def _children(self, level: int, nodes: Nodes, past: Allowance) -> tuple[Nodes, int]:
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

    def _growable(self, level: int, nodes: Nodes, past: Allowance) -> Nodes:
        """The nodes that may still get a move after this level, with `now` for the next move."""
        of = self.admissible
        if self._order[level + 1] // of.n_inputs != self._order[level] // of.n_inputs:
            nodes = nodes._replace(now=np.zeros_like(nodes.now))
        spent = nodes.used >= past.left
        if of.simultaneous:
            spent &= nodes.now == 0
        return nodes.take(~spent)

    def _relaxed(self, level: int, chosen: Indices, terms: Terms) -> Array:
        """The relaxed optimum with the moves made, all later moves being free."""
        U = self._U[: level + 1, : level + 1]
        H = self._levels[level]
        if H is None:
            H = U @ U.T
            if len(self._levels) <= KEPT_LEVELS:
                self._levels[level] = H
        values = self._minimum(H, U @ terms.y[: level + 1], chosen) + terms.tail[level + 1]
        return np.asarray(values.max(axis=1))

    def _minimum(self, H: Array, f: Array, chosen: Indices) -> Array:
        """min over the chosen moves of 1/2 d' H d + f' d, at least as large as their least sizes demand.

        For linear terms f, shape (n, K); the result has shape (N, K).
        """
        size, width = chosen.shape
        if not width:
            return np.zeros((size, f.shape[1]))
        none = chosen < 0
        linear = np.where(none[:, :, None], 0.0, f[chosen])
        matrices = H[chosen[:, :, None], chosen[:, None, :]]
        matrices[none[:, :, None] | none[:, None, :]] = 0.0
        matrices[:, np.arange(width), np.arange(width)] += none
        if not self.admissible.sized:
            values: Array = -0.5 * (linear * np.linalg.solve(matrices, linear)).sum(axis=1)
            return values
        inverses = np.linalg.inv(matrices)
        optima = -(inverses @ linear)
        short = np.maximum(self._sizes[chosen][:, :, None] - np.abs(optima), 0.0)  # -1 has size zero
        lift = 0.5 * (short * short / np.einsum("nii->ni", inverses)[:, :, None]).max(axis=1)
        return np.asarray(0.5 * (linear * optima).sum(axis=1) + lift)


def _least_bound(pending: list[tuple[int, Nodes]]) -> float:
    return float(min(nodes.bound.min(initial=np.inf) for _, nodes in pending))
