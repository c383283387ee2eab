"""Figures of merit of a closed-loop run: how often, how far and how well, and what that wears."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_number, as_vector, as_weight, as_whole
from mampc.base.tolerances import SAME
from mampc.program.zone import Zone

Counts = np.ndarray[tuple[int], np.dtype[np.int64]]


@dataclass(frozen=True, eq=False)
class Metrics:
    """Metrics of one run; arrays have one entry per input, shape (m,).

    Attributes:
        steps: number of samples counted.
        skipped: samples left out at the start.
        threshold: changes above it, in input units, count in `sparse_density`.
        sparse_density: share of samples at which the input changes by more than the threshold (eq. 10).
        exact_density: share of samples at which it changes at all.
        tracking_error: mean over samples of |y - r|^2 (eq. 11), in squared output units; of outputs with a zone the
            distance to it counts, which is nothing inside.
        weighted_error: mean of (y - r)' Q (y - r), counted likewise; `tracking_error` where no weights were told.
        time_outside: share of the samples at which an output has a zone that it is outside, shape (l,); not-a-number
            without one.
        mean_distance_outside: of an output from its zone at these samples, in output units, shape (l,); 0 where there
            are none, not-a-number without a zone.
        moves: number of changes per input.
        travel: sum of |du|, in input units.
        reversals: how often an input moves against its previous move.
        mean_hold_time: mean time an input stays where it is, in seconds.
        median_hold_time, longest_hold_time: of the times between moves, in seconds; the first begins and the last
            ends with the run.
        dead_band: of the actuators, in input units.
        starts: how often the actuator itself starts: each time its input has come more than its dead-band away from
            where it stands.
        starts_per_hour: of them.
    """

    steps: int
    skipped: int
    threshold: float
    sparse_density: Array
    exact_density: Array
    tracking_error: float
    weighted_error: float
    time_outside: Array
    mean_distance_outside: Array
    moves: Counts
    travel: Array
    reversals: Counts
    mean_hold_time: Array
    median_hold_time: Array
    longest_hold_time: Array
    dead_band: Array
    starts: Counts
    starts_per_hour: Array


def compute(
    u: Array,
    y: Array,
    r: Array,
    u_initial: Array,
    dt: float,
    *,
    threshold: float = 0.1,
    skip: int = 0,
    dead_band: Any = 0.0,
    position: Array | None = None,
    resolution: Any = SAME,
    zone: Zone | None = None,
    output_weight: Any = None,
) -> Metrics:
    """Metrics of a trajectory.

    Args:
        u, y, r: decided inputs (T, m), outputs (T, l) and references (T, l), engineering units.
        u_initial: inputs before the first sample, shape (m,); moving away from them counts.
        dt: sample time in seconds.
        threshold: see `Metrics`.
        skip: samples to leave out at the start, 0 <= skip < T.
        dead_band: changes that an actuator does not answer, in input units, one number or one per input.
        position: where the actuators were, shape (T, m), whose starts are counted; default the decided inputs.
        resolution: changes up to here are rounding and no moves, in input units, as in `Decision`; default 1e-9.
        zone: within which outputs cost nothing, ends of shape (T, l); default none, as where they are the reference.
        output_weight: Q of the weighted error, a scalar, one value per output, or (l, l); default 1.

    Source: paper, eqs. 10 and 11.

    Raises:
        MampcError: skip, threshold or dead-band out of range.
    """
    skip = as_whole("skip", skip, 0, len(u) - 1)
    threshold = as_number("threshold", threshold, 0.0)
    band = as_vector("dead_band", dead_band, u.shape[1], 0.0)
    changes = np.diff(np.vstack([u_initial, u]), axis=0)[skip:]
    size = np.abs(changes)
    low, high = (r, r) if zone is None else (zone.low, zone.high)
    error = (np.maximum(y - high, 0.0) - np.maximum(low - y, 0.0))[skip:]
    off = np.abs(error)
    tracking_error = weighted_error = float(np.mean(np.sum(off**2, axis=1)))
    if output_weight is not None:
        Q = as_weight("output_weight", output_weight, y.shape[1])
        weighted_error = float(np.mean(np.sum(error @ Q * error, axis=1)))
    in_zone = (high > low)[skip:]
    outside, has_zone = (off > 0) & in_zone, in_zone.any(axis=0)
    times = outside.sum(axis=0)
    mean_distance = np.where(outside, off, 0.0).sum(axis=0) / np.maximum(times, 1)
    steps, smallest = len(size), as_vector("resolution", resolution, u.shape[1])
    moved = size > smallest
    moves = moved.sum(axis=0)
    holds = [np.diff(np.concatenate([[0], np.flatnonzero(column), [steps]])) * dt for column in moved.T]
    real = np.vstack([u_initial, u if position is None else position])[skip:]
    starts = np.array([_starts(*actuator) for actuator in zip(real.T, band, smallest, strict=True)])
    return Metrics(
        steps=steps,
        skipped=skip,
        threshold=threshold,
        sparse_density=(size > threshold).sum(axis=0) / steps,
        exact_density=moves / steps,
        tracking_error=tracking_error,
        weighted_error=weighted_error,
        time_outside=np.where(has_zone, times / np.maximum(in_zone.sum(axis=0), 1), np.nan),
        mean_distance_outside=np.where(has_zone, mean_distance, np.nan),
        moves=moves,
        travel=np.where(moved, size, 0.0).sum(axis=0),
        reversals=np.array(
            [_reversals(column[kept]) for column, kept in zip(changes.T, moved.T, strict=True)]
        ),
        mean_hold_time=steps * dt / (moves + 1),
        median_hold_time=np.array([np.median(times[times > 0]) for times in holds]),
        longest_hold_time=np.array([times.max() for times in holds]),
        dead_band=band,
        starts=starts,
        starts_per_hour=starts * 3600 / (steps * dt),
    )


def _reversals(moves: Array) -> int:
    direction = np.sign(moves)
    return int(np.count_nonzero(direction[1:] != direction[:-1]))


def _starts(course: Array, dead_band: float, resolution: float) -> int:
    """How often an actuator has to start that stands at course[0] and follows beyond its dead-band."""
    moved = np.abs(np.diff(course)) > resolution
    if dead_band <= resolution:
        return int(np.count_nonzero(moved))
    starts, stands = 0, float(course[0])
    for wanted in course[1:][moved].tolist():
        if abs(wanted - stands) > dead_band:
            starts, stands = starts + 1, wanted
    return starts
