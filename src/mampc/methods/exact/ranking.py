"""All admissible patterns of a small problem, ranked by a bound that needs no solver.

No moves on a pattern S cost less than the optimum without limits there. With d* the free optimum, E the moves that S
leaves out and V = (I - Q Q') U_E, Q an orthonormal basis of the columns U_S, that is

    least + |V d*_E|^2 + price of S        least: the cost of the free optimum

and where the optimum on S keeps every limit, this is its cost. It is counted upwards from the free optimum, which
is as exact as the problem is well conditioned; counted downwards from the cost of no moves it would drown in
rounding. V does not change from sample to sample: written as a linear function of the products x_i x_k, i <= k, of
x_i = |U_i| d*_i, all patterns are ranked by one matrix-vector product.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.program.condensing import CondensedQP
from mampc.program.least_distance import ROUNDING
from mampc.program.restriction import by_count, excess_table
from mampc.program.sample import Indices, LaterData, LeastSquares, Optimum, PatternOptimum, Sample

LARGEST_TABLE = 1_000_000  # entries; from here on the tree search is faster
LARGEST_BESIDE_DATA = 4_000_000  # where plans count on later data, which leave the bounds of a tree weak
CACHE_BYTES = 64e6


class Ranking:
    """The table of all admissible patterns, fewest moves first.

    Attributes:
        patterns: shape (K, n_moves).
        charge: their prices, shape (K,).
        table: shape (K, n_moves (n_moves + 1) / 2).
    """

    def __init__(self, condensed: CondensedQP, admissible: AdmissiblePatterns, patterns: BoolArray) -> None:
        self.condensed, self.admissible = condensed, admissible
        counts = admissible.counts(patterns)
        order = np.argsort(counts, kind="stable")
        self.patterns: BoolArray = patterns[order]
        ends = np.searchsorted(counts[order], np.arange(counts.max() + 1), side="right").tolist()
        # A free move more never costs more: then only patterns that spend the whole budget are of interest.
        nested = admissible.nested
        starts = [0, *ends[:-1]] if nested else [0] * len(ends)
        self._all_free = (0,) * admissible.n_inputs
        self._rows_within = [slice(start, end) for start, end in zip(starts, ends, strict=True)]
        self.charge = admissible.charges(self.patterns)
        n = condensed.n_moves
        self._rows, self._columns = np.triu_indices(n)
        unit_columns = condensed.U / condensed.lengths
        self.table = excess_table(unit_columns, self.patterns)
        if admissible.sized:
            self._optima, self._stiffness = np.zeros((len(patterns), n, n)), np.ones((len(patterns), n))
            self._sizes = np.where(self.patterns, admissible.min_size, 0.0)
            for which, moves in by_count(self.patterns):
                Q, R = np.linalg.qr(condensed.U[:, moves].transpose(1, 0, 2))
                inverse = np.linalg.inv(R)
                self._optima[which[:, None], moves] = inverse @ (Q.transpose(0, 2, 1) @ unit_columns)
                self._stiffness[which[:, None], moves] = 1 / np.square(inverse).sum(axis=2)
        self._kept: OrderedDict[int, PatternOptimum] = OrderedDict()
        self._most_kept = max(64, int(CACHE_BYTES / condensed.map_bytes))

    def rows(self, past: Allowance) -> slice:
        """Where the patterns stand among which the best one is, given the past."""
        rows = self._rows_within[min(past.left, len(self._rows_within) - 1)]
        # Frozen inputs may leave part of the budget unspent.
        return rows if past.frozen == self._all_free else slice(0, rows.stop)

    def bounds(
        self, free: Array, least: float, past: Allowance, later_data: LaterData | None = None
    ) -> Array:
        """A lower bound for each pattern of `rows`, infinite where the past forbids it.

        Args:
            free: the free optimum, shape (n_moves,).
            least: its cost.
            past: what the applied moves leave.
            later_data: what patterns cost beside their prices, for plans that count on them.
        """
        rows, x = self.rows(past), free * self.condensed.lengths
        values: Array = self.table[rows].dot(x.take(self._rows) * x.take(self._columns))
        values += least - self.rounding(x)
        if self.admissible.priced:
            values += self.charge[rows]
        if later_data is not None:
            values += later_data.charges(self.patterns)[rows]
        if self.admissible.sized:
            values += self.lift(x[None], rows)[:, 0]
        if past.frozen != self._all_free:
            values[(self.patterns[rows] & ~self.admissible.open(past)).any(axis=1)] = np.inf
        return values

    def priced(self, cost: LeastSquares, past: Allowance, later_data: LaterData | None = None) -> Array:
        """The same with the limits priced in."""
        return self.bounds(self.condensed.plain.optimum(cost.target), cost.least, past, later_data)

    @cached_property
    def squares(self) -> Array:
        """The table as symmetric matrices, shape (K, n_moves, n_moves)."""
        n = self.condensed.n_moves
        halves = self.table * np.where(self._rows == self._columns, 1.0, 0.5)
        squares = np.empty((len(self.table), n, n))
        squares[:, self._rows, self._columns] = squares[:, self._columns, self._rows] = halves
        return squares

    def scaled(self, cost: LeastSquares) -> Array:
        """x of a cost, shape (n_moves,)."""
        x: Array = self._to_x.dot(cost.target)
        return x

    @cached_property
    def _to_x(self) -> Array:
        """x per target."""
        optimum = self.condensed.plain.optimum(np.eye(self.condensed.n_moves))
        to_x: Array = self.condensed.lengths[:, None] * optimum
        return to_x

    def rounding(self, x: Array) -> float:
        """All that rounding can add to x' T x: no entry of the table is larger than 1."""
        return len(x) * ROUNDING * float(x.dot(x))

    def charges(self, rows: Indices | slice, later_data: LaterData | None) -> Array:
        """What patterns cost beside, shape (rows,)."""
        if later_data is None:
            return self.charge[rows]
        return (self.charge + later_data.charges(self.patterns))[rows]

    def lift(self, x: Array, rows: slice | Indices) -> Array:
        """How much more patterns cost at least because their optima have moves below their least size.

        For x of shape (J, n_moves) and some rows of the table, shape (rows, J).
        """
        short = np.maximum(self._sizes[rows][:, :, None] - np.abs(self._optima[rows] @ x.T), 0.0)
        lift: Array = (short * short * self._stiffness[rows][:, :, None]).max(axis=1, initial=0.0)
        return lift

    def optimum(self, index: int, sample: Sample) -> Optimum:
        """The optimum without limits on one pattern."""
        kept = self._kept.get(index)
        if kept is None:
            kept = self._kept[index] = self.condensed.optimum_on(self.patterns[index])
            if len(self._kept) > self._most_kept:
                self._kept.popitem(last=False)
        return kept.at(sample)


def ranking_of(
    condensed: CondensedQP, admissible: AdmissiblePatterns, largest: int | None = None
) -> Ranking | None:
    """The table, or None where there are too many patterns for it; `largest`: in entries."""
    products = condensed.n_moves * (condensed.n_moves + 1) // 2
    patterns = admissible.listed((LARGEST_TABLE if largest is None else largest) // products)
    return None if patterns is None else Ranking(condensed, admissible, patterns)
