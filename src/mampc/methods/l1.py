"""The l1 relaxation: the number of moves is replaced by the sum of their sizes, plain or reweighted.

    minimise J(d) + weight sum_i c_i |d_i|    within the limits

as a quadratic program with one more variable t_i >= |d_i| per move. A budget is met by bisection on the
weight: the least one whose moves are admissible. Where only a price counts, weights on a grid give a
path of patterns. Reweighting (Candes, Wakin and Boyd 2008) repeats this with c_i = 1 / (|d_i| + epsilon), which
charges large moves no more than small ones. All patterns met on the way are polished; the best is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, BoolArray, as_whole
from mampc.methods.heuristic import Ended, Heuristic, HeuristicSearch, Proposals, proposing
from mampc.methods.splitting import mean_curvature
from mampc.moves.admissible import Allowance
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver
from mampc.program.qp import UNBOUNDED, QuadraticProgram
from mampc.program.sample import Sample

CURVATURE = 1e-6  # of t, relative to the moves': daqp wants a strictly convex program
ZERO = 1e-5  # of the largest move without limits: below it a move of the relaxation is none
WEIGHTS = 12  # of a path


@dataclass(frozen=True, kw_only=True)
class L1(Heuristic):
    """Settings of the l1 relaxation.

    Args:
        reweightings: how often the moves are weighed anew; 0 is plain l1.
        bisections: programs a budget may take.
    """

    reweightings: int = 0
    bisections: int = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        as_whole("reweightings", self.reweightings, 0, 100)
        as_whole("bisections", self.bisections, 1, 100)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> HeuristicSearch:
        return L1Search(self, condensed, rules)


@dataclass(frozen=True, kw_only=True)
class ReweightedL1(L1):
    """The reweighted l1 relaxation: `L1` with three reweightings."""

    reweightings: int = 3


class L1Search(HeuristicSearch):
    """The l1 relaxation, prepared for one condensed problem."""

    def __init__(self, settings: L1, condensed: CondensedQP, rules: MoveRules) -> None:
        super().__init__(settings, condensed, rules)
        self.settings = settings
        eye, curvature = np.eye(condensed.n_moves), CURVATURE * mean_curvature(condensed)
        # Next to that little curvature of t moves are small numbers.
        self._program = DaqpSolver(
            with_sizes(condensed, eye, np.zeros_like(eye), curvature), tolerance=1e-9 * np.sqrt(CURVATURE)
        )

    def _propose(self, sample: Sample, allowance: Allowance, guess: Array | None) -> Proposals:
        proposed: dict[bytes, BoolArray] = {}
        unit = self.condensed.move_size
        largest, rounds = (np.abs(sample.moves) / unit).max(), 0
        c = 1 / unit
        self._program.start()
        for _ in range(self.settings.reweightings + 1):
            d, programs = self._weighed(sample, allowance, c, ZERO * largest, proposed)
            rounds += programs
            c = 1 / (d + 0.1 * largest + 1e-300)
            c /= c.max() * unit
        return (yield from proposing(proposed.values(), Ended(rounds)))

    def _weighed(
        self, sample: Sample, allowance: Allowance, c: Array, zero: float, proposed: dict[bytes, BoolArray]
    ) -> tuple[Array, int]:
        """Sizes of the moves under the least weight that meets the rules (or a path's last), and programs solved."""
        n = self.condensed.n_moves
        none = np.zeros(2 * n)
        lower = np.concatenate([sample.lower, none])
        upper = np.concatenate([sample.upper, none + UNBOUNDED])
        high = np.log(max((np.abs(sample.f_moves) / c).max(), 1e-12))
        low = high - np.log(1e6)
        met: Array = np.zeros(n)
        path = np.linspace(low, high, WEIGHTS, endpoint=False)[::-1] if self.admissible.priced else None
        count = self.settings.bisections if path is None else len(path)
        for number in range(count):
            logarithm = 0.5 * (low + high) if path is None else path[number]
            f = np.concatenate([sample.f, np.exp(logarithm) * c])
            solution = self._program.solve(f, lower, upper)
            if solution.z is None:
                break
            all_sizes = np.abs(solution.z[-2 * n : -n]) / self.condensed.move_size
            size = np.where(all_sizes > zero, all_sizes, 0.0)
            admissible = self.admissible.allows(size > 0, allowance)
            # Above any price: here size alone decides, and prices when the patterns are polished.
            pattern = self.admissible.select(
                np.where(size > 0, size + self.admissible.price.max(), 0.0), allowance
            )
            proposed[pattern.tobytes()] = pattern
            if admissible:
                met, high = all_sizes, logarithm
            else:
                low = logarithm
        return met, count


def with_sizes(condensed: CondensedQP, Z: Array, H: Array, curvature: Array) -> QuadraticProgram:
    """The program in (violations, d, t) with t >= |Z d - z0|; z0 comes with the bounds of the last 2 n rows.

    Args:
        condensed: of n moves d.
        Z: shape (n, n).
        H: what the Hessian in d has beside that of the problem, shape (n, n).
        curvature: of t, shape (n,).
    """
    full, v, n = condensed.program, condensed.n_violations, condensed.n_moves
    hessian = np.zeros((v + 2 * n, v + 2 * n))
    hessian[: v + n, : v + n] = full.H
    hessian[v : v + n, v : v + n] += H
    hessian[v + n :, v + n :] = np.diag(curvature)
    none, eye = np.zeros((n, v)), np.eye(n)
    A = np.block([[full.A, np.zeros((len(full.A), n))], [none, -Z, eye], [none, Z, eye]])
    return QuadraticProgram(hessian, A, full.n_simple)
