"""Minimum-attention MPC: the tracking problem under move rules, solved by a chosen method."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_choice, as_instance, as_vector
from mampc.base.errors import MampcError
from mampc.base.tolerances import ROUNDING, SAME, URGENT
from mampc.base.words import Remark, Status
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.methods.exact.search import ExactSearch
from mampc.methods.method import Method, Plan
from mampc.methods.registry import method_of
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.information import Information
from mampc.moves.rounding import without_rounding
from mampc.moves.rules import MoveRules
from mampc.program.problem import TrackingProblem
from mampc.program.sample import Sample

ON_LIMIT_VIOLATION = ("keep_budget", "ignore_budget")


class MAMPC(Controller):
    """Minimum-attention model predictive control.

    Args:
        problem: what to track (see `TrackingProblem`).
        rules: what moves cost and which patterns of moves are admissible (see `MoveRules`).
        method: "exact" (the default: proven best), "alternating" (the paper's), or another name of
            `mampc.METHODS`; or a method object with settings such as `mampc.Alternating(penalty=10.0)`.
        on_limit_violation: "keep_budget" (the default) keeps the rules whatever happens; "ignore_budget"
            suspends them, price and all, at samples where under them some output would leave its limits by more
            than `violation_margin`, and by more than plain MPC would let it.
        violation_margin: see there; in output units, a scalar or one value per output.
        settings: of a method given by name, such as `penalty=10.0`.

    Raises:
        MampcError: an unknown method or setting, or rules that do not fit the problem.
    """

    starts_inside = True  # a pattern says which inputs move, so none may be outside when it is chosen

    def __init__(
        self,
        problem: TrackingProblem,
        rules: MoveRules,
        *,
        method: str | Method = "exact",
        on_limit_violation: str = "keep_budget",
        violation_margin: Any = 0.0,
        **settings: Any,
    ) -> None:
        as_instance("rules", rules, MoveRules)
        every = bool(np.any(rules.min_size)) or rules.levels is not None
        super().__init__(problem, bound_every_move=every, levels=rules.levels)
        as_choice("on_limit_violation", on_limit_violation, ON_LIMIT_VIOLATION)
        margin = as_vector("violation_margin", violation_margin, problem.model.n_outputs, 0.0)
        self._margin = margin if on_limit_violation == "ignore_budget" else None
        if self._margin is not None and self.levels is not None:
            raise MampcError(
                "on_limit_violation: expected 'keep_budget' with levels, which plain MPC does not keep, received "
                f"{on_limit_violation!r}"
            )
        self.rules = rules
        self._memory = max(rules.memory, 1 if self.levels is None else self.levels.memory)
        self.method = method_of(method, settings)
        self._admissible = AdmissiblePatterns(
            rules, problem.model.n_inputs, problem.control_horizon, self.condensed.input_prefix
        )
        self._check_sizes()
        self._rounding = ROUNDING * self.condensed.move_prefix
        self.information: Information | None = None
        # Without any rule this is plain MPC.
        self._search = None if self._admissible.unrestricted else self.method.prepare(self.condensed, rules)

    def __repr__(self) -> str:
        return f"MAMPC({self.problem!r}, {self.rules!r}, method={self.method!r})"

    def _check_sizes(self) -> None:
        """A least size beyond what an input can move means that it never does."""
        limits, size = self.problem.limits, self._admissible.min_size[: self.problem.model.n_inputs]
        free = [] if self.levels is None else [values is None for values in self.levels.values]
        if free and (size[free] > 0).any():
            raise MampcError(
                f"min_size: expected 0 for inputs that take any value beside others on levels, received {size}"
            )
        for name, most in (("du_max", limits.du_max), ("u_max - u_min", limits.u_max - limits.u_min)):
            if (size > most).any():
                raise MampcError(f"min_size: expected at most {name} = {most}, received {size}")

    @property
    def is_plain(self) -> bool:
        """Whether no rule binds, so that this is plain MPC."""
        return self._search is None

    def with_information(self, shifts: Array, *, price_follows_noise: bool = False) -> MAMPC:
        """This controller with plans that count on later data; `shifts` as `Information` takes them.

        Raises:
            MampcError: inputs on levels, since what later data are worth is known for moves of any size; prices that
                follow the noise with another search than the exact one by a table.
        """
        if self.levels is not None:
            raise MampcError(
                "value_of_information: expected inputs that take any value, received rules with levels"
            )
        search = self._search
        if isinstance(search, ExactSearch):
            search = search.beside_later_data()
        by_table = isinstance(search, ExactSearch) and search.has_table
        if price_follows_noise and not by_table:
            raise MampcError(
                "price_follows_noise: expected method='exact' with so few patterns that all are listed, received "
                f"{self.method!r} with {self.condensed.n_moves} moves"
            )
        counting = copy(self)
        counting._search = search
        price_of = self._admissible.charge if price_follows_noise else None
        counting.information = Information(self.problem, shifts, price_of)
        return counting

    def _with_later_data(self, sample: Sample, hypotheses: Array | None) -> Sample:
        if self.information is not None and hypotheses is not None:
            sample.later_data = self.information.at(hypotheses)
        return sample

    def _charge(self, moves: Array, sample: Sample) -> float:
        pattern = np.abs(moves) > SAME * self.condensed.move_prefix
        return self._admissible.charge(pattern) + sample.charge(pattern)

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        search = self._search
        if search is None:
            return self._unrestricted(sample, state)
        if state.samples >= search.warm_up:
            plan = self._without_rounding(search.plan(sample, state.inputs, state.guess), sample)
            return plan if self._margin is None else self._unless_urgent(plan, sample, state, self._margin)
        plan = self._unrestricted(sample, state)
        if plan.moves is None:
            return plan
        return plan._replace(status=Status.WARM_UP, lower_bound=-np.inf, objective=None)

    def _without_rounding(self, plan: Plan, sample: Sample) -> Plan:
        """The plan without moves that are too small to count."""
        if plan.moves is None:
            return plan
        if np.count_nonzero(np.abs(plan.moves) > self._rounding) == np.count_nonzero(plan.moves):
            return plan
        moves = without_rounding(self.condensed, sample, plan.moves)
        # A move that later data will decide may be planned though nothing calls for it yet.
        objective = None if sample.later_data is None else plan.objective
        return plan._replace(moves=moves, inputs=None, objective=objective)

    def _unless_urgent(self, plan: Plan, sample: Sample, state: ControllerState, margin: Array) -> Plan:
        """The plan, or that of plain MPC where the rules would cost a violation beyond the margin."""
        if not self.condensed.n_violations:
            return plan
        moves = np.zeros(self.condensed.n_moves) if plan.moves is None else plan.moves
        violations = self.condensed.violations(sample, moves)
        if not (violations > margin).any():
            return plan
        urgent = self._unrestricted(sample, state)
        if urgent.moves is None:
            return plan
        gained = violations - self.condensed.violations(sample, urgent.moves)
        lower = gained * self.condensed.bounds.violation_scale > URGENT
        if not (lower & (violations > margin)).any():
            return plan
        return urgent._replace(
            status=Status.FEASIBLE,
            lower_bound=-np.inf,
            objective=None,
            inputs=None,
            remarks=(*plan.remarks, Remark.RULES_SUSPENDED),
        )
