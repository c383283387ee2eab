"""Zones as references: ranges of outputs, and how the parameter of a sample holds them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, as_read
from mampc.base.errors import MampcError
from mampc.program.problem import TrackingProblem

FAR = LARGEST / 4  # of an end: as good as none


@dataclass(frozen=True, eq=False)
class Zone:
    """A reference that is a range: outputs between low and high cost nothing.

    Args:
        low, high: in output units, each shape (l,), or (np + 1, l) when known ahead; infinite where there is no such
            end. Outputs without a zone in the problem have one value, low = high.

    Raises:
        MampcError: no numbers, shapes that differ, or low above high.
    """

    low: Any
    high: Any

    def __post_init__(self) -> None:
        low, high = as_read("low", self.low), as_read("high", self.high)
        if low.shape != high.shape or low.ndim not in (1, 2):
            raise MampcError(
                f"Zone: expected low and high of the same shape, (l,) or (np + 1, l), received {low.shape} and "
                f"{high.shape}"
            )
        if (low > high).any():
            raise MampcError(f"Zone: expected low <= high, received {low} and {high}")
        for name, value in (("low", low), ("high", high)):
            kept = value.copy()
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)

    @property
    def centre(self) -> Array:
        """The middle, or the only end there is; the shape of the ends, not-a-number where there is none."""
        low, high = (
            np.where(np.isinf(self.low), self.high, self.low),
            np.where(np.isinf(self.high), self.low, self.high),
        )
        return np.where(np.isinf(low), np.nan, low + (high - low) / 2)


class ZoneEnds:
    """The ends of zones as the parameter of a sample holds them: those of outputs without one are the reference.

    The lower ends of all outputs stand first, then the upper ones of zoned outputs; infinite ones are large numbers.
    Where outputs are drawn into their zones, the ends of what they are drawn to follow, lower ones and upper ones.

    Attributes:
        width: how many numbers that is.
    """

    def __init__(self, problem: TrackingProblem) -> None:
        self._zoned = np.flatnonzero(problem.zoned)
        self._single = ~problem.zoned
        widths = (problem.zone_below, problem.zone_above)
        self._below, self._above = (np.minimum(width[self._zoned], 4 * FAR) for width in widths)
        l, n_p = len(problem.zoned), problem.prediction_horizon
        self._pulled, self.width = (
            problem.zone_pull > 0,
            l + len(self._zoned) * (3 if problem.zone_pull > 0 else 1),
        )
        inner = (
            np.where(np.isfinite(widths[0]), widths[0], widths[1])[self._zoned],
            np.where(np.isfinite(widths[1]), widths[1], widths[0])[self._zoned],
        )
        self._inner = tuple(np.where(np.isfinite(width), width, 0.0) for width in inner)
        self._shapes = ((l,), (n_p + 1, l))

    def about(self, reference: Array) -> Array:
        """The zones that go with a reference, shape (..., l)."""
        own = reference[..., self._zoned]
        own = np.where(np.abs(own) < LARGEST, own, np.nan)  # no zone hides that it is no reference
        return self._ends(reference, own - self._below, own + self._above, own, own)

    def of(self, zone: Zone) -> Array:
        """Those that are given as such, shape (width,) or (np + 1, width).

        Raises:
            MampcError: another shape, or ranges of outputs that have no zone in the problem.
        """
        if zone.low.shape not in self._shapes:
            raise MampcError(
                f"reference: expected a Zone of shape {' or '.join(map(str, self._shapes))}, received {zone.low.shape}"
            )
        return self.of_rows(zone)

    def of_rows(self, zone: Zone) -> Array:
        """The same for any number of samples, shape (..., width)."""
        low, high = zone.low[..., self._single], zone.high[..., self._single]
        if ((low != high) & ~(np.isnan(low) | np.isnan(high))).any():
            raise MampcError(
                "reference: expected ranges only of outputs that have a zone in the problem, received others; give "
                "these a zone_below or zone_above"
            )
        low, high = zone.low[..., self._zoned], zone.high[..., self._zoned]
        # To the middle; where one end is missing, as far inside as the problem's zone is wide there.
        both = (low > -FAR) & (high < FAR)
        middle = np.where(both, low, 0.0) + (np.where(both, high, 0.0) - np.where(both, low, 0.0)) / 2
        aims = np.where(both, middle, low + self._inner[0]), np.where(both, middle, high - self._inner[1])
        return self._ends(zone.low, low, high, *aims)

    def _ends(self, reference: Array, low: Array, high: Array, aim_low: Array, aim_high: Array) -> Array:
        """All ends, with those of zoned outputs given; beyond FAR there is none."""
        aims = [np.maximum(aim_low, -FAR), np.minimum(aim_high, FAR)] if self._pulled else []
        ends = np.concatenate([reference, np.minimum(high, FAR), *aims], axis=-1)
        ends[..., self._zoned] = np.maximum(low, -FAR)
        return ends
