"""Limits that hold at one sample only, told at run time: constant, or one row per sample of the horizon."""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray, as_read
from mampc.base.errors import MampcError
from mampc.program.condensing import CondensedQP
from mampc.program.problem import Limits
from mampc.program.qp import UNBOUNDED
from mampc.program.sample import BoundsNow, Sample


class LimitsNow:
    """The limits of one sample, over the horizon.

    Inputs stay within the limits of the problem too, which are those of the actuators; limits of outputs
    replace those of the problem. What is None or not a number stays as the problem has it.

    Attributes:
        u_min, u_max: shape (nc, m).
        du_max: shape (nc, m).
        y_min, y_max: at i = 1..np, shape (np, l).
        crossed: whether some u_min is above its u_max, so that no input can keep both.
        planned_min, planned_max: what plans keep, shape (nc, m): `u_min` and `u_max`, and no limits for inputs that
            somebody else holds beyond them.

    Raises:
        MampcError: the wrong shape, or limits of signals for which the problem has none.
    """

    def __init__(self, limits: Limits, condensed: CondensedQP) -> None:
        problem, usual = condensed.problem, condensed.problem.limits
        n_c, n_p = problem.control_horizon, problem.prediction_horizon
        known = _known(condensed)

        def told(name: str, rows: int) -> Array:
            own = getattr(usual, name)
            given = _rows(name, getattr(limits, name), own, rows)
            if (np.isfinite(given).any(axis=0) & ~known[name]).any():
                raise MampcError(
                    f"limits: expected {name} only of signals that have one in the problem, received "
                    f"{getattr(limits, name)!r}; give the problem a {name}, however wide"
                )
            return given

        self.u_min = np.maximum(told("u_min", n_c), np.maximum(usual.u_min, -LARGEST / 2))
        self.u_max = np.minimum(told("u_max", n_c), np.minimum(usual.u_max, LARGEST / 2))
        self.du_max = np.clip(told("du_max", n_c), 0.0, usual.du_max)
        # Beyond what counts as a number a limit is as good as none, or as one that nothing can keep.
        self.y_min = np.minimum(told("y_min", n_p), LARGEST)
        self.y_max = np.maximum(told("y_max", n_p), -LARGEST)
        self.crossed = bool((self.u_min > self.u_max).any())
        self.planned_min, self.planned_max = self.u_min, self.u_max

    def release(self, manual: BoolArray) -> None:
        """Have plans leave inputs in manual, shape (m,), where they are, though they are outside their limits."""
        self.planned_min = np.where(manual, -LARGEST, self.u_min)
        self.planned_max = np.where(manual, LARGEST, self.u_max)

    def applied_to(self, sample: Sample, condensed: CondensedQP) -> Sample:
        """The sample with these limits for bounds."""
        v, n_simple = condensed.n_violations, condensed.program.n_simple
        m, l = condensed.problem.model.n_inputs, condensed.problem.model.n_outputs
        lower, upper, u = sample.lower.copy(), sample.upper.copy(), sample.u_previous
        low, high = self.planned_min.ravel(), self.planned_max.ravel()
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
        present = BoundsNow(
            np.maximum(lower, -UNBOUNDED), np.minimum(upper, UNBOUNDED), condensed.bounds.of_moves,
            self.planned_min - u, self.planned_max - u, bound_of_move,
        )  # fmt: skip
        return Sample(sample.data, sample.parts, sample.parameter, sample.u_previous, sample.frozen, present)


def _rows(name: str, value: Any, usual: Array, rows: int) -> Array:
    """A limit per sample and signal, shape (rows, signals); the usual one where nothing is told."""
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
