"""What is reported of actuators, judged: did they what was decided, late or not, or something else?

A reported input that does not agree with the decided one is believed at once: the actuator is stuck, saturated or
in manual. Unless reported inputs *changed* as decided ones did. Then the actuator obeys, and is

- late, where the reported input went from one decided input to the next one, but some samples after these. What it
  will do next is decided and on its way, so the decided inputs count, as long as this goes on;
- or read with an offset, where the reported input moved as the latest decided one did. Were it believed, an input
  that is held would go on by the offset at every sample.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray
from mampc.base.identity import equal_only_to_itself
from mampc.program.problem import Limits

TOLERANCE = 0.01  # of the range of an input: neither valves nor their position feedback are more exact
ROUNDED = 1e-6  # of an input without a range: what rounding may make of its report
IN_MANUAL = 0.1  # times the tolerance of an input in manual, so that it goes back to automatic without a bump
ABSURD = 100.0  # times the range of an input: no actuator is that far outside
LATEST = 10  # samples that an actuator may be late by


@equal_only_to_itself
class ActuatorState(NamedTuple):
    """What is remembered of the actuators.

    Attributes:
        commands: the last `LATEST` + 2 inputs decided, oldest first, each of shape (m,).
        reported: the last inputs reported, shape (m,).
        late: samples that each actuator is late by, shape (m,).
        offset: reported less decided input where that is explained by the reading, shape (m,).
        manual: 1 where an input was in manual when it was last reported, else 0, shape (m,).
    """

    commands: tuple[Array, ...]
    reported: Array
    late: Array
    offset: Array
    manual: Array

    def decided(self, u: Array) -> ActuatorState:
        """What is remembered after the inputs u (m,) were decided."""
        commands = (*self.commands[1:], u)
        return ActuatorState(commands, self.reported, self.late, self.offset, self.manual)


class Actuators:
    """Judges what is reported of the actuators of one problem; `update` is pure.

    Args:
        limits: of the inputs.
        tolerance: within which reported and decided inputs agree, shape (m,); None for the default.
    """

    def __init__(self, limits: Limits, tolerance: Array | None = None) -> None:
        apart = limits.u_max - limits.u_min
        self._rounded = None  # share of what is expected, of inputs without a range
        if tolerance is None:
            ranged = np.isfinite(apart)
            tolerance = TOLERANCE * np.where(ranged, apart, 0.0)
            self._rounded = None if ranged.all() else np.where(ranged, 0.0, ROUNDED)
        self._tolerance = tolerance
        beyond = np.where(apart > 0, ABSURD * apart, LARGEST)
        # Nor is it beyond what controllers decide where there are no limits: half of what counts as a number.
        self._low = np.maximum(limits.u_min - beyond, -LARGEST / 2)
        self._high = np.minimum(limits.u_max + beyond, LARGEST / 2)
        self._each = np.arange(len(apart))

    def initial(self, inputs: Array) -> ActuatorState:
        """After the inputs (h, m) were applied as decided."""
        none = np.zeros(len(self._each))
        commands = (*(inputs[0],) * (LATEST + 1), *inputs)[-LATEST - 2 :]
        return ActuatorState(commands, inputs[-1], none, none, none)

    def update(
        self, state: ActuatorState, inputs: Array, reported: Array, manual: BoolArray | None
    ) -> tuple[Array, ActuatorState]:
        """The inputs that count as applied.

        Args:
            state: from `initial` or the last decision.
            inputs: applied so far, oldest first, the decided ones last, shape (h, m).
            reported: shape (m,), finite or not; what no actuator reaches is not believed.
            manual: which inputs are in manual, shape (m,), or None for no input.

        Returns:
            The inputs (h, m), put right; and the next state, before the next decision.
        """
        late, offset, tolerance = state.late, state.offset, self._tolerance
        answered = state.commands[-1]
        if late.any():
            answered = np.array(state.commands)[-1 - late.astype(np.intp), self._each]
        expected = answered + offset
        if self._rounded is not None:
            tolerance = tolerance + self._rounded * np.abs(expected)
        agrees = np.abs(reported - expected) <= tolerance
        stays = np.abs(reported - state.reported) <= tolerance
        careful = None if manual is None and not state.manual.any() else state.manual != 0
        if careful is None and (agrees & stays).all():  # the everyday case, at once
            return inputs, state._replace(reported=reported.copy())
        known = (reported > self._low) & (reported < self._high)
        inputs, late, offset, commands = inputs.copy(), late.copy(), offset.copy(), np.array(state.commands)
        kept = min(len(inputs), len(commands))
        judged = known & ~(agrees & (stays | (late != 0) | (offset != 0)))
        if careful is not None:  # what is reported in manual is no answer to a decision, also just after it
            if manual is not None:
                careful = careful | manual
            apart = careful & known & (np.abs(reported - state.commands[-1]) > IN_MANUAL * tolerance)
            inputs[-1, apart] = reported[apart]
            commands[:, careful] = inputs[-1, careful]
            late[careful] = offset[careful] = 0.0
            judged &= ~careful
        for i in np.flatnonzero(judged):
            answer = _answer(commands[::-1, i], state.reported[i], reported[i], tolerance[i])
            late[i], offset[i] = (0.0, 0.0) if answer is None else answer
            if answer is None:
                inputs[-1, i] = reported[i]
            elif late[i] or offset[i]:  # so what was believed to be something else was decided, too
                inputs[-kept:, i] = commands[-kept:, i]
        now = np.zeros_like(reported) if manual is None else manual.astype(np.float64)
        return inputs, ActuatorState(
            tuple(commands), np.where(known, reported, state.reported), late, offset, now
        )


def _answer(commands: Array, before: float, reported: float, tolerance: float) -> tuple[int, float] | None:
    """How late one actuator obeyed, and how far off it is read; None if it did something else.

    Args:
        commands: latest first, shape (`LATEST` + 2,).
        before: what was reported last.
        reported: what is reported now.
        tolerance: within which numbers agree.
    """
    changed = abs(reported - before) > tolerance
    if changed:
        went = (np.abs(reported - commands[:-1]) <= tolerance) & (np.abs(before - commands[1:]) <= tolerance)
        if went.any():
            return int(went.argmax()), 0.0
    if abs(reported - commands[0]) <= tolerance:
        return 0, 0.0
    if changed and abs((reported - before) - (commands[0] - commands[1])) <= tolerance:
        return 0, reported - commands[0]
    return None
