"""Reference filters: what a controller tracks on the way from the last reference to the one asked for now.

With r_i the reference at sample i, w the one that is tracked, T the time constant, dt the sample time and v the rate,

    w'_i = r_i + exp(-dt / T) (w_{i-1} - r_i),    w_i = w_{i-1} + what of w'_i - w_{i-1} is within +- v dt.

The same is predicted over the horizon, so that plans know the whole way and what they know comes true. Both ends of a
`Zone` go such ways. An end that is asked for where there was none starts from the output; if that
is within, it is there at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, as_array, as_read, as_shaped, as_vector, is_usable
from mampc.base.errors import MampcError, shown
from mampc.program.zone import FAR, Zone


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

    def update(
        self, last: Array, reference: Any, samples: int, y: Array, *, restart: bool
    ) -> tuple[Any, Array]:
        """What is tracked at so many samples, the next one first, and at that one.

        Args:
            last: tracked at the sample before, shape (l,), or the ends of a zone, shape (2, l).
            reference: asked for now: shape (l,), or (samples, l) when known ahead, or a `Zone` of these shapes.
            y: outputs now, shape (l,), from which the way starts.
            restart: whether it starts now; it does too where a zone comes after set points, or they after a zone.

        Returns:
            A course of shape (samples, l) or a `Zone` of it, and shape (l,) or (2, l). What is not usable is handed on.
        """
        shape = self._kept.shape
        if isinstance(reference, Zone):
            shape = ((samples,) if reference.low.ndim == 2 else ()) + shape
            low, high = (as_shaped("reference", end, shape) for end in (reference.low, reference.high))
            asked = np.where(low == high, low, np.clip([low, high], -FAR, FAR))
            if not is_usable(asked.ravel()):
                return reference, last
            now = asked[:, 0] if asked.ndim == 3 else asked
            y = np.where(np.abs(y) < LARGEST, y, now[0])
            if restart or last.ndim == 1:
                last = np.where(now[0] == now[1], y, np.array([[-FAR], [FAR]]))
            course = self.ends(last, asked, y, samples)
            return Zone(*course), course[:, 0]
        asked = as_read("reference", reference)
        asked = as_shaped("reference", asked, ((samples,) if asked.ndim == 2 else ()) + shape)
        if last.ndim == 2:
            restart, last = True, last[0]
        if restart:
            last = np.where(np.abs(y) < LARGEST, y, last)
        if not is_usable(asked.ravel()):
            return asked, last
        course = self.course(last, asked, samples)
        return course, course[0]

    def course(self, last: Array, reference: Array, samples: int) -> Array:
        """What is tracked at so many samples, the next one first, shape (..., samples, l).

        Args:
            last: tracked at the sample before, shape (..., l).
            reference: shape (..., l), or (..., samples, l) when known ahead.
        """
        ahead = reference.ndim > last.ndim
        course = np.empty((*last.shape[:-1], samples, last.shape[-1]))
        for i in range(samples):
            last = self._next(last, reference[..., i, :] if ahead else reference)
            course[..., i, :] = last
        return course

    def ends(self, last: Array, asked: Array, y: Array, samples: int) -> Array:
        """The ends of zones at so many samples, the next one first, shape (2, samples, l); beyond `FAR` there is none.

        Args:
            last: of the sample before, shape (2, l), lower ends first.
            asked: shape (2, l), or (2, samples, l) when known ahead.
            y: outputs now, shape (l,), from which ends start where there was none.
        """
        course = np.empty((2, samples, last.shape[-1]))
        for i in range(samples):
            now = asked[:, i] if asked.ndim == 3 else asked
            none, before = np.abs(now) >= FAR, np.abs(last) >= FAR
            first = np.minimum(np.minimum(y, now[0]), last[1]), np.maximum(np.maximum(y, now[1]), last[0])
            last = np.where(none, now, self._next(np.where(before, first, last), now))
            last[0] = np.minimum(*last)  # whatever rounding does
            course[:, i] = last
        return course

    def _next(self, last: Array, asked: Array) -> Array:
        """What is tracked a sample later."""
        tracked: Array = asked + self._kept * (last - asked)
        if self._ramps:  # in this order a reference within reach is met to the last digit
            tracked = np.minimum(np.maximum(tracked, last - self._most), last + self._most)
        return tracked
