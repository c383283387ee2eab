"""Loads of every kind, drawn by a seed: what disturbs a loop at its inputs, its outputs or where it is measured.

`mampc.loads.RandomWalk(size=0.5)` and the others say how a load wanders; `simulate(..., loads=(...))` draws them with
its seed. A load of your own is any object with an `at` and a `draw` like theirs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from mampc.base.checks import Array, as_array, as_choice, as_matrix, as_number, as_one_or_each, as_vector
from mampc.base.errors import MampcError, shown
from mampc.systems.state_space import StateSpace

if TYPE_CHECKING:
    from mampc.identification.data import IOData

PLACES = ("input", "output", "measured")

Seed = int | Sequence[int]


class Load(Protocol):
    """What a load is.

    Attributes:
        at: where it acts: "input" (unmeasured, added to the inputs on their way to the plant), "output" (unmeasured,
            added to the outputs) or "measured" (added to the plant's measured disturbances).
    """

    @property
    def at(self) -> str: ...

    def draw(self, n_steps: int, dt: float, seed: Seed, signals: int = 1) -> Array:
        """One course of the load, shape (n_steps, signals), in the unit of the signals it acts on.

        `dt` is the sample time in seconds; equal seeds give equal courses.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class _At:
    """What all loads share: where they act (see `Load`)."""

    at: str = "input"

    def __post_init__(self) -> None:
        as_choice("at", self.at, PLACES)
        for name in self._positive:
            object.__setattr__(self, name, as_number(name, getattr(self, name), 0.0, exclusive=True))
        if hasattr(self, "size"):
            object.__setattr__(self, "size", as_one_or_each("size", self.size, 0.0))

    _positive: ClassVar[tuple[str, ...]] = ()


@dataclass(frozen=True, kw_only=True)
class Steps(_At):
    """Steps at given times: at each, the load changes by a given size and stays there.

    Args:
        sizes: one per step, each a number or one per signal.
        times: of the steps, in seconds.
        at: see `Load`.
    """

    sizes: Sequence[Any]
    times: Sequence[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        times = as_vector("times", self.times, np.size(self.times)).tolist()
        if not isinstance(self.sizes, Sequence | np.ndarray) or len(self.sizes) != len(times):
            raise MampcError(
                f"sizes: expected one per time, {len(times)} of them, received {shown(self.sizes)}"
            )
        sizes = tuple(tuple(np.atleast_1d(as_array("sizes", size)).tolist()) for size in self.sizes)
        object.__setattr__(self, "sizes", sizes)
        object.__setattr__(self, "times", tuple(times))

    def draw(self, n_steps: int, dt: float, seed: Seed = 0, signals: int = 1) -> Array:
        """See `Load`; the seed decides nothing."""
        load = np.zeros((n_steps, signals))
        for size, time in zip(self.sizes, self.times, strict=True):
            first = max(0, int(np.ceil(time / dt - 1e-9)))
            load[first:] += as_vector("sizes", size if len(size) > 1 else size[0], signals)
        return load


@dataclass(frozen=True, kw_only=True)
class RandomSteps(_At):
    """Steps at random times to random levels, each signal on its own.

    Args:
        size: standard deviation of the levels, a number or one per signal.
        every: mean time between the steps of a signal, in seconds.
        at: see `Load`.
    """

    size: Any
    every: float
    _positive = ("every",)

    def draw(self, n_steps: int, dt: float, seed: Seed = 0, signals: int = 1) -> Array:
        """See `Load`."""
        rng = np.random.default_rng(seed)
        levels = rng.standard_normal((n_steps, signals))
        steps = rng.random((n_steps, signals)) < -np.expm1(-dt / self.every)
        levels[0], steps[0] = 0.0, True
        latest = np.maximum.accumulate(np.where(steps, np.arange(n_steps)[:, None], 0), axis=0)
        load: Array = np.take_along_axis(levels, latest, axis=0) * as_vector("size", self.size, signals)
        return load


@dataclass(frozen=True, kw_only=True)
class RandomWalk(_At):
    """A random walk that starts at zero.

    Args:
        size: standard deviation of its change from one sample to the next, a number or one per signal.
        at: see `Load`.
    """

    size: Any

    def draw(self, n_steps: int, dt: float, seed: Seed = 0, signals: int = 1) -> Array:
        """See `Load`."""
        changes = np.random.default_rng(seed).standard_normal((n_steps, signals))
        changes[0] = 0.0
        load: Array = changes.cumsum(axis=0) * as_vector("size", self.size, signals)
        return load


@dataclass(frozen=True, kw_only=True)
class Coloured(_At):
    """White noise through a first-order lag, from zero on.

    Args:
        size: its standard deviation in the long run, a number or one per signal.
        time_constant: of the lag, in seconds.
        at: see `Load`.
    """

    size: Any
    time_constant: float
    _positive = ("time_constant",)

    def draw(self, n_steps: int, dt: float, seed: Seed = 0, signals: int = 1) -> Array:
        """See `Load`."""
        from scipy.signal import lfilter

        kept = np.exp(-dt / self.time_constant)
        noise = np.random.default_rng(seed).standard_normal((n_steps, signals))
        noise[0] = 0.0
        load: Array = np.asarray(lfilter([np.sqrt(1 - kept**2)], [1.0, -kept], noise, axis=0))
        size: Array = as_vector("size", self.size, signals)
        return load * size


@dataclass(frozen=True, kw_only=True)
class Sinusoid(_At):
    """A sinusoid.

    Args:
        size: its amplitude, a number or one per signal.
        period: in seconds.
        phase: in radians, 0 for a start at zero; None draws one for each signal.
        at: see `Load`.
    """

    size: Any
    period: float
    phase: float | None = 0.0
    _positive = ("period",)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.phase is not None:
            object.__setattr__(self, "phase", as_number("phase", self.phase))

    def draw(self, n_steps: int, dt: float, seed: Seed = 0, signals: int = 1) -> Array:
        """See `Load`."""
        phase = (
            np.random.default_rng(seed).uniform(0, 2 * np.pi, signals) if self.phase is None else self.phase
        )
        angle = 2 * np.pi * dt / self.period * np.arange(n_steps)[:, None]
        load: Array = np.sin(angle + phase) * as_vector("size", self.size, signals)
        return load


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals(_At):
    """What a model left unexplained in a record: what really disturbed the plant, seen at its outputs.

    A course is a piece of it from a random sample on, forwards or backwards, turning round at the ends, less its first
    value. The record's noise is part of it.

    Args:
        values: the residuals, shape (N, l); `of` makes them from a model and a record.
        at: see `Load`.
    """

    values: Array
    at: str = "output"

    def __post_init__(self) -> None:
        super().__post_init__()
        values = as_matrix("values", self.values)
        if len(values) < 2:
            raise MampcError(f"values: expected at least two samples, received {len(values)}")
        values.flags.writeable = False
        object.__setattr__(self, "values", values)

    @classmethod
    def of(cls, model: StateSpace, record: IOData, *, skip: int = 0) -> Residuals:
        """The record's outputs less the model's answer to its inputs from rest, without the first `skip` samples.

        Raises:
            MampcError: a record that does not fit the model, or no samples left.
        """
        if record.u.shape[1] != model.B.shape[1] or record.y.shape[1] != model.n_outputs:
            raise MampcError(
                f"Residuals: expected a record of {model.B.shape[1]} inputs and {model.n_outputs} outputs, received "
                f"{record.u.shape[1]} and {record.y.shape[1]}"
            )
        return cls(values=(record.y - model.response(record.u, model.steady_state(record.u[0])))[skip:])

    def draw(self, n_steps: int, dt: float, seed: Seed = 0, signals: int = 1) -> Array:
        """See `Load`; the residuals are taken to be sampled as the loop is."""
        if signals != self.values.shape[1]:
            raise MampcError(f"Residuals: expected {self.values.shape[1]} signals, received {signals}")
        last = len(self.values) - 1
        at = (np.random.default_rng(seed).integers(2 * last) + np.arange(n_steps)) % (2 * last)
        piece = self.values[np.where(at > last, 2 * last - at, at)]
        load: Array = piece - piece[0]
        return load


def drawn(
    loads: Sequence[Load], n_steps: int, dt: float, seed: int, signals: dict[str, int]
) -> Iterator[tuple[str, Array]]:
    """Where each load acts and its course, each by a seed of its own; `signals` are numbered by place."""
    if not isinstance(loads, Sequence):
        raise MampcError(f"loads: expected a list of mampc.loads, received {type(loads).__name__}")
    for number, load in enumerate(loads, 1):
        place = getattr(load, "at", None)
        if place not in PLACES or not hasattr(load, "draw"):
            raise MampcError(f"loads: expected mampc.loads such as RandomWalk, received {shown(load)}")
        if signals[place] == 0:
            raise MampcError(
                f"loads: expected a plant with measured disturbances for {shown(load)}, received none"
            )
        yield (
            place,
            as_matrix(
                "load", load.draw(n_steps, dt, [seed, number], signals[place]), n_steps, signals[place]
            ),
        )
