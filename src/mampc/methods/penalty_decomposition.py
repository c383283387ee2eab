"""Penalty decomposition: the alternating minimisation with a penalty that grows until copies agree.

    minimise J(d) + mu |v - d|^2 over d within the limits and v on an admissible pattern

by turns in d and v until both settle; then mu grows, until |d - v| vanishes (Lu and Zhang 2013). Unlike the
paper's fixed mu, the pattern may still change while the penalty is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.methods.heuristic import Ended, Heuristic, HeuristicSearch, Proposals
from mampc.methods.splitting import FirstStep, alternate, mean_curvature
from mampc.moves.admissible import Allowance
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample

MOST_GROWTHS = 60
LARGEST_CONDITION = 1e12  # of the program with the penalty: what a solver can still do


@dataclass(frozen=True, kw_only=True)
class PenaltyDecomposition(Heuristic):
    """Settings of the penalty decomposition.

    Args:
        penalty: first mu, as a multiple of the mean curvature of the moves.
        growth: factor of mu, above 1.
        tolerance: largest |d - v| at the end, and change of the plan that counts as settled, as shares of a move
            that matters (`CondensedQP.move_size`).
        max_iterations: rounds of both steps for one mu.
    """

    penalty: float = 0.01
    growth: float = 4.0
    tolerance: float = 1e-4
    max_iterations: int = 100

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("penalty", self.penalty, 0.0, exclusive=True)
        as_number("growth", self.growth, 1.0, exclusive=True)
        as_number("tolerance", self.tolerance, 0.0, exclusive=True)
        as_whole("max_iterations", self.max_iterations, 1)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> HeuristicSearch:
        return PenaltyDecompositionSearch(self, condensed, rules)


class PenaltyDecompositionSearch(HeuristicSearch):
    """The penalty decomposition, prepared for one condensed problem."""

    def __init__(self, settings: PenaltyDecomposition, condensed: CondensedQP, rules: MoveRules) -> None:
        super().__init__(settings, condensed, rules)
        self.settings = settings
        self._mu = settings.penalty * mean_curvature(condensed)
        self._first_steps = [FirstStep(condensed, self._mu)]
        unit = np.concatenate([np.ones(condensed.n_violations), condensed.move_size])
        least = float(np.linalg.eigvalsh(condensed.program.H * np.outer(unit, unit))[0])
        self._largest_mu = 0.25 * LARGEST_CONDITION * least / condensed.move_size**2

    def _propose(self, sample: Sample, allowance: Allowance, guess: Array | None) -> Proposals:
        settings, rounds = self.settings, 0
        v: Array = np.zeros(self.condensed.n_moves) if guess is None else guess
        for number in range(MOST_GROWTHS):
            if number == len(self._first_steps):
                if (self._first_steps[-1].mu * settings.growth > self._largest_mu).any():
                    break
                self._first_steps.append(FirstStep(self.condensed, self._mu * settings.growth**number))
            first_step = self._first_steps[number]
            mu = first_step.mu
            inner = alternate(
                first_step, sample, v, lambda d, mu=mu: self.admissible.select(mu * d * d, allowance),  # type: ignore[misc]
                settings.tolerance, settings.max_iterations, self.condensed.move_size,
            )  # fmt: skip
            rounds += inner.rounds
            # Not settled by its last round, the alternation goes on with the next mu.
            if inner.status not in (QPStatus.OPTIMAL, QPStatus.ITERATION_LIMIT):
                return Ended(rounds, failure=inner.status)
            v = inner.v
            if (np.abs(inner.d - v) / self.condensed.move_size).max() <= settings.tolerance:
                break
        yield v != 0
        return Ended(rounds, v)
