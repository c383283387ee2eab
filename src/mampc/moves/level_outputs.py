"""What the moves decided so far make of outputs with limits or zones, whatever the later moves will be."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Indices, Sample


class LimitedOutputs:
    """Predicted outputs beyond their limits, for many courses at once.

    Attributes:
        last: the last sample at which a move shows in each row; -1 for none, shape (rows,).
    """

    def __init__(self, condensed: CondensedQP) -> None:
        bounds, m = condensed.bounds, condensed.problem.model.n_inputs
        self._bounds, self._weights = bounds, condensed.problem.output_limit_weights
        rows, self._output, self._fading = bounds.output_rows()
        self.rows = rows
        self.last = _last_sample(rows, m)
        self._n_outputs = condensed.problem.model.n_outputs
        self._scale = bounds.violation_scale[self._output] / self._fading

    def room(self, sample: Sample) -> Array:
        """How far the rows are from their limits without moves, shape (rows,)."""
        above, below = self._bounds.above_rows, self._bounds.below_rows
        return np.concatenate([sample.upper[above], -sample.lower[below]])

    def excess(self, d: Array, room: Array, of: BoolArray, before: Array) -> Array:
        """The largest scaled excess of each output in the rows `of` and before, shape (K, l)."""
        excess = before.copy()
        over = (d @ self.rows[of].T - room[of]) * self._scale[of]
        for column, output in zip(over.T, self._output[of], strict=True):
            np.maximum(excess[:, output], column, out=excess[:, output])
        return excess

    def penalty(self, excess: Array) -> Array:
        """What violations cost, shape (K,)."""
        return np.asarray((excess + 0.5 * excess * excess) @ self._weights)

    def none(self, count: int) -> Array:
        return np.zeros((count, self._n_outputs))


class ZonedOutputs:
    """Squared errors of values that have zones, for many courses at once; `last` as in `LimitedOutputs`."""

    def __init__(self, condensed: CondensedQP) -> None:
        zones = condensed.bounds.zones
        assert zones is not None
        self._theta, self._root, self._rows = zones.theta, zones.root, condensed.bounds.zone_rows
        self.last = _last_sample(self._theta, condensed.problem.model.n_inputs)

    def cost(self, d: Array, sample: Sample, of: BoolArray) -> Array:
        """That of the rows `of`, shape (K,)."""
        values, low, high = d @ self._theta[of].T, sample.lower[self._rows][of], sample.upper[self._rows][of]
        errors = self._root[of] * (values - np.minimum(np.maximum(values, low), high))
        cost: Array = np.square(errors).sum(axis=1)
        return cost


def _last_sample(rows: Array, m: int) -> Indices:
    """The last sample at which a move shows in each row, shape (k,); -1 for none."""
    last = rows.shape[1] - 1 - (rows != 0)[:, ::-1].argmax(axis=1)
    return np.where(rows.any(axis=1), last, -m) // m
