"""Greedy forward selection with exchanges (see `local_search`), on the quadratic with limits priced in."""

from __future__ import annotations

from dataclasses import dataclass

from mampc.base.checks import Array
from mampc.methods.heuristic import Heuristic, HeuristicSearch
from mampc.methods.local_search import LocalSearch
from mampc.moves.admissible import Allowance
from mampc.moves.pattern_solver import Incumbent
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.sample import Sample


@dataclass(frozen=True, kw_only=True)
class Greedy(Heuristic):
    """Settings of greedy selection: none of its own."""

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> HeuristicSearch:
        return GreedySearch(self, condensed, rules)


class GreedySearch(HeuristicSearch):
    """Greedy selection, prepared for one condensed problem."""

    def __init__(self, settings: Greedy, condensed: CondensedQP, rules: MoveRules) -> None:
        super().__init__(settings, condensed, rules)
        self._local = LocalSearch(condensed, self.admissible)

    def _propose(
        self, sample: Sample, allowance: Allowance, guess: Array | None, best: Incumbent
    ) -> tuple[int, Array | None]:
        self._local.offer(self._solver, sample, self._priced_limits(sample), allowance, best)
        return best.solved, None
