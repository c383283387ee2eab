"""Inputs that take certain levels only: positions in a list, a grid, on and off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray, as_array, as_number, as_whole
from mampc.base.errors import MampcError, shown
from mampc.program.problem import TrackingProblem

HOUR = 3600.0  # seconds
LONGEST_MEMORY = 10_000  # samples
MOST_LEVELS = 100_000
ROUNDED = 1e-9  # of a step: by how much a multiple of it may be beyond a limit that it is meant to meet


@dataclass(frozen=True, kw_only=True)
class OnOff:
    """An input that is on or off.

    Args:
        off, on: its two levels, in input units; default its limits u_min and u_max.
        min_on, min_off: seconds that it stays on, or off, at least once it has been switched.
        starts_per_hour: at most so many times it is switched on within any hour; None for no bound.

    Raises:
        MampcError: values out of range.
    """

    off: float | None = None
    on: float | None = None
    min_on: float = 0.0
    min_off: float = 0.0
    starts_per_hour: int | None = None

    def __post_init__(self) -> None:
        for name in ("off", "on"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_number(name, getattr(self, name)))
        for name in ("min_on", "min_off"):
            object.__setattr__(self, name, as_number(name, getattr(self, name), 0.0))
        if self.starts_per_hour is not None:
            as_whole("starts_per_hour", self.starts_per_hour, 1)


def as_levels(given: Any) -> Any:
    """Levels as `MoveRules` takes them, checked as far as that goes without a problem, as plain numbers."""
    if isinstance(given, np.ndarray):
        given = given.tolist()
    if given is None or isinstance(given, OnOff):
        return given
    if isinstance(given, (int, float, np.integer, np.floating)):
        return as_number("levels", given, 0.0, exclusive=True)
    if not isinstance(given, (list, tuple)) or not given:
        raise MampcError(
            f"levels: expected a step, a mampc.OnOff, or one entry per input, received {shown(given)}"
        )
    if all(entry is None for entry in given):  # no input has any
        return None
    return tuple(_as_entry(entry) for entry in given)


def _as_entry(entry: Any) -> Any:
    if entry is None or isinstance(entry, OnOff):
        return entry
    values = as_array("levels", entry)
    if values.ndim == 0:
        if not (np.isfinite(values) and values > 0):
            raise MampcError(
                f"levels: expected a step above 0, received {shown(entry)}; levels of one input are a list "
                "in the list, such as levels=[[0, 40, 100]]"
            )
        return float(values)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise MampcError(f"levels: expected finite numbers in one list per input, received {shown(entry)}")
    return tuple(sorted(set(values.tolist())))


class Timing(NamedTuple):
    """When an input may be switched, in samples.

    Attributes:
        on, off: its levels.
        min_on, min_off: how long it stays there at least.
        most: starts in any `window` samples, None for no bound.
    """

    on: float
    off: float
    min_on: int
    min_off: int
    most: int | None
    window: int


class InputLevels:
    """The levels of all inputs of one problem.

    Attributes:
        values: of each input, in order, within its limits; None for one that takes any value.
        timings: of each input, None without.
        memory: how many past inputs the timings look back on.

    Raises:
        MampcError: entries that do not fit the problem.
    """

    def __init__(self, given: Any, problem: TrackingProblem) -> None:
        m, limits, dt = problem.model.n_inputs, problem.limits, problem.model.dt
        given = given if isinstance(given, tuple) else (given,) * m
        if len(given) != m:
            raise MampcError(
                f"levels: expected one entry for each of {m} inputs, received {len(given)}; levels of one input are a "
                "list in the list, such as levels=[[0, 40, 100]]"
            )
        ranges = list(zip(limits.u_min.tolist(), limits.u_max.tolist(), strict=True))
        self.timings = tuple(
            _timing(entry, low, high, dt) if isinstance(entry, OnOff) else None
            for entry, (low, high) in zip(given, ranges, strict=True)
        )
        self.values = tuple(
            _values(entry, timing, low, high)
            for entry, timing, (low, high) in zip(given, self.timings, ranges, strict=True)
        )
        self._known = tuple(frozenset() if v is None else frozenset(v.tolist()) for v in self.values)
        self.memory = max(
            (max(t.min_on, t.min_off, 0 if t.most is None else t.window) + 1 for t in self.timings if t),
            default=1,
        )

    def missed(self, u: Array) -> BoolArray:
        """Which inputs, shape (m,), are not on their levels."""
        return np.array([
            values is not None and value not in known
            for value, values, known in zip(u.tolist(), self.values, self._known, strict=True)
        ])  # fmt: skip

    def nearest(self, u: Array, low: Array, high: Array) -> Array:
        """The levels within limits nearest to inputs; all of shape (..., m).

        Where no level is within the limits, the limits are kept.
        """
        nearest = np.minimum(np.maximum(u, low), high)
        for a, values in enumerate(self.values):
            if values is None:
                continue
            least = np.searchsorted(values, low[..., a])
            most = np.searchsorted(values, high[..., a], side="right") - 1
            above = np.minimum(np.searchsorted(values, u[..., a]), len(values) - 1)
            below = np.maximum(above - 1, 0)
            at = np.where(values[above] - u[..., a] < u[..., a] - values[below], above, below)
            at = np.minimum(np.maximum(at, least), most)
            nearest[..., a] = np.where(least <= most, values[np.maximum(at, 0)], nearest[..., a])
        return nearest


def _timing(entry: OnOff, low: float, high: float, dt: float) -> Timing:
    off, on = (low if entry.off is None else entry.off), (high if entry.on is None else entry.on)
    if not (
        np.isfinite(off) and np.isfinite(on) and off != on and low <= min(off, on) and max(off, on) <= high
    ):
        raise MampcError(
            f"levels: expected two levels of an OnOff within the limits {low:g} and {high:g} of its input, received "
            f"off={off:g} and on={on:g}"
        )
    min_on, min_off, window = (
        int(np.ceil(seconds / dt - ROUNDED)) for seconds in (entry.min_on, entry.min_off, HOUR)
    )
    if max(min_on, min_off, 0 if entry.starts_per_hour is None else window) >= LONGEST_MEMORY:
        raise MampcError(
            f"levels: expected times of an OnOff below {LONGEST_MEMORY} samples of {dt:g} s, received {entry}"
        )
    return Timing(on, off, max(min_on, 1), max(min_off, 1), entry.starts_per_hour, window)


def _values(entry: Any, timing: Timing | None, low: float, high: float) -> Array | None:
    values: Array
    if entry is None:
        return None
    if timing is not None:
        return np.array(sorted((timing.off, timing.on)))
    if isinstance(entry, tuple):
        values = np.array(entry)
        values = values[(values >= low) & (values <= high)]
        if not len(values):
            raise MampcError(
                f"levels: expected some within the limits {low:g} and {high:g}, received {entry}"
            )
        return values
    first, last = np.ceil(low / entry - ROUNDED), np.floor(high / entry + ROUNDED)
    if not np.isfinite(last - first) or not 0 <= last - first < MOST_LEVELS:
        raise MampcError(
            f"levels: expected a step of which 1 to {MOST_LEVELS} multiples are within u_min and u_max, received "
            f"{entry:g} within {low:g} and {high:g}"
        )
    values = np.minimum(np.maximum(entry * np.arange(first, last + 1), low), high)
    return values
