"""The patterns of the table that may still be best, and multipliers that bound them.

The bound of a pattern is concave in the multipliers, and the best ones differ from pattern to pattern. Those that turn
up belong to single patterns; for another one, multipliers somewhere between two of them are often better than both.
So new ones are taken up together with points on the way to all earlier ones. With x the free optimum where limits are
priced in, and D what the target has moved by, both affine in the multipliers, the bound is

    level + x' T x - |D|^2 + price of the pattern        T: its row of the table

and all points are one product of matrices.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.methods.exact.ranking import Ranking
from mampc.moves.admissible import Allowance
from mampc.program.sample import Indices, LeastSquares, Sample

SHARES = (1 / 3, 2 / 3)  # of the way from new multipliers to earlier ones


class OpenPatterns:
    """Those of one sample.

    Args:
        ranking: the table.
        sample, past: its data, and what the past allows.
        bounds: without limits, as `Ranking` gives them for all patterns that the past allows.
        first: the cost with limits priced in by the first multipliers; None where there are none.

    Attributes:
        rows: of the table, shape (K,).
        bounds: on what each costs, shape (K,).
    """

    def __init__(
        self, ranking: Ranking, sample: Sample, past: Allowance, bounds: Array, first: LeastSquares | None
    ) -> None:
        self._ranking, self._sample = ranking, sample
        if first is not None:
            bounds = np.maximum(bounds, ranking.priced(first, past, sample.later_data))
        self.rows, self.bounds = np.arange(len(bounds)) + ranking.rows(past).start, bounds
        self._points: Array = self._point(sample.least_squares if first is None else first)[None]
        self._table: Array | None = (
            None  # of the rows, and what patterns cost beside: needed from the second point on
        )

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
        open_, ranking, n = self.bounds < cutoff, self._ranking, len(self._sample.target)
        if self._table is None or 2 * np.count_nonzero(open_) < len(open_):
            self.rows, self.bounds = self.rows[open_], self.bounds[open_]
            self._table, self._charge = (
                ranking.table[self.rows],
                ranking.charges(self.rows, self._sample.later_data),
            )
        point = self._point(cost)
        self._points = np.concatenate((self._points, point[None]))
        between = np.concatenate([point + share * (self._points - point) for share in SHARES])
        x, shift, level = between[:, :n], between[:, n:-1], between[:, -1]
        values = self._table @ ranking.products(x).T
        values += level - np.einsum("ji,ji->j", shift, shift) - ranking.rounding(x)
        if ranking.admissible.sized:
            values += ranking.lift(x, self.rows)
        np.maximum(self.bounds, values.max(axis=1) + self._charge, out=self.bounds)

    def _point(self, cost: LeastSquares) -> Array:
        """x, D and the level of some multipliers, shape (2 n + 1,)."""
        shift = cost.target - self._sample.target
        return np.concatenate((self._ranking.scaled(cost), shift, (cost.least + float(shift.dot(shift)),)))
