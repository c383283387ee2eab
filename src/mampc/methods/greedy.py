"""Greedy forward selection with exchanges (see `local_search`), on the quadratic with limits priced in."""

from __future__ import annotations

from dataclasses import dataclass

from mampc.base.checks import Array
from mampc.methods.heuristic import Ended, Heuristic, HeuristicSearch, Proposals
from mampc.methods.local_search import LocalSearch
from mampc.moves.admissible import Allowance
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

    def _propose(self, sample: Sample, allowance: Allowance, guess: Array | None) -> Proposals:
        rounds = yield from self._local.patterns(sample, self._priced_limits(sample), allowance)
        return Ended(rounds)
