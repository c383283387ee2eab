"""Figures of merit of a closed-loop run: how often, how far and how well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.base.tolerances import SAME


@dataclass(frozen=True, eq=False)
class Metrics:
    """Metrics of one run; arrays have one entry per input, shape (m,).

    Attributes:
        steps: number of samples counted.
        skipped: samples left out at the start.
        threshold: changes above it, in input units, count in `sparse_density`.
        sparse_density: share of samples at which the input changes by more than the threshold (eq. 10).
        exact_density: share of samples at which it changes at all.
        tracking_error: mean over samples of |y - r|^2 (eq. 11), in squared output units.
        moves: number of changes per input.
        travel: sum of |du|, in input units.
        reversals: how often an input moves against its previous move.
        mean_hold_time: mean time an input stays where it is, in seconds.
    """

    steps: int
    skipped: int
    threshold: float
    sparse_density: Array
    exact_density: Array
    tracking_error: float
    moves: np.ndarray[tuple[int], np.dtype[np.int64]]
    travel: Array
    reversals: np.ndarray[tuple[int], np.dtype[np.int64]]
    mean_hold_time: Array


def compute(
    u: Array, y: Array, r: Array, u_initial: Array, dt: float, *, threshold: float = 0.1, skip: int = 0
) -> Metrics:
    """Metrics of a trajectory.

    Args:
        u, y, r: applied inputs (T, m), outputs (T, l) and references (T, l), engineering units.
        u_initial: inputs before the first sample, shape (m,); moving away from them counts.
        dt: sample time in seconds.
        threshold: see `Metrics`.
        skip: samples to leave out at the start, 0 <= skip < T.

    Source: paper, eqs. 10 and 11.

    Raises:
        MampcError: skip or threshold out of range.
    """
    skip = as_whole("skip", skip, 0, len(u) - 1)
    threshold = as_number("threshold", threshold, 0.0)
    changes = np.diff(np.vstack([u_initial, u]), axis=0)[skip:]
    size = np.abs(changes)
    steps, moved = len(size), size > SAME
    moves = moved.sum(axis=0)
    return Metrics(
        steps=steps,
        skipped=skip,
        threshold=threshold,
        sparse_density=(size > threshold).sum(axis=0) / steps,
        exact_density=moves / steps,
        tracking_error=float(np.mean(np.sum((y[skip:] - r[skip:]) ** 2, axis=1))),
        moves=moves,
        travel=np.where(moved, size, 0.0).sum(axis=0),
        reversals=np.array(
            [_reversals(column[kept]) for column, kept in zip(changes.T, moved.T, strict=True)]
        ),
        mean_hold_time=steps * dt / (moves + 1),
    )


def _reversals(moves: Array) -> int:
    direction = np.sign(moves)
    return int(np.count_nonzero(direction[1:] != direction[:-1]))
