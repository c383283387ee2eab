"""ADMM for the sparse problem: consensus of a quadratic program and a projection, from several starts.

    d <- argmin J(d) + mu |d - (v - w)|^2  within the limits
    v <- d + w on the admissible pattern of largest worth mu (d + w)^2, zero elsewhere
    w <- w + d - v

The projection is not convex, so that the limit depends on the start; the best of several is taken
(Takapoui, Moehle, Boyd and Bemporad 2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_number, as_whole
from mampc.methods.heuristic import Ended, Heuristic, HeuristicSearch, Proposals
from mampc.methods.splitting import FirstStep, mean_curvature
from mampc.moves.admissible import Allowance
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample


@dataclass(frozen=True, kw_only=True)
class ADMM(Heuristic):
    """Settings of the alternating direction method of multipliers.

    Args:
        penalty: mu, as a multiple of the mean curvature of the moves.
        starts: how many starts: no moves, then plain MPC and the last plan, then random moves.
        iterations: rounds from each start.
        seed: of the random starts.
    """

    penalty: float = 0.1
    starts: int = 5
    iterations: int = 40
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("penalty", self.penalty, 0.0, exclusive=True)
        as_whole("starts", self.starts, 1, 1000)
        as_whole("iterations", self.iterations, 1)
        as_whole("seed", self.seed, 0)

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> HeuristicSearch:
        return ADMMSearch(self, condensed, rules)


class ADMMSearch(HeuristicSearch):
    """ADMM, prepared for one condensed problem."""

    def __init__(self, settings: ADMM, condensed: CondensedQP, rules: MoveRules) -> None:
        super().__init__(settings, condensed, rules)
        self.settings = settings
        self._first_step = FirstStep(condensed, settings.penalty * mean_curvature(condensed))
        self._random = np.random.default_rng(settings.seed).standard_normal(
            (settings.starts, condensed.n_moves)
        )

    def _propose(self, sample: Sample, allowance: Allowance, guess: Array | None) -> Proposals:
        first_step, mu = self._first_step, self._first_step.mu
        data, unlimited, unit = first_step.begin(sample), sample.moves, self.condensed.move_size
        starts = [np.zeros(len(unlimited)), unlimited] + ([guess] if guess is not None else [])
        starts += list(self._random * unit * (np.abs(unlimited) / unit).max())
        proposed, rounds, moves = set(), 0, None
        for v in starts[: self.settings.starts]:
            w = np.zeros(len(v))
            for _ in range(self.settings.iterations):
                rounds += 1
                d, _, solved = first_step.minimise(data, v - w)
                if solved is not QPStatus.OPTIMAL:
                    return Ended(rounds, moves, solved)
                pattern = self.admissible.select(mu * (d + w) ** 2, allowance)
                v = (d + w) * pattern
                w = w + d - v
            if pattern.tobytes() not in proposed:
                proposed.add(pattern.tobytes())
                if (yield pattern).moves is not None:  # better than all before
                    moves = v
        return Ended(rounds, moves)
