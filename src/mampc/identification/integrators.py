"""Integrators: which slow poles are poles at one.

No record tells a pole at one from one so near to it that it hardly decays while the record lasts; yet a
controller, an estimator and a rest of the plant are of another kind with one and with the other. The test:
poles are taken to be at one if they are within `SLOW` / N of it, N being the samples of the longest record
(the interval in which Dickey and Fuller, J. Amer. Stat. Assoc. 74 (1979), do not refuse a pole at one), and
the model with them moved there, everything else fitted again, explains the record as well.
"""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.systems.modes import apart

SLOW = 5.0
AS_WELL = 1.01  # simulation errors that are as good as equal
CHANCE = 4.0  # a square of two standard deviations


def near_one(A: Array, samples: int) -> list[int]:
    """How many poles may be at one: numbers of poles, largest first, that a distance from one sets apart."""
    distance = np.sort(np.abs(np.linalg.eigvals(A) - 1.0))
    near = int(np.count_nonzero(distance < SLOW / samples))
    return [q for q in range(near, 0, -1) if q == len(A) or distance[q] > distance[q - 1] * (1 + 1e-9)]


def with_integrators(A: Array, C: Array, count: int) -> tuple[Array, Array]:
    """A and C in coordinates in which the `count` poles nearest to one are the first states, and exactly one."""
    n = len(A)
    distance = np.sort(np.abs(np.linalg.eigvals(A) - 1.0))
    radius = np.inf if count == n else np.sqrt(distance[count - 1] * distance[count])
    radius = max(radius, distance[count - 1] * (1 + 1e-12))
    fixed, T, found = apart(A, lambda pole: abs(pole - 1.0) <= radius)
    if found != count:
        raise ValueError(f"expected {count} poles near one, found {found}")
    fixed[:count, :count] = np.eye(count)
    return fixed, C @ T


def explains_as_well(error: float, free: float, independent: float) -> bool:
    """Whether a simulation error is no more than `AS_WELL` times the free one, or than chance makes it.

    Args:
        independent: how many independent numbers the residuals amount to.
    """
    return error <= AS_WELL * free or independent * ((error / free) ** 2 - 1.0) <= CHANCE
