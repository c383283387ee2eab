"""The program with some moves free, the others zero, and no rules: a relaxation of all patterns among these moves."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array, BoolArray
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import UNBOUNDED, QuadraticProgram
from mampc.program.sample import Sample


class Relaxation:
    """One warm solver for any set of free moves: a row per move pins it to zero, or not. One more for all moves."""

    def __init__(self, condensed: CondensedQP) -> None:
        program, n = condensed.program, condensed.n_moves
        pins = np.eye(n, program.n_variables, k=condensed.n_violations)
        self._all_free = DaqpSolver(program)
        self._pinned = DaqpSolver(QuadraticProgram(program.H, np.vstack([program.A, pins]), program.n_simple))

    def begin(self) -> None:
        """Begin a sample, whose answers are not to depend on those of the last one."""
        self._all_free.start()
        self._pinned.start()

    def of_plain(self, sample: Sample) -> Array | None:
        """Multipliers of the limits, shape (n_bounds,), with every move free; None without an answer."""
        return self._all_free.solve(sample.f, sample.lower, sample.upper).multipliers

    def multipliers(self, sample: Sample, free: BoolArray) -> Array | None:
        """The same with only the moves `free`, shape (n_moves,)."""
        width = np.where(free, UNBOUNDED, 0.0)
        lower, upper = np.concatenate([sample.lower, -width]), np.concatenate([sample.upper, width])
        multipliers = self._pinned.solve(sample.f, lower, upper).multipliers
        return None if multipliers is None else multipliers[: len(sample.lower)]
