"""All admissible patterns of a small problem, ranked by a bound that needs no solver.

With H the Hessian in the moves and f its linear term, no moves on the pattern S cost less than

    -1/2 f_S' H_SS^-1 f_S + price of S        (relative to the cost of no moves)

and where the optimum on S keeps every limit, this is its cost. The inverses do not change from sample to
sample: written as a linear function of the products f_i f_k, i <= k, all patterns are ranked by one
matrix-vector product.
"""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Optimum, PatternOptimum, Sample

LARGEST_TABLE = 1_000_000  # entries; from here on the tree search is faster
CACHE_BYTES = 64e6


class Ranking:
    """The table of all admissible patterns, fewest moves first.

    Attributes:
        patterns: shape (K, n_moves).
        charge: their prices, shape (K,).
    """

    def __init__(self, condensed: CondensedQP, admissible: AdmissiblePatterns, patterns: BoolArray) -> None:
        self.condensed, self.admissible = condensed, admissible
        counts = np.array([admissible.count(pattern) for pattern in patterns])
        order = np.argsort(counts, kind="stable")
        self.patterns: BoolArray = patterns[order]
        ends = np.searchsorted(counts[order], np.arange(counts.max() + 1), side="right").tolist()
        # A free move more never costs more: then only patterns that spend the whole budget are of interest.
        nested = admissible.simple and not admissible.priced and not admissible.sized
        starts = [0, *ends[:-1]] if nested else [0] * len(ends)
        self._rows_within = [slice(start, end) for start, end in zip(starts, ends, strict=True)]
        self.charge = np.array([admissible.charge(pattern) for pattern in self.patterns])
        n = condensed.n_moves
        self._rows, self._columns = np.triu_indices(n)
        inverses = np.zeros((len(patterns), n, n))
        for inverse, pattern in zip(inverses, self.patterns, strict=True):
            chosen = np.flatnonzero(pattern)
            inverse[np.ix_(chosen, chosen)] = np.linalg.inv(condensed.H[np.ix_(chosen, chosen)])
        doubled = np.where(self._rows == self._columns, 0.5, 1.0)
        self._table = np.ascontiguousarray(-inverses[:, self._rows, self._columns] * doubled)
        if admissible.sized:
            self._optima = -inverses.reshape(-1, n)
            self._stiffness = 1 / np.maximum(inverses[:, np.arange(n), np.arange(n)], 1e-300)
            self._sizes = np.where(self.patterns, admissible.min_size, 0.0)
        self._kept: OrderedDict[int, PatternOptimum] = OrderedDict()
        self._most_kept = max(64, int(CACHE_BYTES / condensed.map_bytes))

    def rows(self, past: Allowance) -> slice:
        """Where the patterns stand among which the best one is, given the past."""
        rows = self._rows_within[min(past.left, len(self._rows_within) - 1)]
        return (
            slice(0, rows.stop) if any(past.frozen) else rows
        )  # inputs at rest may leave part of the budget unspent

    def bounds(self, f: Array, past: Allowance) -> Array:
        """A lower bound for each pattern of `rows` (infinite where the past forbids it), for the linear term f.

        Relative to the cost of no moves.
        """
        rows = self.rows(past)
        values: Array = self._table[rows].dot(f.take(self._rows) * f.take(self._columns))
        if self.admissible.priced:
            values += self.charge[rows]
        if self.admissible.sized:
            values += self._lift(f, rows.stop)
        if any(past.frozen):
            values[(self.patterns[rows] & ~self.admissible.open(past)).any(axis=1)] = np.inf
        return values

    def _lift(self, f: Array, end: int) -> Array:
        """How much more a pattern costs at least because its optimum has moves below their least size."""
        n = self.condensed.n_moves
        optima = self._optima[: end * n].dot(f).reshape(end, n)
        short = np.maximum(self._sizes[:end] - np.abs(optima), 0.0)
        lift: Array = 0.5 * (short * short * self._stiffness[:end]).max(axis=1, initial=0.0)
        return lift

    def optimum(self, index: int, sample: Sample) -> Optimum:
        """The optimum without limits on one pattern."""
        kept = self._kept.get(index)
        if kept is None:
            kept = self._kept[index] = self.condensed.optimum_on(self.patterns[index])
            if len(self._kept) > self._most_kept:
                self._kept.popitem(last=False)
        return kept.at(sample)


def ranking_of(condensed: CondensedQP, admissible: AdmissiblePatterns) -> Ranking | None:
    """The table, or None where there are too many patterns for it."""
    products = condensed.n_moves * (condensed.n_moves + 1) // 2
    patterns = admissible.listed(LARGEST_TABLE // products)
    return None if patterns is None else Ranking(condensed, admissible, patterns)
