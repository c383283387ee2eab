"""The curvature that zones leave, about the moves of a program.

With c the middle of a zone, h its half width and t = dist(g, zone), the squared distance of any other value g' is at
least

    t^2 + slope (g' - g) + alpha (g' - g)^2,    alpha = t / (h + t)

since alpha (g' - c)^2 - h t touches it at g and is below it everywhere. So about the moves of a program the cost curves
at least as U'U + sum_k alpha_k q_k theta_k' theta_k does: as with set points far outside the zones, and not at all
inside.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Indices, Sample


class ZoneCurvature:
    """Of one sample.

    Args:
        condensed: the problem.
        normal: U'U of the moves in `order`, and a row and column behind it, shape (n + 1, n + 1).
        order: of the moves.
        sample: whose zones count.
    """

    def __init__(self, condensed: CondensedQP, normal: Array, order: Indices, sample: Sample) -> None:
        zones, rows = condensed.bounds.zones, condensed.bounds.zone_rows
        assert zones is not None
        n = len(order)
        self._normal, self._theta, self._root = normal[:n, :n], zones.theta[:, order], zones.root
        self._low, self._high = sample.lower[rows], sample.upper[rows]
        self._half = 0.5 * (self._high - self._low)

    def variance(self, moves: Array, within: BoolArray) -> Array:
        """The diagonal of the inverse curvature in the moves `within`, about moves (n,); zero for the others."""
        values = self._theta @ moves
        away = np.maximum(np.maximum(self._low - values, values - self._high), 0.0)
        total = away + self._half
        alpha = np.where(total > 0, away / np.where(total > 0, total, 1.0), 1.0)
        rows = (self._root * np.sqrt(alpha))[:, None] * self._theta[:, within]
        curvature = self._normal[np.ix_(within, within)] + rows.T @ rows
        variance = np.zeros(len(moves))
        variance[within] = np.diag(np.linalg.inv(curvature))
        return variance
