"""Many closed loops side by side: what comes of them, and their samples where regulators are stepped as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray
from mampc.controllers.decision import ControllerState, Decision
from mampc.loop.batched_plans import EachPlans
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.loop.motion import Faults, motions_of
from mampc.loop.one_by_one import Moment
from mampc.loop.regulator import Regulator
from mampc.loop.sensors import SensorState
from mampc.loop.simulation import Course, at_rest
from mampc.loop.state import RegulatorState
from mampc.loop.valves import Valves
from mampc.plants import Plant
from mampc.systems.state_space import StateSpace


class Records:
    """What comes of all loops."""

    def __init__(self, courses: list[Course], l: int) -> None:
        self.u_initial = np.array([course.u_initial for course in courses])
        S, T, m = len(courses), len(courses[0]), self.u_initial.shape[1]
        self.u, self.position = np.empty((S, T, m)), np.empty((S, T, m))
        self.y, self.y_measured = np.empty((S, T, l)), np.empty((S, T, l))
        self.faults: list[dict[int, Faults]] = [{} for _ in courses]
        self.decisions: list[list[Decision]] = [[] for _ in courses]

    def take(self, k: int, part: range, moment: Moment, decisions: bool) -> None:
        """Sample k of the loops of a part."""
        rows = slice(part.start, part.stop)
        self.u[rows, k], self.position[rows, k] = moment.u, moment.position
        self.y[rows, k], self.y_measured[rows, k] = moment.y, moment.y_measured
        for s, wrong in moment.faults.items():
            self.faults[part.start + s][k] = wrong
        if decisions:
            for s, decision in zip(part, moment.decisions, strict=True):
                self.decisions[s].append(decision)


class BatchedLoops:
    """Some loops side by side: what plants, regulators and actuators remember, loops first in every array."""

    def __init__(
        self,
        plants: Sequence[Plant | StateSpace],
        regulators: Sequence[Regulator],
        courses: Sequence[Course],
        plans: EachPlans,
        preview: bool,
        valves: Valves | None,
    ) -> None:
        regulator = regulators[0]
        model, self._regulators, self._plans = regulator.controller.problem.model, regulators, plans
        self._n_p = regulator.controller.problem.prediction_horizon if preview else None
        self._has_v = bool(model.n_disturbances)
        self._noise, self._at_inputs, self._at_outputs, self._v, self._reference = (
            np.array([getattr(course, name) for course in courses]).swapaxes(0, 1)
            for name in ("noise", "at_inputs", "at_outputs", "v", "reference")
        )
        self._courses, zone = courses, courses[0].zone
        if zone is not None:  # one for all loops
            ends = regulator._planner.condensed.parameter.of_zones(zone)
            self._reference = np.repeat(ends[:, None], len(courses), axis=1)
        start = np.array([course.u_initial for course in courses])
        first = np.concatenate([start, self._v[0]], axis=1)
        rests: dict[tuple[int, bytes], tuple[Array, RegulatorState]] = {}
        states = []
        for plant, course, applied in zip(plants, courses, first, strict=True):
            key = id(plant), applied.tobytes()
            if key not in rests:
                rests[key] = at_rest(plant, regulator, course.u_initial, course.v[0])
            states.append(rests[key])
        most = max(len(x) for x, _ in states)
        self._x = np.array([np.pad(x, (0, most - len(x))) for x, _ in states])
        self._motion = motions_of(plants, model.dt, self._x, first)
        self._position, self._stems = start, None if valves is None else valves.initial(start)
        self._actuators = [state.actuators for _, state in states]
        self._inputs = np.array([state.controller.inputs for _, state in states])
        self._active: list[Array | None] = [None] * len(states)
        estimates = [state.estimate for _, state in states]
        self._estimate = _stacked(type(estimates[0]), estimates)
        self._sensors = _stacked(SensorState, [state.sensors for _, state in states])
        self._v_last = np.array([state.measured_disturbance for _, state in states])
        self._filter, self._tracked = regulator._filter, None
        if self._filter is not None:
            self._tracked = np.array([state.reference for _, state in states])

    def step(self, k: int, records: Records, part: range) -> None:
        """Sample k of all loops."""
        rows = slice(part.start, part.stop)
        v, at_inputs = self._v[k], self._at_inputs[k]
        y = self._motion.output(self._x, np.concatenate([self._position + at_inputs, v], axis=1))
        y = y + self._at_outputs[k]
        measured = y + self._noise[k]
        u = self._decide(k, measured, v)
        self._position = u
        if self._stems is not None:
            self._stems = self._stems.moved(u)
            self._position = self._stems.position
        applied = np.concatenate([self._position + at_inputs, v], axis=1)
        self._x = self._motion.move(self._x, applied)
        for s, wrong in self._motion.faults(self._x, applied).items():
            records.faults[part.start + s][k] = wrong
        records.u[rows, k], records.position[rows, k] = u, self._position
        records.y[rows, k], records.y_measured[rows, k] = y, measured

    def _decide(self, k: int, y: Array, v: Array) -> Array:
        """The inputs after the measurements y (S, l), with the measured disturbances v (S, d)."""
        regulator = self._regulators[0]  # all of them estimate alike
        sensors, last, u = regulator._sensors, self._estimate, self._inputs[:, -1]
        told = v if self._has_v else self._v_last
        estimator = cast(KalmanFilter | LoadBank, regulator.estimator)
        estimate, innovation, _ = estimator.updates(last, u, y, self._v_last, told)
        fine = sensors.are_fine(self._sensors, y, innovation)
        after = sensors.after_fine(self._sensors, y, innovation, estimator.loads_of(last))
        asked = self._reference[k : k + self._n_p + 1].swapaxes(0, 1) if self._n_p else self._reference[k]
        tracked, ahead = self._tracked, asked.reshape(len(y), -1)
        if self._filter is not None and tracked is not None:
            course = self._filter.course(tracked, asked, regulator._samples)
            tracked, ahead = course[:, 0], course.reshape(len(y), -1)
        place = regulator._planner.condensed.parameter
        ahead = place.with_ends(ahead.reshape(len(y), -1, asked.shape[-1])).reshape(len(y), -1)
        parameters = np.ones((len(y), place.one.stop + ahead.shape[1]))
        parameters[:, place.x], parameters[:, place.u_previous] = estimate.x, u
        parameters[:, place.u_deviation] = u
        parameters[:, place.input_disturbance] = estimate.input_disturbance
        parameters[:, place.output_disturbance] = estimate.output_disturbance
        parameters[:, place.measured_disturbance] = told
        parameters[:, place.one.stop :] = ahead
        parameters -= place.origin[parameters.shape[1]]
        usable: BoolArray = np.asarray((np.abs(parameters) < LARGEST).all(axis=1))
        decided, first = self._plans.decide(
            np.where(usable[:, None], parameters, 0.0), self._inputs, estimator.weights_of(estimate),
            None if self._courses[0].variants is None else self._courses[0].variants[k],
        )  # fmt: skip
        decided &= fine & usable
        one_by_one = np.flatnonzero(~decided).tolist()
        before = [self._state(s, k) for s in one_by_one]
        self._tracked = tracked
        self._inputs = np.concatenate([self._inputs[:, 1:], first[:, None]], axis=1)
        never: Any = np.zeros(len(y), dtype=int)
        self._estimate, self._sensors, self._v_last = estimate, after._replace(blind=never), told
        if one_by_one:  # these arrays are written to, and some are shared
            self._estimate, self._sensors = _copied(self._estimate), _copied(self._sensors)
            self._v_last = told.copy()
        for loop in np.flatnonzero(decided) if any(active is not None for active in self._active) else ():
            self._active[loop] = None
        for s, state in zip(one_by_one, before, strict=True):
            asked_now = self._courses[s].asked(k, self._n_p and self._n_p + 1)
            beside = self._courses[s].told(k, told[s] if self._has_v else None)
            self._step_one(s, self._regulators[s].step(state, y[s], asked_now, **beside))
        return self._inputs[:, -1]

    def _state(self, s: int, k: int) -> RegulatorState:
        """What the regulator of one loop remembers."""
        sensors: dict[str, Any] = {name: part[s].copy() for name, part in self._sensors._asdict().items()}
        return RegulatorState(
            ControllerState(self._inputs[s].copy(), k, None, self._active[s]),
            type(self._estimate)(**{name: part[s].copy() for name, part in vars(self._estimate).items()}),
            self._v_last[s].copy(),
            SensorState(**sensors | {"blind": int(sensors["blind"])}),
            self._actuators[s],
            None if self._tracked is None else self._tracked[s].copy(),
        )

    def _step_one(self, s: int, decision: Decision) -> None:
        """An ordinary step of one loop."""
        state = decision.state
        self._inputs[s], self._active[s] = state.controller.inputs, state.controller.active
        for stack, own in ((self._estimate, state.estimate), (self._sensors, state.sensors)):
            for name, value in _named(own).items():
                getattr(stack, name)[s] = value
        self._v_last[s] = state.measured_disturbance
        if self._tracked is not None:
            self._tracked[s] = state.reference


def _copied(stack: Any) -> Any:
    return type(stack)(**{name: part.copy() for name, part in _named(stack).items()})


def _stacked(kind: Any, parts: list[Any]) -> Any:
    return kind(**{name: np.array([getattr(part, name) for part in parts]) for name in _named(parts[0])})


def _named(held: Any) -> dict[str, Any]:
    """What an estimate or the sensors' state hold, by name."""
    return held._asdict() if isinstance(held, SensorState) else vars(held)
