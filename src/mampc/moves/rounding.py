"""Plans without moves that are too small to count."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.tolerances import NOTHING, ROUNDING, SAME
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Sample


def without_rounding(condensed: CondensedQP, sample: Sample, moves: Array) -> Array:
    """The moves with inputs exactly within their limits, and changes too small to count exactly zero."""
    small = np.abs(moves) / condensed.move_prefix
    nothing = small <= NOTHING
    if (nothing | (small > ROUNDING)).all():
        return np.where(nothing, 0.0, moves)
    limits, u = condensed.problem.limits, sample.u_previous
    inputs = u + moves.reshape(-1, len(u)).cumsum(axis=0)
    inputs = np.concatenate((u[None], np.minimum(np.maximum(inputs, limits.u_min), limits.u_max)))
    changes: Array = inputs[1:] - inputs[:-1]
    if sample.frozen is not None:  # in manual, wherever that is
        changes[:, ~moves.reshape(changes.shape).any(axis=0)] = 0.0
    changes[np.abs(changes) <= SAME * condensed.input_prefix] = 0.0
    return changes.ravel()
