"""Sums of norms beside a quadratic program, as a second-order cone program for clarabel.

    minimise   1/2 z' H z + f' z + sum_g w_g |M_g z + c_g|    subject to lower <= [z[:n_simple]; A z] <= upper

One more variable s_g >= |M_g z + c_g| stands for each norm. Clarabel (Goulart and Chen 2024) follows the central path,
so that what is zero at the optimum is only nearly so in its answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.program.qp import QPSolution, QPStatus, QuadraticProgram

TOLERANCE = 1e-10  # of gap and residuals, relative
GONE = 1e18  # a bound beyond it is none
HEAVIEST = 1e5  # of weights, where no gradient is longer than about 1: beyond it they say no more


class Norm(NamedTuple):
    """w |M z + c|: the weight, and M, shape (k, n)."""

    weight: float
    M: Array


class NormsSolver:
    """Solves one quadratic program with norms again and again for new f, bounds and c.

    The program is in units in which H has a unit diagonal and f is no longer than 1, whatever those of z are.

    Args:
        program: the constant part.
        norms: at least one; the rows of M have one unit.
    """

    def __init__(self, program: QuadraticProgram, norms: Sequence[Norm]) -> None:
        from scipy.sparse import csc_matrix

        n, count = program.n_variables, len(norms)
        self._n, self._unit = n, 1 / np.sqrt(np.diag(program.H))
        self._sizes = [len(norm.M) for norm in norms]
        H = np.zeros((n + count, n + count))
        H[:n, :n] = program.H * np.outer(self._unit, self._unit)
        self._H = csc_matrix(np.triu(H))
        bounded = np.vstack([np.eye(n)[: program.n_simple], program.A]) * self._unit
        self._row = 1 / np.maximum(np.linalg.norm(bounded, axis=1), 1e-300)
        self._bounded = np.hstack([bounded * self._row[:, None], np.zeros((len(bounded), count))])
        scaled = [norm.M * self._unit for norm in norms]
        self._factor = np.array([np.sqrt(len(M)) / max(np.linalg.norm(M), 1e-300) for M in scaled])
        self._weights = np.array([norm.weight for norm in norms]) / self._factor
        cones = []
        for g, M in enumerate(scaled):
            rows = np.zeros((len(M) + 1, n + count))
            rows[0, n + g], rows[1:, :n] = -1.0, -self._factor[g] * M
            cones.append(rows)
        self._cones = np.vstack(cones)

    def solve(self, f: Array, lower: Array, upper: Array, constants: Sequence[Array]) -> QPSolution:
        """Minimise for f (n,), bounds (n_simple + rows,), and one constant (k,) a norm; no multipliers.

        lower > upper gives the status BAD_DATA.
        """
        import clarabel
        from scipy.sparse import csc_matrix

        if (lower > upper).any():
            return QPSolution(None, None, QPStatus.BAD_DATA, 0)
        scaled = f * self._unit
        away = [factor * c for factor, c in zip(self._factor, constants, strict=True)]
        size = max(np.abs(scaled).max(initial=0.0), *(np.abs(c).max() for c in away)) or 1.0
        low, high = lower * self._row / size, upper * self._row / size
        fixed = lower == upper
        above, below = (upper < GONE) & ~fixed, (lower > -GONE) & ~fixed
        A = np.vstack([self._bounded[fixed], self._bounded[above], -self._bounded[below], self._cones])
        at_cones = np.concatenate([part for c in away for part in (np.zeros(1), c / size)])
        b = np.concatenate([high[fixed], high[above], -low[below], at_cones])
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
        cones = [
            clarabel.ZeroConeT(int(fixed.sum())),
            clarabel.NonnegativeConeT(int(above.sum() + below.sum())),
            *(clarabel.SecondOrderConeT(k + 1) for k in self._sizes),
        ]
        weights = self._weights / size
        weights = weights * min(1.0, HEAVIEST / max(weights.max(), 1e-300))
        q = np.concatenate([scaled / size, weights])
        answer = clarabel.DefaultSolver(self._H, q, csc_matrix(A), b, cones, settings).solve()
        status = _STATUS.get(str(answer.status), QPStatus.FAILED)
        z = self._unit * size * np.array(answer.x)[: self._n] if status is QPStatus.OPTIMAL else None
        if z is not None and not np.isfinite(z).all():
            z, status = None, QPStatus.FAILED
        return QPSolution(z, None, status, answer.iterations)


_STATUS = {
    "Solved": QPStatus.OPTIMAL,
    "AlmostSolved": QPStatus.OPTIMAL,
    "PrimalInfeasible": QPStatus.INFEASIBLE,
    "AlmostPrimalInfeasible": QPStatus.INFEASIBLE,
    "MaxIterations": QPStatus.ITERATION_LIMIT,
}
