"""The program with some moves free, the others zero, and no rules: a relaxation of all patterns among these moves."""

from __future__ import annotations

import numpy as np

from mampc.arrays import Array, BoolArray
from mampc.condensing import CondensedQP
from mampc.instance import Instance
from mampc.qp import UNBOUNDED, QuadraticProgram
from mampc.qp_daqp import DaqpSolver


class Relaxation:
    """One warm solver for any set of free moves: a row per move pins it to zero, or not."""

    def __init__(self, condensed: CondensedQP) -> None:
        program, n = condensed.program, condensed.n_moves
        pins = np.eye(n, program.n_variables, k=condensed.n_violations)
        self._solver = DaqpSolver(QuadraticProgram(program.H, np.vstack([program.A, pins]), program.n_simple))

    def begin(self) -> None:
        """Begin a sample, whose answers are not to depend on those of the last one."""
        self._solver.start()

    def multipliers(self, instance: Instance, free: BoolArray) -> Array | None:
        """Those of the limits, shape (n_bounds,), with the moves `free`, shape (n_moves,); None without an answer."""
        width = np.where(free, UNBOUNDED, 0.0)
        lower, upper = np.concatenate([instance.lower, -width]), np.concatenate([instance.upper, width])
        multipliers = self._solver.solve(instance.f, lower, upper).multipliers
        return None if multipliers is None else multipliers[: len(instance.lower)]
