"""What splitting methods share: a quadratic program in d whose penalty ties it to a copy v on a pattern."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import QPStatus, QuadraticProgram
from mampc.program.sample import Sample


class Settled(NamedTuple):
    """How an alternation ended: moves d, their copy v on the pattern, rounds.

    The status is ITERATION_LIMIT where it had to stop, and the solver's where the first step failed.
    """

    d: Array
    v: Array
    rounds: int
    status: QPStatus


def alternate(
    first_step: FirstStep,
    sample: Sample,
    v: Array,
    choose: Callable[[Array], BoolArray],
    tolerance: float,
    most: int,
    unit: Array | float = 1.0,
) -> Settled:
    """Both steps by turns from v, until the planned inputs change by no more than the tolerance in sum.

    They are counted in their `unit`, one for all moves or shape (n_moves,).
    """
    data, u_last, d = first_step.begin(sample), None, v
    for rounds in range(1, most + 1):
        d, u, solved = first_step.minimise(data, v)
        if solved is not QPStatus.OPTIMAL:
            return Settled(d, v, rounds, solved)
        v = d * choose(d)
        if u_last is not None and (np.abs(u - u_last) / unit).sum() <= tolerance:
            return Settled(d, v, rounds, QPStatus.OPTIMAL)
        u_last = u
    return Settled(d, v, most, QPStatus.ITERATION_LIMIT)


class FirstStepData(NamedTuple):
    """One sample's data for the first step: its minimiser at v = 0 without limits, f, all bounds."""

    start: Array
    f: Array
    lower: Array
    upper: Array
    lower_rows: Array
    upper_rows: Array


class FirstStep:
    """argmin J(d) + sum mu_i (v_i - d_i)^2 within the limits, for one mu, a number or shape (n_moves,).

    The unconstrained minimiser is affine in v, so it costs one product; the solver is called only when
    that minimiser breaks a limit.
    """

    def __init__(self, condensed: CondensedQP, mu: Array | float) -> None:
        self.mu, self._violations = mu, condensed.n_violations
        full, v = condensed.program, condensed.n_violations
        H = full.H.copy()
        H[v:, v:] += 2 * mu * np.eye(condensed.n_moves)
        self._solver = DaqpSolver(QuadraticProgram(H, full.A, full.n_simple))
        inverse = np.linalg.inv(H[v:, v:])
        self._inverse, self._from_v = (inverse + inverse.T) / 2, 2 * mu * inverse
        self._cumulate = condensed.cumulate
        # One product gives the changes of u and every bounded quantity.
        self._rows = np.vstack([condensed.cumulate, condensed.bounds.of_moves])

    def begin(self, sample: Sample) -> FirstStepData:
        """What the rounds of one sample share."""
        v = self._violations
        self._solver.start()
        start = -(self._inverse @ sample.f_moves)
        return FirstStepData(start, sample.f, sample.lower, sample.upper, sample.lower[v:], sample.upper[v:])

    def minimise(self, data: FirstStepData, v: Array) -> tuple[Array, Array, QPStatus]:
        """The moves d and the changes u - u_previous they add up to, each (n_moves,), if OPTIMAL."""
        start, f, lower, upper, lower_rows, upper_rows = data
        d: Array = start + self._from_v @ v
        rows = self._rows @ d
        n = len(d)
        bounded = rows[n:]
        if (bounded >= lower_rows).all() and (bounded <= upper_rows).all():
            return d, rows[:n], QPStatus.OPTIMAL
        f = f.copy()
        f[self._violations :] -= 2 * self.mu * v
        solution = self._solver.solve(f, lower, upper)
        if solution.z is None:
            return d, d, solution.status
        d = solution.z[self._violations :]
        return d, self._cumulate @ d, QPStatus.OPTIMAL


def mean_curvature(condensed: CondensedQP) -> Array:
    """The mean curvature of the cost in the moves, as weights, shape (n_moves,), that mean the same in all units."""
    unit = condensed.move_size
    curvature: Array = (np.diag(condensed.H) * unit**2).mean() / unit**2
    return curvature
