"""The limits of one sample: those of the problem, or others given at run time, constant or a row per sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray, as_instance, as_read
from mampc.base.errors import MampcError
from mampc.program.condensing import CondensedQP
from mampc.program.levels import InputLevels
from mampc.program.problem import Limits
from mampc.program.qp import UNBOUNDED
from mampc.program.sample import BoundsNow, Sample


class InputRange:
    """Least and largest inputs over the horizon, at one sample.

    Inputs in manual may be held beyond it. Nobody plans to move them, so plans leave them where they are.

    Args:
        low, high: what inputs to apply are kept within, shape (nc, m).
        left_alone: the inputs that plans leave beyond it, bool, shape (m,); None for none.
        levels: on which inputs are to be, if any; of them the range is those within `low` and `high`.
    """

    def __init__(
        self, low: Array, high: Array, left_alone: BoolArray | None = None, levels: InputLevels | None = None
    ) -> None:
        self._low, self._high, self._left_alone, self._levels = low, high, left_alone, levels
        if left_alone is not None:
            low, high = np.where(left_alone, -LARGEST, low), np.where(left_alone, LARGEST, high)
        self.low, self.high = low, high
        self._first = list(zip(low[0].tolist(), high[0].tolist(), strict=True))

    def holds(self, u: Array) -> bool:
        """Whether inputs u, shape (m,), are within the range of the first sample, those left alone aside."""
        for value, (low, high) in zip(u.tolist(), self._first, strict=True):
            if not low <= value <= high:
                return False
        return self._levels is None or not self._off_levels(u).any()

    def _off_levels(self, u: Array) -> BoolArray:
        """Which inputs u, shape (m,), that are not left alone are not on their levels."""
        assert self._levels is not None
        off = self._levels.missed(u)
        return off if self._left_alone is None else off & ~self._left_alone

    def _within(self, u: Array, low: Array, high: Array) -> Array:
        """What is nearest to inputs within limits, all of shape (..., m)."""
        nearest: Array = np.minimum(np.maximum(u, low), high)
        if self._levels is None:
            return nearest
        levels = self._levels.nearest(u, low, high)
        return levels if self._left_alone is None else np.where(self._left_alone, nearest, levels)

    def nearest(self, u: Array) -> Array:
        """The inputs within the range of the first sample nearest to u, shape (m,); those left alone stay."""
        return self._within(u, self.low[0], self.high[0])

    def held(self, u: Array) -> Array:
        """Inputs, shape (nc, m), that stay at u, shape (m,), but where the range makes them move."""
        rows = []
        for low, high in zip(self.low, self.high, strict=True):
            u = self._within(u, low, high)
            rows.append(u)
        return np.array(rows)

    def clipped(self, plan: Array) -> Array:
        """Planned inputs, shape (nc, m), brought within the range; those left alone stay."""
        return self._within(plan, self.low, self.high)

    def applied(self, plan: Array) -> Array:
        """The inputs to apply, shape (m,): the first planned ones, and within the range every one of them."""
        u: Array = plan[0]
        if self._left_alone is not None:
            u = np.minimum(np.maximum(u, self._low[0]), self._high[0])
            if self._levels is not None:
                u = self._levels.nearest(u, self._low[0], self._high[0])
            u.setflags(write=False)
        return u

    def leaving(self, manual: BoolArray, u: Array) -> InputRange:
        """The same range, with inputs in manual, shape (m,), left where u, shape (m,), is beyond it at some sample."""
        beyond = manual & ((u < self._low) | (u > self._high)).any(axis=0)
        if self._levels is not None:
            beyond |= manual & self._levels.missed(u)
        return InputRange(self._low, self._high, manual, self._levels) if beyond.any() else self


class UsualLimits:
    """The limits of the problem, as they hold at every sample for which no others are given.

    Attributes:
        inputs: the range of the inputs. Without limits of their own they stay within what counts as a number.
        du_max: shape (m,); None where no input has one.
        crossed: whether some u_min is above its u_max, so that no input can keep both: never here.
    """

    crossed = False

    def __init__(self, condensed: CondensedQP, levels: InputLevels | None = None) -> None:
        limits, shape = condensed.problem.limits, (condensed.problem.control_horizon, 1)
        self._condensed, self._levels = condensed, levels
        self.du_max = limits.du_max if np.isfinite(limits.du_max).any() else None
        self.inputs = InputRange(
            np.tile(np.maximum(limits.u_min, -LARGEST / 2), shape),
            np.tile(np.minimum(limits.u_max, LARGEST / 2), shape),
            levels=levels,
        )

    def applied_to(self, sample: Sample) -> Sample:
        """The sample with these limits for bounds."""
        return sample

    def with_manual(self, manual: BoolArray, u: Array) -> UsualLimits | LimitsNow:
        """The limits with inputs in manual, shape (m,), left alone where u, shape (m,), is beyond them."""
        if self.inputs.leaving(manual, u) is self.inputs:
            return self
        return LimitsNow(Limits(), self._condensed, self._levels).with_manual(manual, u)


class LimitsNow:
    """The limits of one sample, over the horizon.

    Inputs stay within the limits of the problem too, which are those of the actuators; limits of outputs
    replace those of the problem. What is None or not a number stays as the problem has it.

    Attributes:
        inputs: the range of the inputs; that of the problem for inputs whose limits cross.
        du_max: shape (nc, m).
        y_min, y_max: at i = 1..np, shape (np, l).
        crossed: whether some u_min of an input that is not in manual is above its u_max, so that it cannot keep both.

    Raises:
        MampcError: the wrong shape, or limits of signals for which the problem has none.
    """

    def __init__(self, limits: Limits, condensed: CondensedQP, levels: InputLevels | None = None) -> None:
        as_instance("limits", limits, Limits)
        problem, usual = condensed.problem, condensed.problem.limits
        n_c, n_p = problem.control_horizon, problem.prediction_horizon
        known = _known(condensed)

        def given(name: str, rows: int) -> Array:
            values = _rows(name, getattr(limits, name), getattr(usual, name), rows)
            if (np.isfinite(values).any(axis=0) & ~known[name]).any():
                raise MampcError(
                    f"limits: expected {name} only of signals that have one in the problem, received "
                    f"{getattr(limits, name)!r}; give the problem a {name}, however wide"
                )
            return values

        self._condensed = condensed
        u_min = np.maximum(given("u_min", n_c), np.maximum(usual.u_min, -LARGEST / 2))
        u_max = np.minimum(given("u_max", n_c), np.minimum(usual.u_max, LARGEST / 2))
        self._crossing = (u_min > u_max).any(axis=0)
        self.crossed = bool(self._crossing.any())
        if self.crossed:
            whole = UsualLimits(condensed).inputs
            u_min, u_max = (
                np.where(self._crossing, usual_end, end)
                for usual_end, end in ((whole.low, u_min), (whole.high, u_max))
            )
        self.inputs = InputRange(u_min, u_max, levels=levels)
        self.du_max = np.clip(given("du_max", n_c), 0.0, usual.du_max)
        # Beyond what counts as a number a limit is as good as none, or as one that nothing can keep.
        self.y_min = np.minimum(given("y_min", n_p), LARGEST)
        self.y_max = np.maximum(given("y_max", n_p), -LARGEST)

    def with_manual(self, manual: BoolArray, u: Array) -> LimitsNow:
        """The limits with inputs in manual, shape (m,), left alone where u, shape (m,), is beyond them."""
        self.inputs = self.inputs.leaving(manual, u)
        self.crossed = bool((self._crossing & ~manual).any())
        return self

    def applied_to(self, sample: Sample) -> Sample:
        """The sample with these limits for bounds."""
        condensed = self._condensed
        v, n_simple = condensed.n_violations, condensed.bounds.n_simple
        m, l = condensed.problem.model.n_inputs, condensed.problem.model.n_outputs
        lower, upper, u = sample.lower.copy(), sample.upper.copy(), sample.u_previous
        low, high = self.inputs.low.ravel(), self.inputs.high.ravel()
        if condensed.bounds.every_move:
            upper[v:n_simple] = self.du_max.ravel()
            lower[v:n_simple] = -upper[v:n_simple]
        else:
            lower[v:n_simple], upper[v:n_simple] = low[:m] - u, high[:m] - u
        rows = condensed.bounds.input_rows
        inputs = condensed.bounds.move_of_bound[rows]
        lower[rows], upper[rows] = low[inputs] - u[inputs % m], high[inputs] - u[inputs % m]
        usual, above, below = condensed.problem.limits, condensed.bounds.above, condensed.bounds.below
        upper[condensed.bounds.above_rows] += self.y_max.ravel()[above - l] - usual.y_max[above % l]
        lower[condensed.bounds.below_rows] += self.y_min.ravel()[below - l] - usual.y_min[below % l]
        bound_of_move = np.full(condensed.n_moves, -1)
        bound_of_move[inputs] = np.arange(rows.start, rows.stop)
        if not condensed.bounds.every_move:
            bound_of_move[:m] = np.arange(v, n_simple)
        bounds_now = BoundsNow(
            np.maximum(lower, -UNBOUNDED), np.minimum(upper, UNBOUNDED), condensed.bounds.of_moves,
            self.inputs.low - u, self.inputs.high - u, bound_of_move, condensed.input_prefix,
        )  # fmt: skip
        return Sample(
            sample.data.copy(), sample.parts, sample.parameter, sample.u_previous, sample.frozen, bounds_now
        )


def _rows(name: str, value: Any, usual: Array, rows: int) -> Array:
    """A limit per sample and signal, shape (rows, signals); the usual one where none is given."""
    if value is None:
        return np.tile(usual, (rows, 1))
    given = as_read(name, value)
    if given.shape not in ((), usual.shape, (rows, *usual.shape)):
        raise MampcError(
            f"limits: expected {name} as a scalar, of shape {usual.shape} or {(rows, *usual.shape)}, "
            f"received shape {given.shape}"
        )
    return np.where(np.isnan(given), usual, np.broadcast_to(given, (rows, *usual.shape)))


def _known(condensed: CondensedQP) -> dict[str, BoolArray]:
    """The signals for which the program has each limit."""
    usual, m = condensed.problem.limits, condensed.problem.model.n_inputs
    inputs = np.isfinite(usual.u_min) | np.isfinite(usual.u_max)
    return {
        "u_min": inputs, "u_max": inputs, "du_max": np.full(m, condensed.bounds.every_move),
        "y_min": np.isfinite(usual.y_min), "y_max": np.isfinite(usual.y_max),
    }  # fmt: skip
