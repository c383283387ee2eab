"""Every tolerance that decides what a move is, and the order they need.

Lengths are in input units, times the prefix (micro, milli, kilo, ...) in which the input is a number of ordinary size,
as `prefix` gives it: an actuator's resolution does not depend on where it stands, and a move is one in any unit.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from mampc.base.checks import Array

SAME = 1e-9  # inputs nearer than this are the same, so that rounding is no move
KEPT = 1e-9  # an input that does not move keeps limits up to rounding
INSIDE = 1e-9  # a distance to a limit that no rounding can make up
ROUNDING = 1e-8  # a smaller planned move may be none
NOTHING = 1e-11  # a smaller planned move is none, and the others need not make up for it
SMALLER = 1e-8  # a move that falls short of its least size by no more is rounded up to it
URGENT = 1e-6  # scaled violation: what suspending the rules has to gain at least
CERTAIN = 1e-9  # of the optimum: what a proof may be wrong by
TIE = 1e-10  # of the optimum: plans nearer than this are equally good

# What is dropped at once is no move, and every move is looked at before it counts.
assert NOTHING < SAME <= ROUNDING
# An input that goes back to its limit by no more has not moved.
assert max(KEPT, INSIDE) <= SAME
# Equally good plans do not spoil a proof.
assert TIE < CERTAIN
# A move rounded up to its least size is one.
assert SAME < SMALLER


def tie(objective: float, rounding: float = 0.0) -> float:
    """How near two objectives are that are equally good: TIE, or what rounding leaves open.

    Args:
        objective: a sum of squares, or priced inputs beyond their limits, which may cost less than nothing.
        rounding: of the length whose square it is.
    """
    return TIE * abs(objective) + left_open(objective, rounding) if objective < float("inf") else 0.0


def left_open(objective: float, rounding: float) -> float:
    """How far an objective may be from the truth, a sum of squares whose root is known to within `rounding`."""
    return (2 * sqrt(max(objective, 0.0)) + rounding) * rounding


def prefix(size: Array) -> Array:
    """The power of a thousand in which each input is a number of ordinary size, given that of a move, shape (m,)."""
    power: Array = 1000.0 ** np.round(np.log(size) / np.log(1000.0))
    return power


def size_of_move(curvature: Array, width: Array) -> Array:
    """A move of each input that matters, all of shape (m,).

    Args:
        curvature: what its first move of size one costs, to the second order.
        width: of its range, infinite or zero where it has none.
    """
    size: Array = 3 / np.sqrt(curvature)
    wide = np.isfinite(width) & (width > 0)
    return np.where(wide, np.minimum(np.maximum(size, 1e-5 * width), width), size)
