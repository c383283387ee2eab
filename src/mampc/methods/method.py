"""What a method is: frozen settings that prepare a search, which plans each sample."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from mampc.base.checks import Array
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


class Search(Protocol):
    """A method prepared for one problem: plans each sample after `warm_up` samples of plain MPC."""

    warm_up: int

    def plan(self, sample: Sample, inputs: Array, guess: Array | None) -> Plan: ...


class Method(Protocol):
    """A frozen set of settings that prepares a search."""

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> Search: ...
