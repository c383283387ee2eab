"""Iterative hard thresholding: gradient steps of length 1/L, each cut to the best admissible pattern.

With L the largest eigenvalue of H, the cost J(d) = 1/2 d' H d + f' d is at most its gradient model with
curvature L, so that no step raises it (Blumensath and Davies 2008). A move is worth L/2 d_i^2 to the model;
the pattern of largest total worth less price is kept. Limits enter by the multipliers of plain MPC.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.methods.heuristic import Ended, Heuristic, HeuristicSearch, Proposals
from mampc.moves.admissible import Allowance
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Sample


@dataclass(frozen=True, kw_only=True)
class HardThresholding(Heuristic):
    """Settings of iterative hard thresholding.

    Args:
        tolerance: stop when no move changes by more, as a share of one that matters (`CondensedQP.move_size`).
        max_iterations: gradient steps at most.
    """

    tolerance: float = 1e-6
    max_iterations: int = 500

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("tolerance", self.tolerance, 0.0, exclusive=True)
        as_whole("max_iterations", self.max_iterations, 1)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> HeuristicSearch:
        return HardThresholdingSearch(self, condensed, rules)


class HardThresholdingSearch(HeuristicSearch):
    """Iterative hard thresholding, prepared for one condensed problem."""

    def __init__(self, settings: HardThresholding, condensed: CondensedQP, rules: MoveRules) -> None:
        super().__init__(settings, condensed, rules)
        self.settings = settings
        unit = condensed.move_size
        H = condensed.H * np.outer(unit, unit)
        self._lipschitz = float(np.linalg.eigvalsh(H)[-1])
        self._contraction = np.eye(condensed.n_moves) - H / self._lipschitz

    def _propose(self, sample: Sample, allowance: Allowance, guess: Array | None) -> Proposals:
        L, unit = self._lipschitz, self.condensed.move_size
        step = -self._priced_limits(sample) * unit / L
        d: Array = (sample.moves if guess is None else guess) / unit
        pattern, rounds = d != 0, 0
        while rounds < self.settings.max_iterations:
            rounds += 1
            free = self._contraction @ d + step
            pattern = self.admissible.select(0.5 * L * free * free, allowance)
            last, d = d, free * pattern
            if np.abs(d - last).max() <= self.settings.tolerance:
                break
        yield pattern
        return Ended(rounds, d * unit)
