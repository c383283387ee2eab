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
        self._ranking, self._sample, self._past = ranking, sample, past
        self._of_table = ranking.rows(past)
        self.rows: Indices = np.arange(self._of_table.start, self._of_table.start + len(bounds))
        self.bounds = bounds
        self._first: LeastSquares | None = None  # with the first multipliers priced in
        # All of these once others are priced in, too: the open part of the table and prices; per multipliers
        # (x, D, level); and per multipliers and pattern the bound, its price aside.
        self._table: Array | None = None
        self._charge: Array
        self._held: Array
        self._values: Array

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
        """Bound with other multipliers as well; patterns that cannot cost less than the cutoff are left out.

        The first ones count alone: often they are enough, and what the way between several takes is never needed.
        """
        if self._first is None:
            self._first = cost
            bounds = self._ranking.priced(cost, self._past, self._sample.later_data)
            np.maximum(self.bounds, bounds, out=self.bounds)
            return
        open_ = self.bounds < cutoff
        if self._table is None:
            self._begin(open_, self._first)
        elif 2 * np.count_nonzero(open_) < len(open_):
            self.rows, self.bounds, self._charge = self.rows[open_], self.bounds[open_], self._charge[open_]
            self._table, self._values = self._table[open_], self._values[:, open_]
        if not len(self.rows):
            return
        values, gained = self._take(cost)
        if self._ranking.admissible.sized:  # what least sizes add is known with the new multipliers alone
            x = self._held[-1:, : len(cost.target)]
            gained = np.maximum(gained, self._ranking.lift(x, self.rows)[:, 0])
        values += gained
        values += self._charge
        np.maximum(self.bounds, values, out=self.bounds)

    def _begin(self, open_: BoolArray, first: LeastSquares) -> None:
        """Take the open patterns' part of the table, and the first multipliers as earlier ones."""
        ranking, sample = self._ranking, self._sample
        if 2 * np.count_nonzero(open_) < len(open_):
            self.rows, self.bounds = self.rows[open_], self.bounds[open_]
            self._table = ranking.squares[self.rows]
        else:
            self._table = ranking.squares[self._of_table]
        self._charge = ranking.charges(self.rows, sample.later_data)
        self._held, self._values = np.empty((0, 2 * len(sample.target) + 1)), np.empty((0, len(self.rows)))
        self._rounding = 0.0
        self._take(first)

    def _take(self, cost: LeastSquares) -> tuple[Array, Array]:
        """Take up multipliers; what patterns cost at least with them, and how much more on the way to earlier ones."""
        assert self._table is not None
        ranking, (K, n) = self._ranking, self._table.shape[:2]
        x, shift = ranking.scaled(cost), cost.target - self._sample.target
        level = cost.least + float(shift.dot(shift))
        self._rounding = max(self._rounding, 2 * ranking.rounding(x))
        new = np.concatenate((x, shift, (level,)))
        # How the bound grows with x, D and the level.
        gradient = np.empty((K, 2 * n + 1))
        gradient[:, :n] = self._table.reshape(K * n, n).dot(2 * x).reshape(K, n)
        gradient[:, n : 2 * n], gradient[:, 2 * n] = -2 * shift, 1.0
        value = gradient.dot(new)
        value += level
        value *= 0.5
        # A share s of the way to earlier multipliers adds s (slope - s bend).
        slope = (self._held - new).dot(gradient.T)
        bend = slope - self._values
        bend += value
        share = slope / np.maximum(bend, FLAT)
        share *= 0.5
        np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
        bend *= share
        slope -= bend
        slope *= share
        self._held = np.concatenate((self._held, new[None]))
        self._values = np.concatenate((self._values, value[None]))
        return value - self._rounding, np.maximum.reduce(slope, initial=0.0)
