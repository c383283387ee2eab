"""Fronts: how few moves a method needs at a given tracking error, over its settings.

A method has one point a setting: moves and errors in the same loops (seeds), beside those of plain MPC. Its front are
the points that no other of its points beats in both; between them the logarithm of the moves is linear in the error.
Standard errors are the jackknife's: each loop is left out once, and everything is computed again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array

FEWEST = 0.5  # moves a loop that count where there are none, so that logarithms are finite
RATIOS = (1.05, 1.1, 1.25, 1.5)  # of tables


@dataclass(frozen=True, eq=False)
class Point:
    """One setting of a method in S loops.

    Attributes:
        method: its name.
        value: of its knob.
        moves: input changes of each loop, shape (S,).
        error: tracking error of each loop, shape (S,).
    """

    method: str
    value: float
    moves: Array
    error: Array


class Estimate(NamedTuple):
    """A number and its standard error; not-a-number where the method never gets there."""

    value: float
    standard_error: float


def error_ratio(point: Point, baseline: Point) -> float:
    """The point's mean error over that of plain MPC in the same loops."""
    return float(point.error.mean() / baseline.error.mean())


def non_dominated(moves: Array, errors: Array) -> Array:
    """Indices of the points that no other beats in both, errors rising and moves falling."""
    order = np.lexsort((moves, errors))
    best, kept = np.inf, []
    for i in order.tolist():
        if moves[i] < best:
            best = moves[i]
            kept.append(i)
    return np.array(kept, dtype=np.intp)


def moves_at(points: Sequence[Point], baseline: Point, ratio: float) -> Estimate:
    """Mean moves of a method where its error is `ratio` times that of plain MPC, over those of plain MPC.

    Args:
        points: of one method, all in the loops of the baseline.
        baseline: plain MPC.
        ratio: of the errors, above 1.
    """
    moves, errors = np.array([p.moves for p in points]), np.array([p.error for p in points])
    loops = len(baseline.moves)
    value = _at(moves, errors, baseline.moves, baseline.error, ratio)
    if loops < 2 or not np.isfinite(value):
        return Estimate(value, float("nan"))
    left_out = []
    for s in range(loops):
        kept = np.arange(loops) != s
        left_out.append(
            _at(moves[:, kept], errors[:, kept], baseline.moves[kept], baseline.error[kept], ratio)
        )
    spread = np.array(left_out)
    spread = spread[np.isfinite(spread)]
    if len(spread) < 2:
        return Estimate(value, float("nan"))
    return Estimate(value, float(np.sqrt((loops - 1) * spread.var())))


def _at(moves: Array, errors: Array, base_moves: Array, base_errors: Array, ratio: float) -> float:
    mean = np.maximum(moves.mean(axis=1), FEWEST)
    error = errors.mean(axis=1) / base_errors.mean()
    front = non_dominated(mean, error)
    error, mean = error[front], mean[front]
    if error[0] > ratio:
        return float("nan")
    logarithm = np.interp(ratio, error, np.log(mean))
    return float(np.exp(logarithm) / max(base_moves.mean(), FEWEST))
