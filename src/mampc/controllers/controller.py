"""The step all controllers share: check, condense, plan, decide. Methods differ only in the plan."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray, as_array, as_number, as_shaped, as_vector, is_usable
from mampc.base.errors import MampcError
from mampc.base.tolerances import INSIDE, SAME
from mampc.base.words import Remark, Status
from mampc.controllers.decision import ControllerState, Decision
from mampc.methods.method import HELD_BY, Plan
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import PatternSolver
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import DaqpSolver, active_bounds
from mampc.program.limits_now import LimitsNow
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.sample import Indices, Sample


class Controller(ABC):
    """A receding-horizon controller: `step` is pure, all memory is in the state it takes and returns.

    Make one controller for each thread; states may go from one to the other.

    Args:
        problem: what to track, over which horizons, at what weights and within what limits.
        time_limit: seconds that one quadratic program may take; None for no limit.
    """

    def __init__(
        self, problem: TrackingProblem, *, time_limit: float | None = None, bound_every_move: bool = False
    ) -> None:
        if not isinstance(problem, TrackingProblem):
            raise MampcError(f"problem: expected a mampc.TrackingProblem, received {type(problem).__name__}")
        self.problem = problem
        self.condensed = CondensedQP(problem, bound_every_move=bound_every_move)
        if time_limit is not None:
            time_limit = as_number("time_limit", time_limit, 0.0, exclusive=True)
        self._time_limit = time_limit
        self._solver = DaqpSolver(self.condensed.program, time_limit=time_limit)
        self._resting: PatternSolver | None = None  # plain MPC while some inputs may not move
        limits, model = problem.limits, problem.model
        # Without limits of their own inputs still stay within what counts as a number.
        self._u_min = np.maximum(limits.u_min, -LARGEST / 2)
        self._u_max = np.minimum(limits.u_max, LARGEST / 2)
        self._u_range = list(zip(self._u_min.tolist(), self._u_max.tolist(), strict=True))
        self._some_unlimited = bool(np.isinf([limits.u_min, limits.u_max]).any())
        self._du_max = limits.du_max if np.isfinite(limits.du_max).any() else None
        self._no_violations = np.zeros(model.n_outputs)
        self._unknown_violations = np.full(model.n_outputs, np.nan)
        for constant in (self._no_violations, self._unknown_violations):
            constant.setflags(write=False)
        self._shape = (problem.control_horizon, model.n_inputs)
        self._memory = 1
        self._x_shape = (model.n_states,)
        self._reference_shapes = ((model.n_outputs,), (problem.prediction_horizon + 1, model.n_outputs))

    @property
    def memory(self) -> int:
        """How many past inputs the controller looks back on."""
        return self._memory

    def initial_state(self, u_previous: Any = None) -> ControllerState:
        """The state before the first sample.

        Args:
            u_previous: inputs applied so far, shape (m,) or (h, m) with the latest last; default the
                operating point. Missing earlier inputs are taken to have been the same.
        """
        m = self.problem.model.n_inputs
        u = as_array("u_previous", self.problem.model.u_op if u_previous is None else u_previous)
        if u.ndim == 2 and u.shape[0] >= 1:
            past = np.stack([as_vector("u_previous", row, m) for row in u])
        else:
            past = as_vector("u_previous", u, m)[None]
        missing = max(0, self.memory - len(past))
        past = np.concatenate([np.repeat(past[:1], missing, axis=0), past])
        return ControllerState(past[-self.memory :])

    def step(
        self,
        state: ControllerState,
        x: Any,
        reference: Any,
        *,
        output_disturbance: Array | None = None,
        input_disturbance: Array | None = None,
        measured_disturbance: Array | None = None,
        limits: Limits | None = None,
        manual: Any = None,
    ) -> Decision:
        """Decide the inputs of this sample.

        Args:
            state: from `initial_state` or the previous decision.
            x: the model's (deviation) state, shape (n,).
            reference: absolute outputs to track, shape (l,), or (np + 1, l) when known ahead.
            output_disturbance: added to every predicted output, shape (l,).
            input_disturbance: added to every input of the model, shape (m,).
            measured_disturbance: the model's measured disturbances, taken to stay as they are, in
                engineering units, shape (d,); default those of the operating point.
            limits: of this sample, for signals that have such a limit in the problem: each None, a scalar, one
                value per signal, or one row per sample, (nc, m) for inputs and moves, (np, l) for outputs at
                i = 1..np. Inputs stay within the limits of the problem too, outputs have these instead.
            manual: which inputs somebody else moves now, bool, shape (m,); they are planned to stay as they are.

        Returns:
            A `Decision`. Numbers that `is_usable` refuses lead to a held input and a status, not to an error.

        Raises:
            MampcError: arrays of the wrong shape.
        """
        start = perf_counter()
        self._check(state)
        x = as_shaped("x", x, self._x_shape)
        constant, previewed = self._reference_shapes
        depth = reference.ndim if isinstance(reference, np.ndarray) else _dimensions(reference)
        reference = as_shaped("reference", reference, constant if depth == 1 else previewed)
        present = None if limits is None else LimitsNow(limits, self.condensed)
        by_hand = self.manual_inputs(manual)
        if by_hand is not None:
            present = self._released(state, present, by_hand)
        rest = None if by_hand is None else np.where(by_hand, self.problem.control_horizon, 0)
        planned_from = self._planned_from(state, present)
        while True:
            u_previous = planned_from.inputs[-1]
            parameter = self.condensed.parameter.vector(
                x, u_previous, reference, output_disturbance, input_disturbance, measured_disturbance
            )
            if not is_usable(parameter):
                bad = Plan(None, Status.HELD_BAD_MEASUREMENT, 0)
                return self._decide(bad, None, state, planned_from, present, start)
            if planned_from is not state and self._du_max is not None:
                # The way back inside is all that these inputs may move by at once.
                back = (u_previous != state.inputs[-1]) & np.isfinite(self._du_max)
                rest = np.maximum(0 if rest is None else rest, back.astype(np.intp))
            sample = self.condensed.sample(parameter, u_previous, rest)
            if present is not None:
                if present.crossed:
                    crossed = Plan(None, Status.HELD_INFEASIBLE, 0)
                    return self._decide(crossed, sample, state, planned_from, present, start)
                sample = present.applied_to(sample, self.condensed)
            plan = self._plan(sample, planned_from)
            if plan.status is Status.HELD_INFEASIBLE and planned_from is state:
                # Inputs outside their limits may be too far to go back within du_max: the limits come first.
                planned_from = self._brought_inside(state, present)
                if planned_from is not state:
                    continue
                if self._may_rest(sample):  # then nothing is infeasible, and it was the numbers that failed
                    plan = plan._replace(status=Status.HELD_SOLVER_FAILED)
            return self._decide(plan, sample, state, planned_from, present, start)

    def _check(self, state: ControllerState) -> None:
        if not isinstance(state, ControllerState) or len(state.inputs) != self._memory:
            raise MampcError(
                f"state: expected a ControllerState with {self._memory} past inputs, from `initial_state` or a "
                f"decision of this controller, received {_described(state)}"
            )

    def _may_rest(self, sample: Sample) -> bool:
        """Whether no move at all keeps the hard limits."""
        condensed = self.condensed
        moves, inputs = slice(condensed.n_violations, condensed.program.n_simple), condensed.bounds.input_rows
        return all(
            bool((sample.lower[rows] <= 0).all() and (sample.upper[rows] >= 0).all())
            for rows in (moves, inputs)
        )

    def _outside(self, u: Array, present: LimitsNow | None) -> bool:
        """Whether some input that is not in manual is outside its limits."""
        low, high = self._u_min, self._u_max
        if present is not None and not present.crossed:
            low, high = present.planned_min[0], present.planned_max[0]
        return bool(((u < low - SAME) | (u > high + SAME)).any())

    def manual_inputs(self, manual: Any) -> BoolArray | None:
        """Which inputs are in manual, shape (m,), as `step` is told; None for no input.

        Raises:
            MampcError: the wrong shape.
        """
        if manual is None:
            return None
        flags = as_shaped("manual", manual, self._shape[1:]) != 0.0
        return flags if flags.any() else None

    def _released(
        self, state: ControllerState, present: LimitsNow | None, by_hand: BoolArray
    ) -> LimitsNow | None:
        """The limits of this sample, which are none for inputs that are held outside them by hand."""
        u = state.inputs[-1]
        low, high = (np.atleast_2d(limit) for limit in self._range(present))
        if not (by_hand & ((u < low) | (u > high)).any(axis=0)).any():
            return present
        present = LimitsNow(Limits(), self.condensed) if present is None else present
        present.release(by_hand)
        return present

    def _planned_from(self, state: ControllerState, present: LimitsNow | None) -> ControllerState:
        """The state that plans start from; the state itself unless a method wants another."""
        return state

    def _range(self, present: LimitsNow | None) -> tuple[Array, Array]:
        """Least and largest inputs, shape (m,), or (nc, m) with limits of this sample."""
        if present is None or present.crossed:
            return self._u_min, self._u_max
        return present.u_min, present.u_max

    def _brought_inside(self, state: ControllerState, present: LimitsNow | None) -> ControllerState:
        """The state to plan from where the applied inputs are outside their limits: they go back at once.

        That is a move like any other, so it stands in the window of the rules as the latest one.
        """
        low, high = self._u_min, self._u_max
        if present is not None and not present.crossed:
            low, high = present.planned_min[:1], present.planned_max[:1]
        inside = np.minimum(np.maximum(state.inputs[-1:], low), high)
        if (inside == state.inputs[-1:]).all():
            return state
        kept = state.inputs[1:] if len(state.inputs) > 1 else state.inputs[:0]
        return replace(state, inputs=np.concatenate([kept, inside]))

    def _price(self, moves: Array) -> float:
        """What the moves, shape (n_moves,), cost beside the tracking problem's own objective."""
        return 0.0

    @abstractmethod
    def _plan(self, sample: Sample, state: ControllerState) -> Plan:
        """Search the moves for one sample's data."""

    def _decide(
        self,
        plan: Plan,
        sample: Sample | None,
        state: ControllerState,
        planned_from: ControllerState,
        present: LimitsNow | None,
        start: float,
    ) -> Decision:
        moves, status, iterations, lower_bound, guess, inputs, objective, remarks, active = plan
        held = moves is None or sample is None
        if moves is None or sample is None:
            moves = np.zeros(self.condensed.n_moves)
            objective, lower_bound = np.nan, -np.inf
        elif objective is None:
            objective = self.condensed.cost(sample, moves) + self._price(moves)
        if lower_bound is None:
            lower_bound = objective
        changes = moves.reshape(self._shape)
        violations: Array = self._no_violations
        if inputs is None:
            if self._du_max is not None:
                changes = np.minimum(np.maximum(changes, -self._du_max), self._du_max)
            # Sums in this order leave an input that does not move exactly where it was.
            planned = np.concatenate((planned_from.inputs[-1:], changes)).cumsum(axis=0)[1:]
            low, high = self._range(present)
            inputs = np.minimum(np.maximum(planned, low), high)
            if held and planned_from is state and self._outside(planned[0], present):
                remarks = (*remarks, Remark.BACK_INSIDE)
            if sample is None:
                violations = self._unknown_violations
            elif self.condensed.n_violations:
                violations = self.condensed.violations(sample, moves)
                violations.setflags(write=False)
        else:
            inputs = inputs.reshape(self._shape)
            if present is not None:
                inputs = np.minimum(np.maximum(inputs, present.u_min), present.u_max)
            if self._some_unlimited:
                inputs = np.minimum(np.maximum(inputs, self._u_min), self._u_max)
        if planned_from is not state:  # the way back inside the limits is part of the plan, and unproven
            changes = changes.copy()
            changes[0] += planned_from.inputs[-1] - state.inputs[-1]
            weight = self.condensed.R
            way_back = changes.ravel() @ weight @ changes.ravel() - moves @ weight @ moves
            objective = float(objective + way_back + self._price(changes.ravel()) - self._price(moves))
            lower_bound = -np.inf
            remarks = (*remarks, Remark.BACK_INSIDE)
            status = Status.FEASIBLE if status is Status.OPTIMAL else status
        # What is handed out is also what is remembered.
        inputs.setflags(write=False)
        changes.setflags(write=False)
        u, history = inputs[0], state.inputs
        history = inputs[:1] if len(history) == 1 else np.concatenate((history[1:], inputs[:1]))
        return Decision(
            u, inputs, changes, status, objective, lower_bound, iterations,
            perf_counter() - start, ControllerState(history, state.samples + 1, guess, active), remarks, violations,
        )  # fmt: skip

    def _unrestricted(self, sample: Sample, state: ControllerState) -> Plan:
        """Plain MPC: every move is free. Where no limit is active the optimum is at hand already."""
        if sample.frozen is not None:
            return self._while_resting(sample, sample.frozen)
        margins = sample.margins
        if margins[margins.argmin()] > INSIDE:
            return Plan(sample.moves, Status.OPTIMAL, 0, None, None, sample.inputs, sample.cost)
        self._solver.start(state.active)
        solution = self._solver.solve(sample.f, sample.lower, sample.upper)
        if solution.z is None or solution.multipliers is None:
            return Plan(None, HELD_BY[solution.status], solution.iterations)
        return Plan(
            solution.z[self.condensed.n_violations :], Status.OPTIMAL, solution.iterations, None,
            active=active_bounds(solution.multipliers),
        )  # fmt: skip

    def _while_resting(self, sample: Sample, rest: Indices) -> Plan:
        """Plain MPC where some inputs may not move for some samples."""
        m, n_c = len(rest), self.problem.control_horizon
        if self._resting is None:
            self._resting = PatternSolver(
                self.condensed, AdmissiblePatterns(MoveRules(), m, n_c), time_limit=self._time_limit
            )
        solved = self._resting.solve(sample, (np.arange(n_c)[:, None] >= rest).ravel())
        if solved.moves is None:
            return Plan(None, HELD_BY.get(solved.status, Status.HELD_SOLVER_FAILED), solved.iterations)
        return Plan(solved.moves, Status.OPTIMAL, solved.iterations, None, objective=solved.objective)


def _described(state: Any) -> str:
    return f"one with {len(state.inputs)}" if isinstance(state, ControllerState) else type(state).__name__


def _dimensions(values: Any) -> int:
    """How deep lists are nested; 1 for ragged ones, which no shape fits."""
    try:
        return np.ndim(values)
    except ValueError:
        return 1
