"""Whether a measurement is believed: missing, out of range, jumping and stuck sensors.

Every test is made against what the model predicts, since only that tells a fault from a move of the plant:

- missing: not a number, infinite, masked, or beyond any engineering unit;
- out of range: outside what the sensor can show;
- stuck: to the last bit the same for `stuck_after` samples, and for three times as long as this sensor ever was
  while healthy, while the model moved that output by more than a fifth of `largest_jump`. A coarse sensor, whose
  every change was a multiple of one step and that no small one, may show the same for long while the controller
  balances a load: it takes twice as many samples, and movement by all of `largest_jump`. A stuck sensor is believed
  again once it changes; or, where no other output is believed either, after ten times `stuck_after` samples, since
  a plant at a hard stop (a tank that overflows) looks the same;
- jump: further from its prediction than `largest_jump`; where the model integrates, so that the inputs' range says
  little of the noise, by default seven and a half times as far as usual of late, if that is more. Where it stays there
  (`confirm` samples within `largest_jump` of one another, or of where the model takes them), it is the plant that
  jumped, and it is believed, unless it is a hundred times as far from the operating point as the inputs' whole range
  could move the output.

An output has one fault at a time, the first in this order.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from operator import le
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray, as_array, as_limit, as_vector, as_whole
from mampc.base.errors import MampcError
from mampc.base.identity import equal_only_to_itself
from mampc.base.words import Fault
from mampc.program.problem import TrackingProblem

# What `SensorChecks` does not set.
JUMP_OF_REACH = (
    0.1  # default largest jump, as a share of the reach: what the inputs' whole range does to an output
)
JUMP_OF_NOISE = 6.0  # and at least so many standard deviations of the noise, where it is known
JUMP_OF_SURPRISE = 7.5  # and so many times the usual surprise: six standard deviations of white noise
SURPRISE_FORGOTTEN = 0.05  # share of the usual surprise that each sample replaces
SMALL_SURPRISE = 0.25  # of the largest jump: below it a surprise says nothing of the largest jump
REACH_WITHIN = 10  # samples within which the inputs reach an output that washes out before its steady state
ABSURD_OF_REACH = (
    100.0  # times the reach from the operating point no plant gets; nothing there is ever believed
)
STUCK_MOVEMENT = 0.2  # predicted movement, as a share of the largest jump, that a working sensor shows
QUIET_MOVEMENT = 0.1  # of that movement: with less of it equal numbers say nothing of a sensor
LONGER_THAN_USUAL = 3.0  # times its longest run of equal numbers while healthy, then a sensor may be stuck
LONGEST_PATIENCE = 10.0  # times `stuck_after`: what this can come to at most
COARSE_STEP = (
    1e-3  # as a share of the largest jump: a sensor with larger steps, and nothing between, is coarse
)
COARSE_PATIENCE = 2.0  # times `stuck_after`: how long the number of a coarse sensor may stay the same
BELIEVED_AGAIN = 10.0  # times `stuck_after` samples without any output: then stuck sensors are believed again
DIVIDES = 1e-3  # what may be left of a change divided by a step, as a share of both, for rounding


@dataclass(frozen=True, kw_only=True)
class SensorChecks:
    """When a measurement is believed; see the module for the tests.

    Args:
        y_low, y_high: what the sensors can show, in output units, a scalar or (l,); None for no range.
        largest_jump: distance from its prediction at which a measurement is believed at once, in output
            units, a scalar or (l,). Default: a tenth of what the inputs' whole range does to that output,
            where that range is finite, and six times the noise at least, as a load bank was told it or as
            the model keeps it; more where a model integrates and outputs are usually further from their
            predictions; infinite (no test for jumps and stuck sensors) elsewhere.
        confirm: >= 1, samples after which a jump that stays is believed.
        stuck_after: >= 2, equal samples after which a sensor may be stuck; None for never.

    Raises:
        MampcError: values out of range.
    """

    y_low: Any = None
    y_high: Any = None
    largest_jump: Any = None
    confirm: int = 3
    stuck_after: int | None = 10

    def __post_init__(self) -> None:
        as_whole("confirm", self.confirm, 1)
        if self.stuck_after is not None:
            as_whole("stuck_after", self.stuck_after, 2)

    def fitted(self, problem: TrackingProblem, noise: Array | None = None) -> Sensors:
        """The checks for the outputs of one problem; `noise` (l,) as an estimator was told it, in output units."""
        return Sensors(self, problem, noise)


@equal_only_to_itself
class SensorState(NamedTuple):
    """What the checks remember of each output, arrays of shape (l,).

    Attributes:
        y: the last number that came.
        repeats: how many samples it has been the same.
        moved: how far the model moved the output meanwhile.
        stuck: 1 where the sensor counts as stuck, else 0.
        doubted: how many samples in a row jumped to about the same place.
        loads: what the estimator had found of loads when the present number of each output first came, shape (l, k).
        longest: run of equal numbers, in samples, that ended with a change although the model moved the output.
        step: that all its changes were multiples of, as long as it is not small; 0 before the first.
        surprise: running mean of the distance from the prediction, counted up to the largest jump; 0 where it is
            too small to matter, and where nothing is learnt of it.
        blind: samples in a row without any output believed.
    """

    y: Array
    repeats: Array
    moved: Array
    stuck: Array
    doubted: Array
    loads: Array
    longest: Array
    step: Array
    surprise: Array
    blind: int = 0


class Judged(NamedTuple):
    """What the checks say of one sample.

    Attributes:
        believed: shape (l,).
        faults: why the others are not, by name.
        newly_stuck: found stuck at this sample, shape (l,): what was estimated since they are is wrong.
    """

    believed: BoolArray
    faults: dict[str, Fault]
    newly_stuck: BoolArray


class Sensors:
    """`SensorChecks` for one problem; `update` is pure."""

    def __init__(self, checks: SensorChecks, problem: TrackingProblem, noise: Array | None = None) -> None:
        l = problem.model.n_outputs
        low, high = as_limit("y_low", checks.y_low, l, -np.inf), as_limit("y_high", checks.y_high, l, np.inf)
        if (low >= high).any():
            raise MampcError(f"sensors: expected y_low < y_high, received {low} and {high}")
        largest = np.nextafter(LARGEST, 0.0)  # what is as large as `LARGEST` is missing, not in range
        self._low, self._high = np.maximum(low, -largest), np.minimum(high, largest)
        reach, settles = _reach(problem)
        self._jump = JUMP_OF_REACH * reach
        if noise is None and problem.model.noise is not None:
            noise = problem.model.noise.output
        if noise is not None:
            self._jump = np.maximum(self._jump, JUMP_OF_NOISE * noise)
        self._learns = checks.largest_jump is None and not settles
        if checks.largest_jump is not None:
            self._jump = _largest_jump(checks.largest_jump, l)
        self._absurd, self._y_op = ABSURD_OF_REACH * reach, problem.model.y_op
        self._stuck_movement = np.minimum(STUCK_MOVEMENT * self._jump, LARGEST / 2)
        self._quiet_movement = QUIET_MOVEMENT * self._stuck_movement
        self._coarse_step = COARSE_STEP * self._jump
        self._coarse = self._coarse_step.tolist()
        self._bounds = np.stack([self._jump, self._low, self._high], axis=1).tolist()
        self._small_surprise = SMALL_SURPRISE * self._jump if self._learns else np.full(l, np.inf)
        self._small = self._small_surprise.tolist()
        self._forgotten = self._small_surprise / JUMP_OF_SURPRISE  # no largest jump comes of it
        self._confirm = checks.confirm
        self._stuck_after = np.inf if checks.stuck_after is None else checks.stuck_after
        self._names = problem.model.names.outputs
        self._all, self._none, self._zeros = np.ones(l, dtype=bool), np.zeros(l, dtype=bool), np.zeros(l)
        self._column = np.ones((l, 1))
        self._fine = Judged(self._all, {}, self._none)

    def initial(self, loads: Array) -> SensorState:
        """Before the first sample, with `loads` as in `update`."""
        zeros = self._zeros
        return SensorState(zeros, zeros, zeros, zeros, zeros, self._each(loads), zeros, zeros, zeros)

    def update(
        self, state: SensorState, y: Array, innovation: Array, movement: Array, loads: Array
    ) -> tuple[Judged, SensorState]:
        """Judge one sample.

        Args:
            state: from `initial` or the last sample.
            y: measurements, shape (l,), finite or not.
            innovation: measured less predicted outputs, shape (l,).
            movement: how far the model moved the outputs since the last sample, shape (l,).
            loads: what the estimator has found of them before this sample, shape (k,).
        """
        if self._is_fine(state, y, innovation):  # the everyday case, at once
            return self._fine, self.after_fine(state, y, innovation, loads)
        missing = ~((y > -LARGEST) & (y < LARGEST))
        out = ~missing & ((y < self._low) | (y > self._high))
        came = ~(missing | out)
        changed = came & (y != state.y)
        repeats = np.where(came, np.where(changed, 0.0, state.repeats + 1), state.repeats)
        moved = np.where(changed, 0.0, state.moved + movement)
        stuck = came & ~changed & self._is_stuck(state, repeats, moved)
        if state.blind >= BELIEVED_AGAIN * self._stuck_after:
            repeats[stuck], moved[stuck], stuck = 0.0, 0.0, self._none
        largest = np.maximum(self._jump, JUMP_OF_SURPRISE * state.surprise)
        jumped = came & ~stuck & (np.abs(innovation) > largest)
        doubted = self._doubted(state, y, movement, jumped, largest)
        jump = jumped & (doubted < self._confirm)
        believed = came & ~stuck & ~jump
        after = SensorState(
            np.where(came, y, state.y), repeats, moved,
            np.where(came, stuck, state.stuck).astype(np.float64),
            np.where(came, doubted, state.doubted),
            np.where(changed[:, None], loads, state.loads),
            self._longest(state, changed), self._step(state, y, changed),
            self._surprise(state.surprise, innovation, came & ~stuck),
            0 if believed.any() else state.blind + 1,
        )  # fmt: skip
        found = (
            (Fault.MISSING, missing),
            (Fault.OUT_OF_RANGE, out),
            (Fault.STUCK, stuck),
            (Fault.JUMP, jump),
        )
        faults = {self._names[i]: fault for fault, affected in found for i in np.flatnonzero(affected)}
        return Judged(believed, faults, stuck & (state.stuck == 0.0)), after

    def _is_fine(self, state: SensorState, y: Array, innovation: Array) -> bool:
        """Whether every number is new, in range and near its prediction; in plain floats, which few are quicker in."""
        each = zip(y.tolist(), state.y.tolist(), innovation.tolist(), self._bounds, strict=True)
        for now, last, e, (jump, low, high) in each:
            if not (now != last and -jump <= e <= jump and low <= now <= high):
                return False
        return True

    def are_fine(self, state: SensorState, y: Array, innovation: Array) -> BoolArray:
        """The same of many loops, whose arrays have these first, shape (S,)."""
        near = (y != state.y) & (np.abs(innovation) <= self._jump) & (y >= self._low) & (y <= self._high)
        fine: BoolArray = np.asarray(near.all(axis=1))
        return fine

    def after_fine(self, state: SensorState, y: Array, innovation: Array, loads: Array) -> SensorState:
        """The next state where all outputs were fine, of one loop or of many."""
        zeros = self._zeros if y.ndim == 1 else np.zeros_like(y)
        step, longest = self._step(state, y, self._all), self._longest(state, self._all)
        surprise = self._surprise(state.surprise, innovation, self._all)
        return SensorState(y.copy(), zeros, zeros, zeros, zeros, self._each(loads), longest, step, surprise)

    def _surprise(self, surprise: Array, innovation: Array, came: BoolArray) -> Array:
        """The usual distance from the prediction with this sample, shape (l,), or of many loops."""
        if surprise is self._zeros and (
            not self._learns
            or all(-small <= e <= small for e, small in zip(innovation.tolist(), self._small, strict=True))
        ):
            return surprise
        counted = np.minimum(np.abs(innovation), np.maximum(self._jump, JUMP_OF_SURPRISE * surprise))
        matters = came & ((counted > self._small_surprise) | (surprise > self._forgotten))
        latest = surprise + SURPRISE_FORGOTTEN * (np.where(matters, counted, surprise) - surprise)
        after: Array = np.where(matters, latest, np.where(came, 0.0, surprise))
        return after if after.any() or after.ndim > 1 else self._zeros

    def _each(self, loads: Array) -> Array:
        """The loads (k,) once for every output, shape (l, k), of one loop or of many."""
        each: Array = loads[..., None, :] * self._column
        return each

    def _is_stuck(self, state: SensorState, repeats: Array, moved: Array) -> BoolArray:
        """The outputs that have shown the same for too long, though the model moved them, shape (l,)."""
        coarse = state.step > self._coarse_step
        least = np.where(coarse, COARSE_PATIENCE, 1.0) * self._stuck_after
        longest = LONGEST_PATIENCE * self._stuck_after
        long = repeats >= np.clip(LONGER_THAN_USUAL * state.longest, least, longest)
        moves = np.abs(moved) > np.where(coarse, np.maximum(self._jump, state.step), self._stuck_movement)
        stuck: BoolArray = (state.stuck != 0.0) | (long & moves)
        return stuck

    def _doubted(
        self, state: SensorState, y: Array, movement: Array, jumped: BoolArray, largest: Array
    ) -> Array:
        """For how many samples in a row each output has jumped to about the same place, shape (l,).

        From there it may go on as the model says: an integrator at full speed gets far in a sample.
        """
        gone = np.minimum(np.abs(y - state.y), np.abs(y - state.y - movement))
        near = (gone <= largest) & (np.abs(y - self._y_op) < self._absurd)
        return np.where(jumped, 1.0 + np.where(near, state.doubted, 0.0), 0.0)

    def _longest(self, state: SensorState, changed: BoolArray) -> Array:
        """The longest run of equal numbers of a sensor that was not stuck, shape (l,)."""
        if state.repeats is self._zeros or not state.repeats.any():
            return state.longest
        healthy = changed & (np.abs(state.moved) > self._quiet_movement) & (state.stuck == 0.0)
        longest: Array = np.where(healthy, np.maximum(state.longest, state.repeats), state.longest)
        return longest

    def _step(self, state: SensorState, y: Array, changed: BoolArray) -> Array:
        """The greatest common divisor of all changes so far, shape (l,), found step by step."""
        step = state.step
        if step.ndim > 1:
            settled = bool(((step > 0.0) & (step <= self._coarse_step)).all())
        else:
            sizes = step.tolist()
            settled = min(sizes) > 0.0 and all(map(le, sizes, self._coarse))
        if settled:
            return step
        change, known = np.where(changed, np.abs(y - state.y), 0.0), np.where(step > 0.0, step, 1.0)
        rest = np.fmod(change, known)
        rest = np.minimum(rest, known - rest)
        finer: Array = np.where(rest > DIVIDES * np.minimum(change, known), rest, step)
        return np.where(step > 0.0, finer, change)


def _largest_jump(told: Any, l: int) -> Array:
    """The argument `largest_jump` as positive numbers, shape (l,); a scalar may be infinite."""
    given = as_array("largest_jump", told)
    jump = np.full(l, np.inf) if given.ndim == 0 and given == np.inf else as_vector("largest_jump", given, l)
    if (jump <= 0).any():
        raise MampcError(f"largest_jump: expected values above zero, received {told!r}")
    return jump


def _reach(problem: TrackingProblem) -> tuple[Array, bool]:
    """How far the whole range of the inputs moves each output, in a steady state or soon, shape (l,); is there one?"""
    model, limits, m = problem.model, problem.limits, problem.model.n_inputs
    gain = np.abs(model.step_response(REACH_WITHIN + 1)[:, :, :m]).max(axis=0)  # an output may wash out
    settles = False
    with suppress(MampcError):  # an integrator has no other
        gain, settles = np.maximum(gain, np.abs(model.dc_gain()[:, :m])), True
    ranges = np.broadcast_to(limits.u_max - limits.u_min, gain.shape)
    reach: Array = (gain * np.where(gain > 0, ranges, 0.0)).sum(axis=1)
    return np.where(reach > 0, reach, np.inf), settles
