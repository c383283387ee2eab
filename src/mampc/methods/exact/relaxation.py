"""The program with some moves free, the others zero, and no rules: a relaxation of all patterns among these moves."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.least_distance import LeastDistance
from mampc.program.qp import UNBOUNDED
from mampc.program.sample import Sample


class Relaxation:
    """One solver for any set of free moves: a row per move pins it to zero, or not."""

    def __init__(self, condensed: CondensedQP) -> None:
        n, bounds, plain = condensed.n_moves, condensed.bounds, condensed.plain
        self._pinned = LeastDistance(
            condensed.U,
            np.vstack([plain.rows, np.eye(n)]),
            np.vstack([plain.violations, np.zeros((n, bounds.n_violations))]),
            condensed.problem.output_limit_weight,
        )

    def multipliers(self, sample: Sample, free: BoolArray) -> Array | None:
        """Multipliers of the limits, shape (n_bounds,), with only the moves `free`, shape (n_moves,)."""
        width = np.where(free, UNBOUNDED, 0.0)
        lower, upper = np.concatenate([sample.lower, -width]), np.concatenate([sample.upper, width])
        multipliers = self._pinned.solve(sample.moves, lower, upper).multipliers
        return None if multipliers is None else multipliers[: len(sample.lower)]
