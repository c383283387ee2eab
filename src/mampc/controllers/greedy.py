"""Greedy forward selection with exchanges (see `local_search`), on the quadratic with limits priced in."""

from __future__ import annotations

from dataclasses import dataclass

from mampc.arrays import Array
from mampc.condensing import CondensedQP
from mampc.controllers.heuristic import Heuristic, HeuristicSearch
from mampc.controllers.local_search import LocalSearch
from mampc.controllers.pattern_solver import Incumbent
from mampc.instance import Instance
from mampc.patterns import MoveRules, Past


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
        self, instance: Instance, past: Past, guess: Array | None, best: Incumbent
    ) -> tuple[int, Array | None]:
        self._local.offer(self._solver, instance, self._priced_limits(instance), past, best)
        return best.solved, None
