"""Rules of when to move, around any controller; the inputs are held otherwise.

A rule sees the controller's plan for a sample and says which of its first moves are made. What was not made is not
remembered: the controller plans from the applied inputs again at the next sample.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, BoolArray, as_choice, as_number, as_vector, as_whole
from mampc.base.errors import MampcError
from mampc.base.words import Status
from mampc.controllers.controller import Controller
from mampc.controllers.decision import ControllerState
from mampc.controllers.mpc import MPC
from mampc.methods.method import HELD_BY, Plan
from mampc.moves.admissible import AdmissiblePatterns
from mampc.moves.pattern_solver import PatternSolver
from mampc.moves.rules import MoveRules
from mampc.program.prediction import Prediction
from mampc.program.sample import Sample

BANDS = ("each", "any", "norm")


class Rule(Controller):
    """A rule around a controller.

    Args:
        controller: whose plans are followed or not.

    Raises:
        MampcError: no controller.
    """

    def __init__(self, controller: Controller) -> None:
        if not isinstance(controller, Controller):
            raise MampcError(
                f"controller: expected one such as mampc.MPC, received {type(controller).__name__}"
            )
        if controller.levels is not None:
            raise MampcError("controller: expected one whose inputs take any value, received one with levels")
        super().__init__(controller.problem, condensed=controller.condensed)
        self.controller = controller
        self._memory = controller.memory

    starts_inside = True

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """The controller's first moves, as far as the rule has them made; all later ones are held."""
        if not self.is_due(sample, state):
            return self._only(np.zeros(self.problem.model.n_inputs), Plan(None, Status.FEASIBLE, 0))
        plan = self.controller.plan(sample, state)
        if plan.moves is None:
            return plan
        u = sample.u_previous
        moves = self.chosen(u + plan.moves[: len(u)], u) - u
        least, most = self.first_moves(sample)
        return self._only(np.minimum(np.maximum(moves, least), most), plan)

    def is_due(self, sample: Sample, state: ControllerState) -> bool:
        """Whether the controller is asked at all at this sample."""
        return True

    def first_moves(self, sample: Sample) -> tuple[Array, Array]:
        """The least and the largest move of each input at this sample, shape (m,)."""
        bounds, m = self.condensed.bounds, len(sample.u_previous)
        v, rows = bounds.n_violations, bounds.input_rows
        low, high = sample.lower[v : v + m].copy(), sample.upper[v : v + m].copy()
        of_move = bounds.move_of_bound[rows]
        first = of_move < m
        low[of_move[first]] = np.maximum(low[of_move[first]], sample.lower[rows][first])
        high[of_move[first]] = np.minimum(high[of_move[first]], sample.upper[rows][first])
        return low, high

    def chosen(self, wanted: Array, u: Array) -> Array:
        """The inputs to apply, shape (m,), where the controller wants `wanted` and `u` are applied."""
        return wanted

    def _only(self, first: Array, plan: Plan) -> Plan:
        """The plan to make these first moves, shape (m,), and none later."""
        moves = np.zeros(self.condensed.n_moves)
        moves[: len(first)] = first
        return plan._replace(
            moves=moves, status=Status.FEASIBLE, lower_bound=-np.inf, inputs=None, objective=None
        )


class DeadBand(Rule):
    """An input is replaced only where the new one differs from it by more than a band: what plants do today.

    Args:
        controller: see `Rule`.
        size: half the band, in input units, a scalar or one value per input.
        kind: "each" input by itself, all inputs as soon as "any" leaves its band, or all by the "norm" of the changes
            in units of `size`.
    """

    def __init__(self, controller: Controller, *, size: Any, kind: str = "each") -> None:
        super().__init__(controller)
        self._size = as_vector("size", size, self.problem.model.n_inputs, 0.0)
        self.kind = as_choice("kind", kind, BANDS)

    def chosen(self, wanted: Array, u: Array) -> Array:
        change, size = np.abs(wanted - u), self._size
        beyond: Any = change > size
        if self.kind == "any":
            beyond = beyond.any()
        elif self.kind == "norm":
            beyond = (change[size == 0] > 0).any() or np.hypot.reduce(change[size > 0] / size[size > 0]) > 1
        return np.where(beyond, wanted, u)


class Rounded(Rule):
    """Inputs are rounded to a grid, and change only where they leave the rounded one by more than a hysteresis.

    Args:
        controller: see `Rule`.
        step: of the grid of multiples of it, in input units, a scalar or one value per input.
        hysteresis: share of a step, beyond the half one of rounding, by which the wanted input has to differ from
            the applied one.
    """

    def __init__(self, controller: Controller, *, step: Any, hysteresis: float = 0.0) -> None:
        super().__init__(controller)
        self._step = as_vector("step", step, self.problem.model.n_inputs, 0.0, exclusive=True)
        self._beyond = 0.5 + as_number("hysteresis", hysteresis, 0.0)

    def chosen(self, wanted: Array, u: Array) -> Array:
        limits = self.problem.limits
        grid = np.clip(np.round(wanted / self._step) * self._step, limits.u_min, limits.u_max)
        return np.where(np.abs(wanted - u) > self._beyond * self._step, grid, u)


class Periodic(Rule):
    """Inputs move at every q-th sample only: slower sampling with the same model.

    Plain MPC plans with moves at those samples; a controller with rules of its own does not know that it is held.

    Args:
        controller: see `Rule`.
        every: q >= 1, samples.
    """

    def __init__(self, controller: Controller, *, every: int) -> None:
        super().__init__(controller)
        self._every = as_whole("every", every, 1, 10_000)
        n_c, m = self._shape
        self._due = np.repeat(np.arange(n_c) % self._every == 0, m)
        self._planner: PatternSolver | None = None
        if isinstance(controller, MPC) and self._every > 1:
            self._planner = PatternSolver(self.condensed, AdmissiblePatterns(MoveRules(), m, n_c))

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """At its samples the first moves of the plan, else none."""
        if self._planner is None or sample.frozen is not None or not self.is_due(sample, state):
            return super().plan(sample, state)
        solved = self._planner.solve(sample, self._due)
        if solved.moves is None:
            return Plan(None, HELD_BY.get(solved.status, Status.HELD_SOLVER_FAILED), solved.programs)
        first = solved.moves[: len(sample.u_previous)]
        return self._only(first, Plan(None, Status.FEASIBLE, solved.programs))

    def is_due(self, sample: Sample, state: ControllerState) -> bool:
        return state.samples % self._every == 0


class Predicted(Rule):
    """A rule that looks at predicted outputs."""

    def __init__(self, controller: Controller) -> None:
        super().__init__(controller)
        at = self.condensed.parameter
        free = Prediction(self.problem, at).free
        constant = at.with_constant_reference(free)
        self._free = {free.shape[1]: free, constant.shape[1]: constant}

    def outputs(self, sample: Sample, moves: Array | None = None) -> Array:
        """Predicted outputs y_0 .. y_np with some moves (n_moves,), or none, shape (np + 1, l)."""
        deviation: Array = self._free[len(sample.parameter)] @ sample.parameter
        if moves is not None:
            deviation = deviation + self.condensed.theta @ moves
        y: Array = self.problem.model.y_op + deviation.reshape(-1, self.problem.model.n_outputs)
        return y


class EventTriggered(Predicted):
    """Inputs move when outputs differ from what the last executed plan predicted (Heemels et al. 2012).

    A new reference, and the end of that plan's horizon, are events as well. Of the plan only the first move is
    made, and what it predicted is with all of them: with the first alone in the prediction, or with all of them made,
    there are more moves.

    Args:
        controller: see `Rule`.
        threshold: by how much an output may differ, in output units, a scalar or one value per output.
    """

    def __init__(self, controller: Controller, *, threshold: Any) -> None:
        super().__init__(controller)
        self._threshold = as_vector("threshold", threshold, self.problem.model.n_outputs, 0.0)

    def plan(self, sample: Sample, state: ControllerState) -> Plan:
        """The controller's first moves at an event; the state remembers its reference and what it predicted."""
        l = len(self._threshold)
        reference = sample.parameter[self.condensed.parameter.reference.start :][:l]
        if state.memory is not None and len(state.memory) >= 2 * l and len(state.memory) % l == 0:
            since, expected = state.memory[:l], state.memory[l:].reshape(-1, l)
            as_predicted = np.abs(self.outputs(sample)[0] - expected[0]) <= self._threshold
            if as_predicted.all() and np.array_equal(since, reference):
                plan = self._only(np.zeros(self.problem.model.n_inputs), Plan(None, Status.FEASIBLE, 0))
                return plan._replace(memory=np.concatenate([since, expected[1:].ravel()]))
        plan = self.controller.plan(sample, state)
        if plan.moves is None:
            return plan
        expected = self.outputs(sample, plan.moves)[1:]
        first = self._only(plan.moves[: self.problem.model.n_inputs], plan)
        return first._replace(memory=np.concatenate([reference, expected.ravel()]))


class QuietZone(Predicted):
    """Inputs are held while the outputs predicted with them stay in a band about the reference (zone control).

    Args:
        controller: see `Rule`.
        band: half the zone, in output units, a scalar or one value per output.
    """

    def __init__(self, controller: Controller, *, band: Any) -> None:
        super().__init__(controller)
        if self.problem.zoned.any():
            raise MampcError(
                "controller: expected one with set points, received outputs that have a zone already"
            )
        self._band = as_vector("band", band, self.problem.model.n_outputs, 0.0)

    def is_due(self, sample: Sample, state: ControllerState) -> bool:
        deviation = sample.parameter[self.condensed.parameter.reference.start :].reshape(-1, len(self._band))
        reference = self.problem.model.y_op + deviation
        y = self.outputs(sample)[1:]
        error: BoolArray = np.abs(y - reference[-len(y) :]) > self._band
        return bool(error.any())
