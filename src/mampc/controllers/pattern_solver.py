"""Quadratic programs on a fixed move pattern: everything off the pattern is exactly zero."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np

from mampc.arrays import BoolArray
from mampc.condensing import CondensedQP, Instance, Restriction
from mampc.qp import QPSolution, QPStatus
from mampc.qp_daqp import DaqpSolver

MOST_KEPT = 4096  # patterns whose solvers are kept, some ten kilobytes each


class PatternSolver:
    """Solves the condensed program restricted to one pattern at a time, keeping recent solvers warm."""

    def __init__(self, condensed: CondensedQP) -> None:
        self.condensed = condensed
        self._kept: OrderedDict[bytes, tuple[Restriction, DaqpSolver]] = OrderedDict()

    def solve(self, instance: Instance, pattern: BoolArray) -> QPSolution:
        """The best moves d, shape (n_moves,), that are zero off `pattern`; multipliers are not reported."""
        moves = np.zeros(self.condensed.n_moves)
        if not pattern.any():
            return QPSolution(moves, None, QPStatus.OPTIMAL, 0)
        restriction, solver = self._solver(pattern)
        solution = solver.solve(
            instance.f[restriction.columns],
            instance.lower[restriction.bounds],
            instance.upper[restriction.bounds],
        )
        if solution.z is None:
            return solution
        moves[pattern] = solution.z[self.condensed.n_violations :]
        return QPSolution(moves, None, solution.status, solution.iterations)

    def _solver(self, pattern: BoolArray) -> tuple[Restriction, DaqpSolver]:
        key = pattern.tobytes()
        entry = self._kept.get(key)
        if entry is None:
            restriction = self.condensed.restricted(pattern)
            entry = self._kept[key] = restriction, DaqpSolver(restriction.program)
            if len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        else:
            self._kept.move_to_end(key)
        return entry
