"""Whether a measurement is believed: missing, out of range, jumping and stuck sensors.

Every test is made against what the model predicts, since only that tells a fault from a move of the plant:

- missing: not a number, infinite, masked, or beyond any engineering unit;
- out of range: outside what the sensor can show;
- jump: further from its prediction than `largest_jump`. Where it stays there (`confirm` samples within
  `largest_jump` of one another), it is the plant that jumped, and it is believed, unless it is a hundred times
  as far from the operating point as the inputs' whole range could move the output;
- stuck: to the last bit the same for `stuck_after` samples, and for three times as long as this sensor ever was
  while healthy, while the model moved that output by more than a fifth of `largest_jump`. A coarse sensor, whose
  every change was a multiple of one step and that no small one, may show the same for long while the controller
  balances a load: it takes twice as many samples, and movement by all of `largest_jump`. A stuck sensor is believed
  again once it changes; or, where no other output is believed either, after ten times `stuck_after` samples, since
  a plant at a hard stop (a tank that overflows) looks the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray, as_array, as_limit, as_vector, as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Fault
from mampc.loop.estimation import static_response
from mampc.program.problem import TrackingProblem

OF_REACH = 0.1  # default jump, as a share of what the inputs' whole range does to an output
SOON = 10  # samples
GIVE_UP = 10  # times `stuck_after` samples blind: then a stuck sensor is believed again
ABSURD = 100.0  # times that reach from the operating point: no plant gets there, and it is never believed
COARSE = 1e-3  # times the largest jump: a sensor with larger steps, and that shows nothing between them
COARSE_PATIENCE = 2  # times `stuck_after`: how long its number may stay the same
UNUSUAL = 3  # times as long as it ever did: how long the number of a sensor may stay the same
PATIENCE = 10  # times `stuck_after`: but no longer
QUIET = 0.1  # times the movement that a stuck sensor misses: with less of it, equal numbers say nothing
STUCK = 0.2  # predicted movement, as a share of the largest jump, that a working sensor shows


@dataclass(frozen=True, kw_only=True)
class SensorChecks:
    """When a measurement is believed; see the module for the tests.

    Args:
        y_low, y_high: what the sensors can show, in output units, a scalar or (l,); None for no range.
        largest_jump: distance from its prediction at which a measurement is believed at once, in output
            units, a scalar or (l,). Default: a tenth of what the inputs' whole range does to that output at
            rest, where that range is finite; infinite (no test for jumps and stuck sensors) elsewhere.
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

    def fitted(self, problem: TrackingProblem) -> Sensors:
        """The checks for the outputs of one problem."""
        return Sensors(self, problem)


@dataclass(frozen=True, eq=False)
class SensorState:
    """What the checks remember of each output, arrays of shape (l,).

    Attributes:
        y: the last number that came.
        repeats: how many samples it has been the same.
        moved: how far the model moved the output meanwhile; `LARGEST` once it counts as stuck.
        doubted: how many samples in a row jumped to about the same place.
        disturbance: estimated at the output when its present number first came.
        longest: run of equal numbers, in samples, that ended with a change although the model moved the output.
        step: that all its changes were multiples of, as long as it is not small; `LARGEST` before the first.
        blind: samples in a row without any output believed.
    """

    y: Array
    repeats: Array
    moved: Array
    doubted: Array
    disturbance: Array
    longest: Array
    step: Array
    blind: int = 0


class Sensors:
    """`SensorChecks` for one problem; its `check` is pure."""

    def __init__(self, checks: SensorChecks, problem: TrackingProblem) -> None:
        l = problem.model.n_outputs
        self._low = as_limit("y_low", checks.y_low, l, -np.inf)
        self._high = as_limit("y_high", checks.y_high, l, np.inf)
        if (self._low >= self._high).any():
            raise MampcError(f"sensors: expected y_low < y_high, received {self._low} and {self._high}")
        largest = np.nextafter(LARGEST, 0.0)  # what is as large as `LARGEST` is missing, not in range
        self._low, self._high = np.maximum(self._low, -largest), np.minimum(self._high, largest)
        reach = _reach(problem)
        jump, self._absurd, self._y_op = reach * OF_REACH, reach * ABSURD, problem.model.y_op
        if checks.largest_jump is not None:
            given = as_array("largest_jump", checks.largest_jump)
            jump = (
                np.full(l, np.inf)
                if given.ndim == 0 and given == np.inf
                else as_vector("largest_jump", given, l)
            )
            if (jump <= 0).any():
                raise MampcError(
                    f"largest_jump: expected values above zero, received {checks.largest_jump!r}"
                )
        self._jump, self._confirm = jump, checks.confirm
        self._stuck_after = np.inf if checks.stuck_after is None else checks.stuck_after
        self._names = problem.model.names.outputs
        self._all, self._none = np.ones(l, dtype=bool), np.zeros(l)
        self._fine = COARSE * jump
        self._moving = np.minimum(STUCK * jump, LARGEST / 2)
        self._start = SensorState(*(self._none,) * 6, np.full(l, LARGEST))

    def initial(self) -> SensorState:
        """Before the first sample."""
        return self._start

    def check(
        self, state: SensorState, y: Array, innovation: Array, movement: Array, disturbance: Array
    ) -> tuple[BoolArray, dict[str, Fault], SensorState]:
        """Judge one sample.

        Args:
            state: from `initial` or the last check.
            y: measurements, shape (l,), finite or not.
            innovation: measured less predicted outputs, shape (l,).
            movement: how far the model moved the outputs since the last sample, shape (l,).
            disturbance: estimated at the outputs before this sample, shape (l,).

        Returns:
            Which outputs are believed, shape (l,); the fault of every other by its name; the next state.
        """
        fine = (np.abs(innovation) <= self._jump) & (y != state.y) & (y >= self._low) & (y <= self._high)
        if fine.all():  # the everyday case, at once
            none, step = self._none, self._step(state, y, self._all)
            longest = self._longest(state, self._all)
            return self._all, {}, SensorState(y.copy(), none, none, none, disturbance, longest, step)
        missing = ~((y > -LARGEST) & (y < LARGEST))
        out = ~missing & ((y < self._low) | (y > self._high))
        came = ~(missing | out)
        same = came & (y == state.y)
        changed = came & ~same
        repeats = np.where(came, np.where(same, state.repeats + 1, 0), state.repeats)
        moved = np.where(changed, 0.0, state.moved + movement)
        coarse = (state.step > self._fine) & (state.step < LARGEST)
        least = np.where(coarse, COARSE_PATIENCE * self._stuck_after, self._stuck_after)
        long = repeats >= np.clip(UNUSUAL * state.longest, least, PATIENCE * self._stuck_after)
        stuck = same & long & (np.abs(moved) > np.where(coarse, self._jump, self._moving))
        if state.blind >= GIVE_UP * self._stuck_after:
            repeats[stuck], moved[stuck], stuck = 0.0, 0.0, np.zeros_like(stuck)
        moved[stuck] = LARGEST
        jumped = came & ~stuck & (np.abs(innovation) > self._jump)
        doubted = np.where(came, 0.0, state.doubted)
        near = jumped & (np.abs(y - state.y) <= self._jump)
        doubted[jumped] = 1.0
        near &= np.abs(y - self._y_op) < self._absurd
        doubted[near] += state.doubted[near]
        jump = jumped & (doubted < self._confirm)
        believed = came & ~stuck & ~jump
        after = SensorState(
            np.where(came, y, state.y), repeats, moved, doubted,
            np.where(changed, disturbance, state.disturbance),
            self._longest(state, changed), self._step(state, y, changed),
            0 if believed.any() else state.blind + 1,
        )  # fmt: skip
        faults = {}
        for fault, affected in (
            (Fault.MISSING, missing), (Fault.OUT_OF_RANGE, out), (Fault.STUCK, stuck), (Fault.JUMP, jump),
        ):  # fmt: skip
            faults.update({self._names[i]: fault for i in np.flatnonzero(affected)})
        return believed, faults, after

    def _longest(self, state: SensorState, changed: BoolArray) -> Array:
        """The longest run of equal numbers of a sensor that was not stuck, shape (l,)."""
        if not state.repeats.any():
            return state.longest
        healthy = changed & (np.abs(state.moved) > QUIET * self._moving) & (state.moved < LARGEST)
        longest: Array = np.where(healthy, np.maximum(state.longest, state.repeats), state.longest)
        return longest

    def _step(self, state: SensorState, y: Array, changed: BoolArray) -> Array:
        """The greatest common divisor of all changes so far, shape (l,), found step by step."""
        step = state.step
        if not (step > self._fine).any():
            return step
        change = np.where(changed, np.abs(y - state.y), 0.0)
        rest = np.fmod(change, step)
        rest = np.minimum(rest, step - rest)
        finer: Array = np.where(rest > 1e-3 * np.minimum(change, step), rest, step)
        return finer


def newly_stuck(before: SensorState, after: SensorState) -> BoolArray:
    """The outputs found stuck at this sample, shape (l,): what was estimated since they are is wrong."""
    found: BoolArray = (after.moved >= LARGEST) & (before.moved < LARGEST)
    return found


def _reach(problem: TrackingProblem) -> Array:
    """How far the whole range of the inputs moves each output, at rest or soon, shape (l,)."""
    model, limits, m = problem.model, problem.limits, problem.model.n_inputs
    response, gain = model.D[:, :m], np.abs(static_response(model)[:, :m])
    state = model.B[:, :m]
    for _ in range(SOON):  # an output that washes out is not moved at rest
        response, state = response + model.C @ state, model.A @ state
        gain = np.maximum(gain, np.abs(response))
    ranges = np.broadcast_to(limits.u_max - limits.u_min, gain.shape)
    reach: Array = (gain * np.where(gain > 0, ranges, 0.0)).sum(axis=1)
    return np.where(reach > 0, reach, np.inf)
