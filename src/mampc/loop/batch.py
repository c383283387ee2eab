"""Many closed loops as arrays: the same regulator and plant under many seeds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, cast

import numpy as np

from mampc.base.checks import LARGEST, Array, BoolArray, as_array, as_flag, as_whole
from mampc.base.errors import MampcError, shown
from mampc.base.names import Names
from mampc.base.progress import watched
from mampc.controllers.decision import ControllerState, Decision
from mampc.loop.batched_plans import EachPlans, batched_plans
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.loop.loads import Load
from mampc.loop.metrics import Metrics
from mampc.loop.motion import Faults, motions_of
from mampc.loop.one_by_one import Moment, closed_loops
from mampc.loop.regulator import Regulator
from mampc.loop.run import Run
from mampc.loop.sensors import SensorState
from mampc.loop.simulation import Acting, Course, acting_on, at_rest
from mampc.loop.state import RegulatorState
from mampc.loop.valves import Valves
from mampc.plants import Plant
from mampc.program.zone import Zone
from mampc.systems.state_space import StateSpace

TOGETHER = 1000  # loops that are simulated as one array; more of them gain nothing


@dataclass(frozen=True, eq=False)
class Batch:
    """S closed loops of T samples, in engineering units; `batch[s]` is one of them as a `Run`.

    Attributes:
        t: time in seconds, shape (T,).
        u: decided inputs, shape (S, T, m).
        y: true outputs, shape (S, T, l), without measurement noise.
        y_measured: what the regulator saw, shape (S, T, l).
        r: references, shape (S, T, l).
        u_initial: inputs before the first sample, shape (S, m).
        v: measured disturbances, shape (S, T, d).
        position: where the actuators were, shape (S, T, m).
        seeds: of the loops.
        faults: of each loop, as in `Run`.
        decisions: of each loop, as in `Run`; none unless asked for.
        dt: sample time in seconds.
        names: of the inputs and outputs.
        resolution: of each loop's inputs, as in `Run`, shape (S, m).
        zone: of each loop, as in `Run`.
        zone_told: as in `Run`.
    """

    t: Array
    u: Array
    y: Array
    y_measured: Array
    r: Array
    u_initial: Array
    v: Array
    position: Array
    seeds: tuple[int, ...]
    faults: tuple[dict[int, tuple[str, ...]], ...]
    decisions: tuple[tuple[Decision, ...], ...] = field(repr=False)
    dt: float
    names: Names
    resolution: Array
    zone: tuple[Zone | None, ...]
    zone_told: bool

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, loop: int) -> Run:
        """One loop as a run."""
        own = (
            "u", "y", "y_measured", "r", "u_initial", "v", "position", "faults", "decisions", "resolution", "zone"
        )  # fmt: skip
        shared = ("t", "dt", "names", "zone_told")
        return Run(
            **{name: getattr(self, name)[loop] for name in own},
            **{name: getattr(self, name) for name in shared},
        )

    def metrics(self, *, threshold: float = 0.1, skip: int = 0, dead_band: Any = 0.0) -> BatchMetrics:
        """`Metrics` of each loop; an attribute of all of them together, such as `.tracking_error`, is an array."""
        settings = {"threshold": threshold, "skip": skip, "dead_band": dead_band}
        return BatchMetrics(self[s].metrics(**settings) for s in range(len(self)))


def simulate_batch(
    plant: Plant | StateSpace | Sequence[Plant | StateSpace],
    regulator: Regulator | Sequence[Regulator],
    reference: Any,
    *,
    seeds: Iterable[int],
    steps: int | None = None,
    noise: Any = 0.0,
    preview: bool = False,
    input_disturbance: Any = None,
    output_disturbance: Any = None,
    measured_disturbance: Any = None,
    loads: Sequence[Load] = (),
    valves: Valves | None = None,
    u_initial: Any = None,
    variant: str | Sequence[str] | None = None,
    keep_decisions: bool = False,
    progress: bool | None = None,
) -> Batch:
    """Run one regulator in many closed loops; each comes out as `simulate` with its seed would give it.

    Plain MPC and exact searches by a table, with `KalmanFilter` or `LoadBank`, are stepped as arrays over all loops,
    with an ordinary step for each loop in which a limit is active or a measurement is doubted. Every other regulator
    is stepped loop by loop, and only the plants move as one. Inputs agree with those of `simulate` up to rounding.

    Args:
        plant: one for all loops, or a sequence with one for each, such as perturbed models.
        regulator: one for all loops, or a sequence with one for each, such as values of a setting.
        reference, steps, noise, preview, u_initial: as in `simulate`.
        seeds: of noise and loads, one per loop; they give the number S of loops.
        input_disturbance, output_disturbance, measured_disturbance: as in `simulate`.
        variant: as in `simulate`.
        loads, valves: as in `simulate`; loads are drawn for each loop with its seed.
        keep_decisions: keep every `Decision`; then regulators are stepped loop by loop, and memory grows with them.
        progress: as in `simulate`.

    The reference and the disturbances may also have one course per loop, shape (S, T, signals).

    Raises:
        MampcError: arguments that do not fit together, or a plant that cannot be integrated.
    """
    if not isinstance(seeds, Iterable) or isinstance(seeds, str):
        raise MampcError(f"seeds: expected whole numbers such as range(100), received {shown(seeds)}")
    seeds = tuple(as_whole("seeds", seed, 0) for seed in seeds)
    if not seeds:
        raise MampcError("seeds: expected at least one, received none")
    plants = list(plant) if isinstance(plant, Sequence) else [plant] * len(seeds)
    if len(plants) != len(seeds):
        raise MampcError(
            f"plant: expected one, or one per seed, {len(seeds)} of them, received {len(plants)}"
        )
    regulators = list(regulator) if isinstance(regulator, Sequence) else [regulator] * len(seeds)
    if len(regulators) != len(seeds):
        raise MampcError(
            f"regulator: expected one, or one per seed, {len(seeds)} of them, received {len(regulators)}"
        )
    own = {
        "reference": reference, "input_disturbance": input_disturbance,
        "output_disturbance": output_disturbance, "measured_disturbance": measured_disturbance,
    }  # fmt: skip
    each = {
        name for name, value in own.items()
        if not isinstance(value, Zone | None) and as_array(name, value).ndim == 3
    }  # fmt: skip
    for name, value in own.items():
        if name in each and len(value) != len(seeds):
            raise MampcError(
                f"{name}: expected a course for each of {len(seeds)} seeds, received {len(value)}"
            )
    acting: list[Acting] = []
    for s in range(len(seeds)):
        if s and plants[s] is plants[s - 1] and regulators[s] is regulators[s - 1] and not each:
            acting.append(acting[-1])
            continue
        one = {name: value[s] if name in each else value for name, value in own.items()}
        acting.append(
            acting_on(
                plants[s], regulators[s], steps=steps, noise=noise, loads=loads, valves=valves, u_initial=u_initial,
                variant=variant, **one,
            )
        )  # fmt: skip
    courses = [one.drawn(seed) for one, seed in zip(acting, seeds, strict=True)]
    keep = as_flag("keep_decisions", keep_decisions)
    first, plans = regulators[0], None
    if not keep and all(_steps_like(own, first) for own in regulators):
        ahead = preview or first.reference_filter is not None
        if not isinstance(reference, Zone) or first.reference_filter is None:
            plans = batched_plans([own._planner for own in regulators], ahead)
    model, T = first.controller.problem.model, len(courses[0])
    if any(own.controller.problem.model.dt != model.dt for own in regulators):
        raise MampcError("regulator: expected the same sample time in all, received several")
    records = _Records(courses, model.n_outputs)
    parts = [range(s, min(s + TOGETHER, len(seeds))) for s in range(0, len(seeds), TOGETHER)]
    bar = iter(watched(T * len(parts), progress))
    for part in parts:
        rows = slice(part.start, part.stop)
        if plans is None:
            moments = closed_loops(
                plants[rows], regulators[rows], courses[rows], preview=preview, samples=range(T)
            )
            for k, moment in enumerate(moments):
                next(bar)
                records.take(k, part, moment, keep)
            continue
        loops = _Loops(plants[rows], regulators[rows], courses[rows], EachPlans(plans[rows]), preview, valves)
        for k in range(T):
            next(bar)
            loops.step(k, records, part)
    next(bar, None)
    return Batch(
        t=np.arange(T) * model.dt, u=records.u, y=records.y, y_measured=records.y_measured,
        r=np.array([course.reference[:T] for course in courses]), u_initial=records.u_initial,
        v=np.array([course.v for course in courses]), position=records.position, seeds=seeds,
        faults=tuple(records.faults), decisions=tuple(map(tuple, records.decisions)), dt=model.dt,
        names=plants[0].names, resolution=np.array([own.controller.resolution for own in regulators]),
        zone=tuple(
            course.ranges(own.controller) for course, own in zip(courses, regulators, strict=True)
        ),
        zone_told=isinstance(reference, Zone),
    )  # fmt: skip


class BatchMetrics(tuple[Metrics, ...]):
    """The metrics of each loop; attributes of `Metrics` give the values of all loops, loops first."""

    __slots__ = ()

    def __getattr__(self, name: str) -> Array:
        if name not in {one.name for one in fields(Metrics)}:
            raise AttributeError(name)
        return np.array([getattr(one, name) for one in self])


class _Records:
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


class _Loops:
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

    def step(self, k: int, records: _Records, part: range) -> None:
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
        after = sensors.after_fine(self._sensors, y, estimator.loads_of(last))
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
        everywhere = {"blind": np.zeros(len(y), dtype=int)}
        self._estimate, self._sensors, self._v_last = estimate, SensorState(**vars(after) | everywhere), told
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
        sensors: dict[str, Any] = {name: part[s].copy() for name, part in vars(self._sensors).items()}
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
            for name, value in vars(own).items():
                getattr(stack, name)[s] = value
        self._v_last[s] = state.measured_disturbance
        if self._tracked is not None:
            self._tracked[s] = state.reference


def _steps_like(own: Regulator, other: Regulator) -> bool:
    """Whether a regulator estimates as arrays can, and as another one."""
    if type(own) is not Regulator or type(own.estimator) not in (KalmanFilter, LoadBank):
        return False
    return own is other or (
        own.estimator is other.estimator
        and own.controller.problem is other.controller.problem
        and own.sensors is other.sensors
        and own.reference_filter is other.reference_filter
        and own.valves is None
    )


def _copied(stack: Any) -> Any:
    return type(stack)(**{name: part.copy() for name, part in vars(stack).items()})


def _stacked(kind: Any, parts: list[Any]) -> Any:
    return kind(**{name: np.array([getattr(part, name) for part in parts]) for name in vars(parts[0])})
