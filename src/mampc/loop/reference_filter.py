"""Reference filters: what a controller tracks on the way from the last reference to the one asked for now.

With r_i the reference at sample i, w the one that is tracked, T the time constant, dt the sample time and v the rate,

    w'_i = r_i + exp(-dt / T) (w_{i-1} - r_i),    w_i = w_{i-1} + what of w'_i - w_{i-1} is within +- v dt.

The same is predicted over the horizon, so that plans know the whole way and what they know comes true.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_array, as_vector
from mampc.base.errors import MampcError, shown


@dataclass(frozen=True, kw_only=True)
class ReferenceFilter:
    """How fast a reference may change, whatever steps an operator makes; each a number or one per output.

    Args:
        time_constant: seconds, of a first-order lag; 0 for none.
        rate: output units per second, of a ramp; None for none, as infinity for one output.

    Raises:
        MampcError: negative numbers, a rate of zero.

    Example:
        >>> import mampc
        >>> smooth = mampc.ReferenceFilter(time_constant=60.0)  # mampc.Regulator(..., reference_filter=smooth)
    """

    time_constant: Any = 0.0
    rate: Any = None

    def __post_init__(self) -> None:
        for name, low in (("time_constant", "at least 0"), ("rate", "above 0")):
            given = np.inf if name == "rate" and self.rate is None else getattr(self, name)
            value = as_array(name, given)
            fits = (value > 0).all() if name == "rate" else (np.isfinite(value) & (value >= 0)).all()
            if value.ndim > 1 or not fits:
                raise MampcError(
                    f"{name}: expected one number {low} or one per output, received {shown(given)}"
                )
            if name == "time_constant" or self.rate is not None:
                object.__setattr__(self, name, tuple(value.tolist()) if value.ndim else float(value))

    def fitted(self, n_outputs: int, dt: float) -> FittedFilter:
        """The filter of so many outputs at a sample time in seconds; `MampcError` if values do not fit."""
        lag = as_vector("time_constant", self.time_constant, n_outputs)
        rate = as_array("rate", np.inf if self.rate is None else self.rate)
        if rate.shape not in ((), (n_outputs,)):
            raise MampcError(f"rate: expected a scalar or {n_outputs} values, received shape {rate.shape}")
        kept = np.exp(-dt / np.where(lag > 0, lag, 1.0)) * (lag > 0)
        return FittedFilter(kept, np.broadcast_to(rate * dt, (n_outputs,)))


class FittedFilter:
    """A filter at one sample time.

    Args:
        kept: of the way to the reference after a sample, shape (l,).
        most: change in a sample, infinite for no ramp, shape (l,).
    """

    def __init__(self, kept: Array, most: Array) -> None:
        self._kept, self._most = kept, most
        self._ramps = bool(np.isfinite(most).any())

    def course(self, last: Array, reference: Array, samples: int) -> Array:
        """What is tracked at so many samples, the next one first, shape (..., samples, l).

        Args:
            last: tracked at the sample before, shape (..., l).
            reference: shape (..., l), or (..., samples, l) when known ahead.
        """
        ahead = reference.ndim > last.ndim
        course = np.empty((*last.shape[:-1], samples, last.shape[-1]))
        for i in range(samples):
            asked = reference[..., i, :] if ahead else reference
            tracked = asked + self._kept * (last - asked)
            if self._ramps:  # in this order a reference within reach is met to the last digit
                tracked = np.minimum(np.maximum(tracked, last - self._most), last + self._most)
            course[..., i, :] = last = tracked
        return course
