"""Outputs that drift like a random walk: changes explained instead of levels, noise not magnified.

White noise of variance v and a random walk with steps of variance q are, together, one white sequence through
(1 - theta z^-1) / (1 - z^-1), where theta + 1 / theta = 2 + q / v. The inverse of that filter, on inputs and outputs
alike, leaves the plant as it is and its disturbance white: plain differences where there is no noise, hardly more
than a mean taken off where there is no walk.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mampc.base.checks import Array
from mampc.identification.scaling import Scaled

SLOWEST = 0.95  # largest theta: beyond it a constant does as well
SIGNIFICANT = (
    7.0  # twice the logarithm of likelihoods by which a walk has to explain more than white noise does
)
SLOW_POLES = (1.0, *(1 - 0.003 * 1.6 ** np.arange(12)))  # down to a walk of 0.7 times the white noise
_SETTLED = 3.0  # time constants of the filter until its start is forgotten


def white_and_walk(residuals: Sequence[Array]) -> tuple[Array, Array]:
    """Standard deviations of the white noise and of the walk's steps in residuals (N, l), shapes (l,).

    From the variance of their changes, 2 v + q, and the covariance of successive ones, -v.
    """
    changes = [np.diff(residual, axis=0) for residual in residuals]
    count = sum(max(0, len(change) - 1) for change in changes)
    together = sum((change[1:] * change[:-1]).sum(axis=0) for change in changes) / max(count, 1)
    variance = np.concatenate(changes).var(axis=0)
    white = np.clip(-together, 0.0, variance / 2)
    return np.sqrt(white), np.sqrt(np.maximum(variance - 2 * white, 0.0))


def noise_and_walk(residuals: Sequence[Array]) -> tuple[Array, Array]:
    """The same where residuals also hold what the model lacks, which is smooth and passes for a walk.

    Second differences hardly see it; of white noise v their covariance two samples apart is v. The larger white
    part of both counts.
    """
    white, walk = white_and_walk(residuals)
    bends = [np.diff(residual, 2, axis=0) for residual in residuals]
    count = sum(max(0, len(bend) - 2) for bend in bends)
    apart = sum((bend[2:] * bend[:-2]).sum(axis=0) for bend in bends) / max(count, 1)
    variance = 2 * white**2 + walk**2
    larger = np.clip(np.maximum(white**2, apart), 0.0, variance / 2)
    white, walk = np.sqrt(larger), np.sqrt(np.maximum(variance - 2 * larger, 0.0))
    for i in range(len(walk)):
        likely = _likeliest([residual[:, i] for residual in residuals])
        white[i], walk[i] = (white[i], walk[i]) if likely is None else likely
    return white, walk


def _likeliest(residuals: Sequence[Array]) -> tuple[float, float] | None:
    """White noise and a small walk by likelihood, which changes alone hardly tell; None where the walk is not small."""
    left = np.array([_left(residuals, pole) for pole in SLOW_POLES])
    N = sum(map(len, residuals))
    best = int(np.argmin(left))
    if best == len(SLOW_POLES) - 1:
        return None
    if N * np.log(left[0] / left[best]) < SIGNIFICANT:
        best = 0
    pole, spread = SLOW_POLES[best], float(np.sqrt(left[best] / N))
    return spread * float(np.sqrt(pole)), spread * (1 - pole)


def _left(residuals: Sequence[Array], pole: float) -> float:
    """The sum of squares of what that filter makes of residuals, its state at the start of each free."""
    total = 1e-300
    for residual in residuals:
        start = pole ** np.arange(len(residual))
        filtered = whitened(residual[:, None], pole)[:, 0]
        total += float(np.sum((filtered - start * (start @ filtered) / (start @ start)) ** 2))
    return total


def theta(white: Array, walk: Array) -> float:
    """The filter's pole for the output that drifts most, 0 to `SLOWEST`."""
    return float(min(SLOWEST, whitening_pole(white, walk).min()))


def whitening_pole(white: Array, walk: Array) -> Array:
    """The filter's pole for each output: 0 for a walk alone, 1 for white noise alone."""
    middle = 1 + np.minimum(walk / np.maximum(white, 1e-6 * walk + 1e-300), 1e6) ** 2 / 2
    pole: Array = 1 / (middle + np.sqrt(middle**2 - 1))
    return pole


def high_passed(records: Scaled, pole: float) -> Scaled:
    """All signals through (1 - z^-1) / (1 - pole z^-1), without the time that its start takes to settle."""
    skipped = 1 + round(_SETTLED / (1 - pole)) if pole else 1
    return replace(
        records,
        u=tuple(whitened(u, pole)[min(skipped, len(u) // 4) :] for u in records.u),
        y=tuple(whitened(y, pole)[min(skipped, len(y) // 4) :] for y in records.y),
    )


def whitened(signal: Array, pole: float) -> Array:
    """One signal (N, p) through that filter, which takes the first sample for a rest."""
    from scipy.signal import lfilter

    changes = np.diff(signal, axis=0, prepend=signal[:1])
    filtered: Array = lfilter([1.0], [1.0, -pole], changes, axis=0)
    return filtered
