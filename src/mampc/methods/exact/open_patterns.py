"""The patterns of the table that may still be best, and multipliers that bound them.

The bound of a pattern is concave in the multipliers, and the best ones differ from pattern to pattern. Those that turn
up belong to single patterns; for another one, multipliers somewhere between two of them are often better than both.
With x the free optimum where limits are priced in, and D what the target has moved by, both affine in the multipliers,
the bound is

    level + x' T x - |D|^2 + price of the pattern        T: its row of the table

a quadratic on the way from new multipliers to earlier ones, whose largest value each pattern takes.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.methods.exact.ranking import Ranking
from mampc.moves.admissible import Allowance
from mampc.program.sample import Indices, LeastSquares, Sample

FLAT = 1e-100  # of a curvature: what stands for none


class OpenPatterns:
    """Those of one sample.

    Args:
        ranking: the table.
        sample, past: its data, and what the past allows.
        bounds: without limits, as `Ranking` gives them for all patterns that the past allows.

    Attributes:
        rows: of the table, shape (K,).
        bounds: on what each costs, shape (K,).
    """

    def __init__(self, ranking: Ranking, sample: Sample, past: Allowance, bounds: Array) -> None:
        self._ranking, self._sample = ranking, sample
        self._of_table = ranking.rows(past)
        self.rows: Indices = np.arange(self._of_table.start, self._of_table.start + len(bounds))
        self.bounds = bounds
        # All of these once multipliers are priced in: the open part of the table and prices; per multipliers x, D and
        # the level; and per multipliers and pattern x' T x - |D|^2.
        self._table: Array | None = None
        self._charge: Array
        self._x: Array
        self._shift: Array
        self._level: Array
        self._square: Array

    def best(self) -> tuple[int, float]:
        """The position of the pattern with the least bound, and that: infinite when none is left."""
        if not len(self.bounds):
            return -1, np.inf
        at = int(self.bounds.argmin())
        return at, float(self.bounds[at])

    def first(self, count: int) -> Indices:
        """Rows of the table with the least bounds."""
        count = min(count, len(self.rows))
        rows: Indices = self.rows[np.argpartition(self.bounds, count - 1)[:count]] if count else self.rows
        return rows

    def close(self, at: int) -> None:
        """Leave the pattern at a position out from now on."""
        self.bounds[at] = np.inf

    def price(self, cost: LeastSquares, cutoff: float) -> None:
        """Bound with other multipliers as well; patterns that cannot cost less than the cutoff are left out."""
        open_ = self.bounds < cutoff
        if self._table is None:
            self._begin(open_)
        elif 2 * np.count_nonzero(open_) < len(open_):
            self.rows, self.bounds, self._charge = self.rows[open_], self.bounds[open_], self._charge[open_]
            self._table, self._square = self._table[open_], self._square[:, open_]
        if not len(self.rows):
            return
        values = self._take(cost)
        values += self._charge
        if self._ranking.admissible.sized:
            values += self._ranking.lift(self._x[-1:], self.rows)[:, 0]
        np.maximum(self.bounds, values, out=self.bounds)

    def _begin(self, open_: BoolArray) -> None:
        """Take the open patterns' part of the table, and no multipliers as the first ones."""
        ranking, sample = self._ranking, self._sample
        without = ranking.excess(sample.moves, self._of_table)
        if 2 * np.count_nonzero(open_) < len(open_):
            self.rows, self.bounds, without = self.rows[open_], self.bounds[open_], without[open_]
            self._table = ranking.squares[self.rows]
        else:
            self._table = ranking.squares[self._of_table]
        self._charge = ranking.charges(self.rows, sample.later_data)
        x = ranking.scaled(sample.least_squares)
        self._x, self._shift, self._level = x[None], np.zeros((1, len(x))), np.array([[sample.cost]])
        self._square = without[None]
        self._rounding = 2 * ranking.rounding(x)

    def _take(self, cost: LeastSquares) -> Array:
        """Take up some multipliers; what patterns cost at least with them, and on the way to earlier ones."""
        assert self._table is not None
        ranking, (K, n) = self._ranking, self._table.shape[:2]
        x, shift = ranking.scaled(cost), cost.target - self._sample.target
        moved = float(shift.dot(shift))
        level = cost.least + moved
        self._rounding = max(self._rounding, 2 * ranking.rounding(x))
        of_x = self._table.reshape(K * n, n).dot(x).reshape(K, n)
        square = of_x.dot(x)
        square -= moved
        values = square + (level - self._rounding)
        # With s of the way: (1 - s)^2 square + 2 s (1 - s) across + s^2 (that of the earlier ones).
        slope = self._x.dot(of_x.T)
        slope -= self._shift.dot(shift)[:, None]
        slope -= square
        curvature = self._square - square
        slope *= 2
        curvature -= slope
        slope += self._level - level
        share = slope / np.minimum(curvature, -FLAT)
        share *= -0.5
        np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
        curvature *= share
        curvature += slope
        curvature *= share
        values += np.maximum(curvature.max(axis=0), 0.0)
        self._x, self._shift = np.concatenate((self._x, x[None])), np.concatenate((self._shift, shift[None]))
        self._level = np.concatenate((self._level, [[level]]))
        self._square = np.concatenate((self._square, square[None]))
        return np.asarray(values)
