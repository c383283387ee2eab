"""The step all controllers share: check, condense, plan, decide. Methods differ only in the plan."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any, Self

import numpy as np

from mampc.base.checks import (
    Array,
    BoolArray,
    as_array,
    as_instance,
    as_number,
    as_shaped,
    as_vector,
    is_usable,
)
from mampc.base.errors import MampcError
from mampc.base.tolerances import INSIDE, SAME
from mampc.base.words import Remark, Status
from mampc.controllers.decision import ControllerState, Decision
from mampc.controllers.way_back import way_back
from mampc.methods.method import HELD_BY, Plan, doubted
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import PatternSolver
from mampc.moves.rules import MoveRules
from mampc.program.condensing import CondensedQP
from mampc.program.daqp import active_bounds
from mampc.program.levels import InputLevels
from mampc.program.limits_now import InputRange, LimitsNow, UsualLimits
from mampc.program.problem import Limits, TrackingProblem
from mampc.program.sample import Indices, Sample
from mampc.program.zone import Zone
from mampc.systems.state_space import StateSpace

WARM = 20  # moves from which on it saves time to start from the last active bounds
ROUNDED = 1e-12  # relative to an input: what sums of moves may be off by


class Controller(ABC):
    """A receding-horizon controller: `step` is pure, all memory is in the state it takes and returns.

    Make one controller for each thread; states may go from one to the other.

    Args:
        problem: what to track, over which horizons, at what weights and within what limits.
        time_limit: seconds that a sample may take, up to which an answer has to be there; None for no limit.
        condensed: the condensed problem, where another controller has it already.
        levels: what inputs can be, see `MoveRules`.
    """

    _made_of: tuple[tuple[Any, ...], dict[str, Any]]
    starts_inside = False  # whether plans start from inputs inside their limits, or are to lead there

    def __new__(cls, *arguments: Any, **settings: Any) -> Self:
        made = super().__new__(cls)
        made._made_of = arguments, settings
        return made

    def __init__(
        self,
        problem: TrackingProblem,
        *,
        time_limit: float | None = None,
        bound_every_move: bool = False,
        condensed: CondensedQP | None = None,
        levels: Any = None,
    ) -> None:
        self.problem = as_instance("problem", problem, TrackingProblem)
        if time_limit is not None:
            time_limit = as_number("time_limit", time_limit, 0.0, exclusive=True)
        if condensed is None:
            condensed = CondensedQP(problem, bound_every_move=bound_every_move, time_limit=time_limit)
        self.condensed = condensed
        self._while_frozen: PatternSolver | None = None  # plain MPC while some inputs may not move
        limits, model = problem.limits, problem.model
        self.levels = None if levels is None else InputLevels(levels, problem)
        self._usual_limits = UsualLimits(self.condensed, self.levels)
        self._some_unlimited = bool(np.isinf([limits.u_min, limits.u_max]).any())
        self._resolution = SAME * self.condensed.input_prefix
        self._no_violations = np.zeros(model.n_outputs)
        self._unknown_violations = np.full(model.n_outputs, np.nan)
        for constant in (self._resolution, self._no_violations, self._unknown_violations):
            constant.setflags(write=False)
        self._shape = (problem.control_horizon, model.n_inputs)
        self._memory = 1
        self._warm = self.condensed.n_moves >= WARM
        self._x_shape = (model.n_states,)
        self._reference_shapes = ((model.n_outputs,), (problem.prediction_horizon + 1, model.n_outputs))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.problem!r})"

    @property
    def each(self) -> tuple[Controller, ...]:
        """The controllers one of which decides a sample: itself, or the variants of a bank."""
        return (self,)

    @property
    def memory(self) -> int:
        """How many past inputs the controller looks back on."""
        return self._memory

    @property
    def resolution(self) -> Array:
        """Changes up to here are rounding and no moves, in input units, shape (m,); see `Decision`."""
        return self._resolution

    def with_model(self, model: StateSpace) -> Self:
        """The same controller, predicting with another model of the same signals."""

        def on_model(argument: Any) -> Any:
            if isinstance(argument, Controller):
                return argument.with_model(model)
            if isinstance(argument, Mapping):
                return {name: on_model(value) for name, value in argument.items()}
            return replace(argument, model=model) if isinstance(argument, TrackingProblem) else argument

        arguments, settings = self._made_of
        return type(self)(*map(on_model, arguments), **{k: on_model(v) for k, v in settings.items()})

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
        hypotheses: Array | None = None,
    ) -> Decision:
        """Decide the inputs of this sample.

        Args:
            state: from `initial_state` or the previous decision.
            x: the model's (deviation) state, shape (n,).
            reference: absolute outputs to track, shape (l,), or (np + 1, l) when known ahead; or a `Zone`.
            output_disturbance: added to every predicted output, shape (l,).
            input_disturbance: added to every input of the model, shape (m,).
            measured_disturbance: the model's measured disturbances, taken to stay as they are, in
                engineering units, shape (d,); default those of the operating point.
            limits: of this sample, for signals that have such a limit in the problem: each None, a scalar, one
                value per signal, or one row per sample, (nc, m) for inputs and moves, (np, l) for outputs at
                i = 1..np. Inputs stay within the limits of the problem too, outputs have these instead.
            manual: which inputs somebody else moves now, bool, shape (m,); they are planned to stay where they are,
                beyond their limits too.
            hypotheses: how much what each hypothesis about the loads will tell counts, shape (B,), for plans that count
                on later data.

        Returns:
            A `Decision`. Numbers that `is_usable` refuses lead to a held input and a status, not to an error.

        Raises:
            MampcError: arrays of the wrong shape.
        """
        start = perf_counter()
        self._check(state)
        x = as_shaped("x", x, self._x_shape)
        constant, previewed = self._reference_shapes
        if isinstance(reference, Zone):
            reference = self.condensed.parameter.of_zone(reference)
        else:
            depth = reference.ndim if isinstance(reference, np.ndarray) else _dimensions(reference)
            reference = as_shaped("reference", reference, constant if depth == 1 else previewed)
        limits_now = self._usual_limits if limits is None else LimitsNow(limits, self.condensed, self.levels)
        applied, frozen = state.inputs[-1], None
        in_manual = self.manual_inputs(manual)
        if in_manual is not None:
            limits_now = limits_now.with_manual(in_manual, applied)
            frozen = np.where(in_manual, self.problem.control_horizon, 0)
        parameter = self.condensed.parameter.vector(
            x, applied, reference, output_disturbance, input_disturbance, measured_disturbance
        )
        if not is_usable(parameter):
            plan, sample = Plan(None, Status.HELD_BAD_MEASUREMENT, 0), None
        else:
            sample = self.condensed.sample(parameter, applied, frozen)
            if limits_now.crossed:
                plan = Plan(None, Status.HELD_INFEASIBLE, 0)
            else:
                sample = self._with_later_data(limits_now.applied_to(sample), hypotheses)
                try:
                    plan = self._plan_from(state, sample, limits_now)
                except (ArithmeticError, np.linalg.LinAlgError):  # numbers that no method foresaw end no loop
                    plan = Plan(None, Status.HELD_SOLVER_FAILED, 0)
        if plan.moves is None or sample is None:
            plan = self._to_hold(plan, sample, state, limits_now.inputs)
        elif plan.objective is None or plan.inputs is None or self._may_leave(limits_now):
            plan = self._completed(plan, plan.moves, sample, state, limits_now)
        if sample is not None and self.condensed.ill_conditioned:
            plan = doubted(plan, self.condensed, sample)
        return self._decision(plan, state, limits_now.inputs, start)

    def range_now(self, limits: Limits | None) -> tuple[Array, Array]:
        """Least and largest inputs of this sample, shape (m,) each; `limits` as `step` takes them."""
        usual = self._usual_limits if limits is None else LimitsNow(limits, self.condensed, self.levels)
        return usual.inputs.low[0], usual.inputs.high[0]

    def manual_inputs(self, manual: Any) -> BoolArray | None:
        """Which inputs are in manual, shape (m,), as `step` takes it; None for no input.

        Raises:
            MampcError: the wrong shape.
        """
        if manual is None:
            return None
        flags = as_shaped("manual", manual, self._shape[1:]) != 0.0
        return flags if flags.any() else None

    def _check(self, state: ControllerState) -> None:
        if not isinstance(state, ControllerState) or len(state.inputs) != self._memory:
            raise MampcError(
                f"state: expected a ControllerState with {self._memory} past inputs, from `initial_state` or a "
                f"decision of this controller, received {_described(state)}"
            )

    def _may_leave(self, limits: UsualLimits | LimitsNow) -> bool:
        """Whether an optimum that keeps the limits of the program may leave the range of the inputs all the same."""
        return self._some_unlimited or limits is not self._usual_limits or self.levels is not None

    def _plan_from(self, state: ControllerState, sample: Sample, limits: UsualLimits | LimitsNow) -> Plan:
        """The plan for a sample, with the way back of inputs that are outside their limits."""
        inputs, applied = limits.inputs, state.inputs[-1]
        if not self.starts_inside or inputs.holds(applied):
            plan = self.plan(sample, state)
            if plan.status is not Status.HELD_INFEASIBLE:
                return plan
            if inputs.holds(applied):
                # Where holding keeps the limits nothing is infeasible, and it was the numbers that failed.
                return plan._replace(status=Status.HELD_SOLVER_FAILED) if self._may_hold(sample) else plan
        back = way_back(state, sample, limits, self.condensed)
        back.sample.later_data = sample.later_data
        return back.joined(self.plan(back.sample, back.state))

    def _may_hold(self, sample: Sample) -> bool:
        """Whether no move at all keeps the limits of inputs and moves."""
        condensed = self.condensed
        moves, inputs = slice(condensed.n_violations, condensed.bounds.n_simple), condensed.bounds.input_rows
        return all(
            bool((sample.lower[rows] <= 0).all() and (sample.upper[rows] >= 0).all())
            for rows in (moves, inputs)
        )

    def _charge(self, moves: Array, sample: Sample) -> float:
        """What moves, shape (n_moves,), cost beside the tracking problem's own objective."""
        return 0.0

    def _with_later_data(self, sample: Sample, hypotheses: Array | None) -> Sample:
        """The sample, for plans that count on later data with what patterns forgo of these."""
        return sample

    @abstractmethod
    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """Search the moves for one sample's data."""

    def _completed(
        self,
        plan: Plan,
        moves: Array,
        sample: Sample,
        state: ControllerState,
        limits: UsualLimits | LimitsNow,
    ) -> Plan:
        """The plan with its inputs, objective and violations, which all belong to the same moves."""
        status, lower_bound, objective, violations = (
            plan.status, plan.lower_bound, plan.objective, plan.violations
        )  # fmt: skip
        changes, planned, applied = moves.reshape(self._shape), plan.inputs, state.inputs[-1:]
        if planned is not None:
            planned = planned.reshape(self._shape)
        else:
            if limits.du_max is not None:
                changes = np.minimum(np.maximum(changes, -limits.du_max), limits.du_max)
            # Sums in this order leave an input that does not move exactly where it was.
            planned = np.add.accumulate(changes)
            planned += applied
        kept = limits.inputs.clipped(planned)
        same = kept.tobytes() == planned.tobytes()  # as nearly always
        if not same and (np.abs(kept - planned) > self._resolution + ROUNDED * np.abs(planned)).any():
            # Planned beyond what counts as a number: this is another plan, of which nothing is proven.
            changes = np.diff(kept, axis=0, prepend=applied)
            status, lower_bound, objective, violations = Status.FEASIBLE, -np.inf, None, None
        moves = changes.ravel()
        if objective is None:
            objective = self.condensed.cost(sample, moves) + self._charge(moves, sample)
        if violations is None and self.condensed.n_violations:
            violations = self.condensed.violations(sample, moves)
        return Plan(
            moves, status, plan.iterations, lower_bound, plan.guess, kept, objective, plan.remarks, plan.active,
            plan.memory, violations,
        )  # fmt: skip

    def _to_hold(self, plan: Plan, sample: Sample | None, state: ControllerState, inputs: InputRange) -> Plan:
        """The plan to hold the inputs, or the nearest ones within their limits."""
        planned = inputs.held(state.inputs[-1])
        moves, remarks = np.diff(planned, axis=0, prepend=state.inputs[-1:]).ravel(), plan.remarks
        if (np.abs(moves.reshape(self._shape)) > self._resolution).any():
            remarks = (*remarks, Remark.BACK_INSIDE)
        violations = self._unknown_violations
        if sample is not None:
            violations = self.condensed.violations(sample, moves)
        return plan._replace(
            moves=moves, lower_bound=-np.inf, inputs=planned, objective=np.nan,
            remarks=remarks, violations=violations,
        )  # fmt: skip

    def _decision(self, plan: Plan, state: ControllerState, inputs: InputRange, start: float) -> Decision:
        """The decision to follow a plan, complete with inputs and objective, whose arrays are read-only."""
        assert plan.moves is not None
        assert plan.inputs is not None
        assert plan.objective is not None
        planned, changes = plan.inputs.reshape(self._shape), plan.moves.reshape(self._shape)
        objective, lower_bound, violations = plan.objective, plan.lower_bound, plan.violations
        if lower_bound is None:
            lower_bound = objective
        if violations is None:
            violations = self._no_violations
        # What is handed out is also what is remembered.
        for array in (planned, changes, violations):
            array.setflags(write=False)
        u, history = inputs.applied(planned), state.inputs
        if len(history) == 1:
            history = u[None]
        else:
            history = np.concatenate((history[1:], u[None]))
            history.setflags(write=False)
        return Decision(
            u, planned, changes, plan.status, objective, lower_bound, plan.iterations, perf_counter() - start,
            ControllerState(history, state.samples + 1, plan.guess, plan.active, plan.memory), plan.remarks, violations,
            self._resolution,
        )  # fmt: skip

    def _unrestricted(self, sample: Sample, state: ControllerState) -> Plan:
        """Plain MPC: every move is free. Where no limit is active the optimum is at hand already."""
        if sample.frozen is not None:
            return self._unrestricted_but_frozen(sample, sample.frozen)
        margins = sample.margins
        if margins[margins.argmin()] > INSIDE:
            return Plan(sample.moves, Status.OPTIMAL, 0, None, None, sample.inputs, sample.cost)
        nearest = self.condensed.nearest(sample, state.active if self._warm else None)
        if nearest.moves is None or nearest.multipliers is None:
            return Plan(None, HELD_BY[nearest.status], nearest.iterations)
        active = active_bounds(nearest.multipliers) if self._warm else None
        violations = None if nearest.violated else self._no_violations
        return Plan(
            nearest.moves, Status.OPTIMAL, nearest.iterations, None, None, None, sample.cost + nearest.excess,
            active=active, violations=violations,
        )  # fmt: skip

    def _unrestricted_but_frozen(self, sample: Sample, frozen: Indices) -> Plan:
        """Plain MPC where some inputs may not move for some samples."""
        m, n_c = len(frozen), self.problem.control_horizon
        if self._while_frozen is None:
            self._while_frozen = PatternSolver(self.condensed, AdmissiblePatterns(MoveRules(), m, n_c))
        solved = self._while_frozen.solve(sample, (np.arange(n_c)[:, None] >= frozen).ravel())
        if solved.moves is None:
            return Plan(None, HELD_BY.get(solved.status, Status.HELD_SOLVER_FAILED), solved.programs)
        return Plan(solved.moves, Status.OPTIMAL, solved.programs, None, objective=solved.objective)


def _described(state: Any) -> str:
    return f"one with {len(state.inputs)}" if isinstance(state, ControllerState) else type(state).__name__


def _dimensions(values: Any) -> int:
    """How deep lists are nested; 1 for ragged ones, which no shape fits."""
    try:
        return np.ndim(values)
    except ValueError:
        return 1
