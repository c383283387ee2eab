"""Minimum-attention MPC: the tracking problem under move rules, solved by a chosen method."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from mampc.condensing import CondensedQP, Instance
from mampc.controllers.alternating import Alternating
from mampc.controllers.controller import Controller, Plan
from mampc.controllers.decision import ControllerState, Status
from mampc.errors import MampcError
from mampc.patterns import MoveRules
from mampc.problem import TrackingProblem


class Search(Protocol):
    """A method prepared for one problem: plans each sample after `warm_up` samples of plain MPC."""

    warm_up: int

    def plan(self, instance: Instance, state: ControllerState) -> Plan: ...


class Method(Protocol):
    """A frozen set of settings that prepares a search."""

    def prepare(self, condensed: CondensedQP, rules: MoveRules) -> Search: ...


METHODS: dict[str, type[Alternating]] = {"alternating": Alternating}


class MAMPC(Controller):
    """Minimum-attention model predictive control.

    Args:
        problem: what to track (see `TrackingProblem`).
        rules: which move patterns are admissible (see `MoveRules`).
        method: "alternating" (the paper's), or a method object with settings such as
            `mampc.Alternating(penalty=10.0, polish=True)`.

    Raises:
        MampcError: an unknown method, or rules that the method cannot keep.
    """

    def __init__(
        self, problem: TrackingProblem, rules: MoveRules, *, method: str | Method = "alternating"
    ) -> None:
        super().__init__(problem)
        if not isinstance(rules, MoveRules):
            raise MampcError(f"rules: expected mampc.MoveRules, received {type(rules).__name__}")
        self.rules = rules
        self.method = _method(method)
        self._search = self.method.prepare(self.condensed, rules)

    @property
    def memory(self) -> int:
        return self.rules.sparsity_horizon

    def _planned_from(self, state: ControllerState) -> ControllerState:
        """A pattern says which inputs move, so none may be outside its limits when it is chosen."""
        last = state.inputs[-1]
        inside = (last <= self._u_max).all() and (last >= self._u_min).all()
        return state if inside else self._brought_inside(state)

    def _plan(self, instance: Instance, state: ControllerState) -> Plan:
        if state.samples >= self._search.warm_up:
            return self._search.plan(instance, state)
        plan = self._unrestricted(instance)
        return plan if plan.moves is None else plan._replace(status=Status.WARM_UP, lower_bound=-np.inf)


def _method(method: str | Method) -> Method:
    if isinstance(method, str):
        if method not in METHODS:
            raise MampcError(f"method: expected one of {sorted(METHODS)}, received {method!r}")
        return METHODS[method]()
    if not hasattr(method, "prepare") or isinstance(method, type):
        raise MampcError(f"method: expected a name or a method object, received {method!r}")
    return method
