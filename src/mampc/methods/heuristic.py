"""What the methods without a proof share: they propose patterns, and the best plan on any of these is taken.

A method is a generator of patterns. Each `yield` hands one out and gives back the best moves on it, which may help to
find the next; `HeuristicSearch` alone solves.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from functools import cached_property
from time import perf_counter
from typing import NamedTuple, TypeAlias

import numpy as np

from mampc.base.checks import Array, BoolArray, as_flag
from mampc.base.tolerances import INSIDE, tie
from mampc.base.words import Remark, Status
from mampc.methods.exact.search import Exact, ExactSearch
from mampc.methods.method import HELD_BY, Plan, shifted
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.pattern_solver import Incumbent, OnPattern, PatternSolver
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample

REFEREE_SECONDS = 1.0  # that a certificate may take, or the question whether there is any plan, per sample
SECONDS = 1.0  # of a sample, after which no further pattern is tried
MOST_PROGRAMS = 1000  # of one sample with least sizes, where only an exact method has to try all signs


@dataclass(frozen=True, kw_only=True)
class Heuristic(ABC):
    """Settings that these methods share.

    Args:
        certify: search the exact optimum as well, for at most a second a sample, so that decisions report
            a lower bound and a gap.
    """

    certify: bool = False

    def __post_init__(self) -> None:
        as_flag("certify", self.certify)

    @abstractmethod
    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> HeuristicSearch:
        """The search for one problem and one set of rules."""


class Ended(NamedTuple):
    """How a search for patterns ended: rounds it took, moves (n_moves,) to start the next sample from, what failed."""

    rounds: int
    moves: Array | None = None
    failure: QPStatus | None = None


Proposals: TypeAlias = Generator[BoolArray, OnPattern, Ended]


def proposing(patterns: Iterable[BoolArray], ended: Ended) -> Proposals:
    """Proposes these patterns, whatever the moves on them."""
    for pattern in patterns:  # noqa: UP028 - a generator takes what is sent to it, and other iterators do not
        yield pattern
    return ended


class HeuristicSearch:
    """A method prepared for one condensed problem: all it adds is `_propose`."""

    warm_up = 0

    def __init__(self, settings: Heuristic, condensed: CondensedQP, rules: MoveRules) -> None:
        problem = condensed.problem
        self.condensed, self.rules, self._certify = condensed, rules, settings.certify
        self.admissible = AdmissiblePatterns(
            rules, problem.model.n_inputs, problem.control_horizon, condensed.input_prefix
        )
        self._solver = PatternSolver(condensed, self.admissible)

    @cached_property
    def _referee(self) -> ExactSearch:
        return Exact(time_limit=REFEREE_SECONDS).prepare(self.condensed, self.rules)

    def plan(self, sample: Sample, inputs: Array, guess: Array | None) -> Plan:
        """The best plan on any proposed pattern."""
        allowance = self.admissible.allowance(inputs, sample.frozen)
        last = None if guess is None else guess.ravel()
        proposals = self._propose(sample, allowance, last) if allowance.left else proposing((), Ended(0))
        return self._best_of(proposals, sample, inputs, allowance)

    def _propose(self, sample: Sample, allowance: Allowance, guess: Array | None) -> Proposals:
        """Patterns worth a try; `guess` are the moves, (n_moves,), that the last sample's search ended with."""
        raise NotImplementedError

    def _best_of(
        self,
        proposals: Proposals,
        sample: Sample,
        inputs: Array,
        allowance: Allowance,
        status: Status = Status.FEASIBLE,
    ) -> Plan:
        """The best plan on the patterns proposed, as an answer; no moves at all is always among them."""
        best, solved, solver = Incumbent(MOST_PROGRAMS), None, self._solver.after(inputs)
        deadline, ended = perf_counter() + SECONDS, Ended(0)
        try:
            while solved is None or perf_counter() < deadline:
                pattern = next(proposals) if solved is None else proposals.send(solved)
                solved = solver.offer(sample, pattern, best, deadline)
            ended, status = Ended(best.solved), Status.TIME_LIMIT
        except StopIteration as end:
            ended = end.value
            if perf_counter() > deadline:  # what was tried last may have been cut short
                status = Status.TIME_LIMIT
        best.offer(solver.solve(sample, np.zeros(self.condensed.n_moves, dtype=bool), best.objective))
        guess, remarks = self._shifted(ended.moves), self._remarks(allowance)
        if best.moves is not None:
            plan = Plan(
                best.moves, status, ended.rounds, guess=guess, objective=best.objective, remarks=remarks
            )
            return self._certified(plan, sample, inputs) if self._certify else plan
        if self._multipliers_of_plain(sample) is not None:
            # Some moves keep the limits, if perhaps on no pattern: that is for the exact search to say.
            return self._referee.plan(sample, inputs)._replace(guess=guess)
        failure = ended.failure or best.failure or QPStatus.INFEASIBLE
        return Plan(None, HELD_BY[failure], ended.rounds, guess=guess, remarks=remarks)

    def _remarks(self, allowance: Allowance) -> tuple[Remark, ...]:
        return (Remark.BUDGET_EXCEEDED,) if allowance.exceeded else ()

    def _multipliers_of_plain(self, sample: Sample) -> Array | None:
        """The multipliers of the limits, shape (n_bounds,), with every move free; None where nothing keeps these."""
        return self.condensed.plain.solve(sample.moves, sample.lower, sample.upper).multipliers

    def _priced_limits(self, sample: Sample) -> Array:
        """The linear term of the moves, with the limits priced by the multipliers of plain MPC."""
        margins = sample.margins
        if margins[margins.argmin()] > INSIDE:
            return sample.f_moves
        multipliers = self._multipliers_of_plain(sample)
        return (
            sample.f_moves if multipliers is None else self.condensed.relaxed_limits(sample, multipliers)[0]
        )

    def _shifted(self, moves: Array | None) -> Array | None:
        return None if moves is None else shifted(moves, self.admissible.n_inputs)

    def _certified(self, plan: Plan, sample: Sample, inputs: Array) -> Plan:
        """The plan with a proven lower bound."""
        proof = self._referee.plan(sample, inputs)
        bound = proof.objective if proof.lower_bound is None else proof.lower_bound
        if bound is None or plan.objective is None:
            return plan
        if plan.objective - bound <= 10 * tie(plan.objective, self.condensed.rounding(sample)):
            return plan._replace(status=Status.OPTIMAL, lower_bound=None)
        return plan._replace(lower_bound=min(bound, plan.objective))
