"""What a method is: frozen settings that prepare a search, which plans each sample."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from mampc.base.checks import Array
from mampc.base.tolerances import CERTAIN, left_open
from mampc.base.words import Remark, Status
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.qp import QPStatus
from mampc.program.sample import Sample

HELD_BY = {
    QPStatus.INFEASIBLE: Status.HELD_INFEASIBLE,
    QPStatus.BAD_DATA: Status.HELD_INFEASIBLE,  # data are finite here, so bounds crossed
    QPStatus.ITERATION_LIMIT: Status.HELD_SOLVER_FAILED,
    QPStatus.TIME_LIMIT: Status.HELD_SOLVER_FAILED,
    QPStatus.FAILED: Status.HELD_SOLVER_FAILED,
}


class Plan(NamedTuple):
    """A method's answer: moves d (n_moves,) or None, how it ended, a proven bound, and its next guess.

    `lower_bound` None means that the plan is proven optimal: its own objective is the bound. Inputs (n_moves,), the
    objective and the violations of outputs (l,) are worked out from the moves where not at hand.
    """

    moves: Array | None
    status: Status
    iterations: int
    lower_bound: float | None = -np.inf
    guess: Array | None = None
    inputs: Array | None = None
    objective: float | None = None
    remarks: tuple[Remark, ...] = ()
    active: Array | None = None
    memory: Array | None = None
    violations: Array | None = None


def doubted(plan: Plan, condensed: CondensedQP, sample: Sample) -> Plan:
    """The plan with a bound that rounding cannot break, where this is looser than a proof may be."""
    objective = plan.objective
    bound = objective if plan.lower_bound is None else plan.lower_bound
    if objective is None or bound is None or bound == -np.inf:
        return plan
    doubt = left_open(objective, condensed.rounding(sample, plan.moves))
    if doubt <= CERTAIN * objective:
        return plan
    status = Status.FEASIBLE if plan.status is Status.OPTIMAL else plan.status
    remarks = tuple(remark for remark in plan.remarks if remark is not Remark.ROUNDING)
    return plan._replace(status=status, lower_bound=bound - doubt, remarks=(*remarks, Remark.ROUNDING))


def shifted(moves: Array, m: int) -> Array:
    """Moves of m inputs as they stand one sample later, shape (nc, m)."""
    return np.concatenate([moves[m:], np.zeros(m)]).reshape(-1, m)


class Search(Protocol):
    """A method prepared for one problem: plans each sample after `warm_up` samples of plain MPC."""

    warm_up: int

    def plan(self, sample: Sample, inputs: Array, guess: Array | None) -> Plan: ...


class Method(Protocol):
    """A frozen set of settings that prepares a search."""

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> Search: ...
