"""The noise of outputs where nobody tells it: a share of what the inputs can do to them."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.loop.disturbances import response_within_reach
from mampc.program.problem import TrackingProblem

NOISE_OF_REACH = 0.002  # of what the inputs' whole range does to an output: noise that nobody told of


def guessed_noise(problem: TrackingProblem) -> Array:
    """A 500th of what the whole range of the inputs does to each output within 20 samples, dead times aside, (l,).

    Raises:
        MampcError: inputs without limits, or an output that none of them moves.
    """
    limits, response = problem.limits, np.abs(response_within_reach(problem.model))
    width = np.where(response.any(axis=0), limits.u_max - limits.u_min, 0.0)
    reach: Array = response @ np.where(np.isfinite(width), width, np.nan)
    if not (np.isfinite(reach) & (reach > 0)).all():
        raise MampcError(
            "noise: expected standard deviations, or u_min and u_max of all inputs to guess them from, received inputs "
            "without limits, or an output that none moves"
        )
    return NOISE_OF_REACH * reach
