"""What the methods without a proof share: they propose patterns, and the best plan on any of these is taken."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_flag
from mampc.base.tolerances import INSIDE, TIE
from mampc.base.words import Remark, Status
from mampc.methods.exact.search import Exact
from mampc.methods.method import HELD_BY, Plan
from mampc.moves.admissible import AdmissiblePatterns, Allowance
from mampc.moves.pattern_solver import Incumbent, PatternSolver
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver
from mampc.program.sample import Sample

CERTIFY_SECONDS = 1.0  # that a certificate may take, per sample
MOST_PROGRAMS = 100  # on one pattern with least sizes, where only an exact method has to try all signs


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


class HeuristicSearch:
    """A method prepared for one condensed problem: all it adds is `_propose`."""

    warm_up = 0

    def __init__(self, settings: Heuristic, condensed: CondensedQP, rules: MoveRules) -> None:
        problem = condensed.problem
        self.condensed, self.rules = condensed, rules
        self.admissible = AdmissiblePatterns(rules, problem.model.n_inputs, problem.control_horizon)
        self._solver = PatternSolver(condensed, self.admissible, most_programs=MOST_PROGRAMS)
        self._relaxed: DaqpSolver | None = None
        self._referee = (
            Exact(time_limit=CERTIFY_SECONDS).prepare(condensed, rules) if settings.certify else None
        )

    def plan(self, sample: Sample, inputs: Array, guess: Array | None) -> Plan:
        """The best plan on any proposed pattern."""
        allowance, best = self.admissible.allowance(inputs, sample.frozen), Incumbent()
        rounds, found = 0, None
        if allowance.left:
            last = None if guess is None else guess.ravel()
            rounds, found = self._propose(sample, allowance, last, best)
        return self._certified(
            self._best(sample, best, allowance, rounds, self._shifted(found)), sample, inputs
        )

    def _propose(
        self, sample: Sample, allowance: Allowance, guess: Array | None, best: Incumbent
    ) -> tuple[int, Array | None]:
        """Offer plans to `best`; returns the rounds this took and moves, (n_moves,), to start the next sample from."""
        return 0, None

    def _best(
        self,
        sample: Sample,
        best: Incumbent,
        allowance: Allowance,
        rounds: int,
        guess: Array | None,
        status: Status = Status.FEASIBLE,
    ) -> Plan:
        """The best plan offered, as an answer; no moves at all is always among them."""
        best.offer(self._solver.solve(sample, np.zeros(self.condensed.n_moves, dtype=bool), best.objective))
        remarks = self._remarks(allowance)
        if best.moves is None:
            held = Status.HELD_INFEASIBLE if best.failure is None else HELD_BY[best.failure]
            return Plan(None, held, rounds, guess=guess, remarks=remarks)
        return Plan(best.moves, status, rounds, guess=guess, objective=best.objective, remarks=remarks)

    def _remarks(self, allowance: Allowance) -> tuple[Remark, ...]:
        return (Remark.BUDGET_EXCEEDED,) if allowance.exceeded else ()

    def _priced_limits(self, sample: Sample) -> Array:
        """The linear term of the moves, with the limits priced by the multipliers of plain MPC."""
        margins = sample.margins
        if margins[margins.argmin()] > INSIDE:
            return sample.f_moves
        if self._relaxed is None:
            self._relaxed = DaqpSolver(self.condensed.program)
        self._relaxed.start()
        solution = self._relaxed.solve(sample.f, sample.lower, sample.upper)
        if solution.multipliers is None:
            return sample.f_moves
        return self.condensed.relaxed_limits(sample, solution.multipliers)[0]

    def _shifted(self, moves: Array | None) -> Array | None:
        """Moves as they stand one sample later, shape (nc, m)."""
        if moves is None:
            return None
        m = self.admissible.n_inputs
        return np.concatenate([moves[m:], np.zeros(m)]).reshape(-1, m)

    def _certified(self, plan: Plan, sample: Sample, inputs: Array) -> Plan:
        """The plan with a proven lower bound, where that is asked for."""
        if self._referee is None or plan.objective is None:
            return plan
        proof = self._referee.plan(sample, inputs)
        bound = proof.objective if proof.lower_bound is None else proof.lower_bound
        if bound is None:
            return plan
        if plan.objective - bound <= 10 * TIE * max(1e-6, sample.constant):
            return plan._replace(status=Status.OPTIMAL, lower_bound=None)
        return plan._replace(lower_bound=min(bound, plan.objective))
