"""The closed loop: a plant, a regulator, a reference; and the run that comes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import Array, as_array, as_choice, as_flag, as_instance, as_matrix, as_vector, as_whole
from mampc.base.errors import MampcError, shown
from mampc.base.progress import watched
from mampc.controllers.bank import ControllerBank
from mampc.controllers.controller import Controller
from mampc.loop.interventions import Interventions
from mampc.loop.motion import Faults, motion_of
from mampc.loop.regulator import Regulator
from mampc.loop.run import Run
from mampc.loop.state import RegulatorState
from mampc.loop.valves import Stems, Valves
from mampc.plants import Plant, require_plant
from mampc.program.problem import Limits
from mampc.program.zone import Zone
from mampc.systems.state_space import StateSpace

if TYPE_CHECKING:
    from mampc.loop.loads import Load

LONGEST_RUN = 10_000_000  # samples


def simulate(
    plant: Plant | StateSpace,
    regulator: Regulator,
    reference: Any,
    *,
    steps: int | None = None,
    noise: Any = 0.0,
    seed: int = 0,
    preview: bool = False,
    input_disturbance: Any = None,
    output_disturbance: Any = None,
    measured_disturbance: Any = None,
    loads: Sequence[Load] = (),
    valves: Valves | None = None,
    u_initial: Any = None,
    variant: str | Sequence[str] | None = None,
    limits: Limits | Sequence[Limits | None] | None = None,
    manual: Any = None,
    progress: bool | None = None,
) -> Run:
    """Run a regulator on a plant that starts at rest.

    Args:
        plant: a nonlinear plant, or a discrete `StateSpace` standing in for one.
        regulator: output feedback; its model's sample time is that of the loop.
        reference: absolute outputs to track: constant (l,), or one row per sample (T, l); or a `Zone` of these shapes.
        steps: T; default the rows of the reference.
        noise: standard deviation of Gaussian measurement noise, scalar or (l,), in output units.
        seed: of noise and loads; equal seeds give equal ones whatever the regulator.
        preview: let the regulator see the reference over its prediction horizon.
        input_disturbance: unmeasured, added to the inputs on their way to the plant, (m,) or (T, m).
        output_disturbance: unmeasured, added to the true outputs, (l,) or (T, l).
        measured_disturbance: of the plant, and told to the regulator if its model has it, (d,) or (T, d);
            default the plant's usual ones (its `v_op`).
        loads: of `mampc.loads`, drawn with the seed and added to these disturbances.
        valves: what stands between decided and real inputs (see `Valves`); default inputs are as decided.
        u_initial: inputs at the start, shape (m,); default the plant's usual ones (its `u_op`).
        variant: of a `ControllerBank`, one name or one for each sample; default its first.
        limits: that the regulator is told (see `Regulator.step`), one for all samples, or one or None for each.
        manual: inputs that somebody else moves, and where to, (m,) or (T, m), not-a-number where they are in automatic.
            The regulator is told which, and at the next sample where they were.
        progress: show a progress bar on the terminal; default: when the run is long.

    Raises:
        MampcError: arguments that do not fit together, or a plant that cannot be integrated.
    """
    course = acting_on(
        plant, regulator, reference, steps=steps, noise=noise,
        input_disturbance=input_disturbance, output_disturbance=output_disturbance,
        measured_disturbance=measured_disturbance, loads=loads, valves=valves, u_initial=u_initial,
        variant=variant, limits=limits, manual=manual,
    ).drawn(seed)  # fmt: skip
    return closed_loop(plant, regulator, course, preview=as_flag("preview", preview), progress=progress)


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What acts on a loop of T samples from outside and is not drawn.

    Attributes:
        reference: as long as it is predicted, shape (T + np, l).
        zone: asked for in place of the reference, its ends of the same shape; None where none is.
        u_initial: inputs before the first sample, shape (m,).
        stems: the valves at these inputs; None where inputs are as decided.
        variants: of a `ControllerBank`, a name for each sample; None for its first.
        interventions: of operators; None where they do nothing.
    """

    reference: Array
    zone: Zone | None
    u_initial: Array
    stems: Stems | None
    variants: Sequence[str] | None
    interventions: Interventions | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Course(Given):
    """What acts on a loop of T samples from outside.

    Attributes:
        noise: of the measurements, shape (T, l).
        at_inputs, at_outputs: unmeasured disturbances, shapes (T, m) and (T, l).
        v: measured disturbances, shape (T, d).
    """

    noise: Array
    at_inputs: Array
    at_outputs: Array
    v: Array

    def asked(self, k: int, samples: int | None) -> Array | Zone:
        """What the regulator is asked for at sample k: of this one, or of so many from it on where it sees ahead."""
        part = k if samples is None else slice(k, k + samples)
        if self.zone is None:
            return self.reference[part]
        return Zone(self.zone.low[part], self.zone.high[part])

    def ranges(self, controller: Controller) -> Zone | None:
        """Within which outputs cost nothing, ends of shape (T, l); None where all have set points."""
        T = len(self)
        if self.zone is not None:
            return Zone(self.zone.low[:T], self.zone.high[:T])
        problems = [controller.problem]
        if isinstance(controller, ControllerBank):
            names = [controller.usual] if self.variants is None else self.variants
            problems = [controller.variants[name].problem for name in names]
        below, above = (
            np.array([getattr(p, name) for p in problems]) for name in ("zone_below", "zone_above")
        )
        if not below.any() and not above.any():
            return None
        return Zone(self.reference[:T] - below, self.reference[:T] + above)

    def told(self, k: int, v: Array | None) -> dict[str, Any]:
        """What the regulator is told at a sample beside measurements and reference; v its measured disturbances."""
        told: dict[str, Any] = {} if v is None else {"measured_disturbance": v}
        if self.interventions is not None:
            told |= self.interventions.told(k)
        return told if self.variants is None else told | {"variant": self.variants[k]}

    def told_beside(self) -> tuple[Mapping[str, Any], ...]:
        """What all samples are told of interventions; none where there are none."""
        return () if self.interventions is None else tuple(map(self.interventions.told, range(len(self))))

    def __len__(self) -> int:
        return len(self.noise)


@dataclass(frozen=True, kw_only=True, eq=False)
class Acting(Given):
    """What acts on a loop of T samples from outside, before anything random in it is drawn.

    Attributes:
        dt: sample time in seconds.
        spread: standard deviation of the noise, shape (l,).
        at: disturbances by place, shapes (T, m), (T, l) and (T, d).
        loads: to be drawn.
    """

    dt: float
    spread: Array
    at: dict[str, Array]
    loads: Sequence[Load]

    def drawn(self, seed: int) -> Course:
        """With noise and loads of a seed."""
        from mampc.loop.loads import drawn

        at, seed = dict(self.at), as_whole("seed", seed, 0)
        T = len(at["output"])
        signals = {place: rows.shape[1] for place, rows in at.items()}
        for place, load in drawn(self.loads, T, self.dt, seed, signals):
            at[place] = at[place] + load
        noise = self.spread * np.random.default_rng(seed).standard_normal((T, len(self.spread)))
        same = {one.name: getattr(self, one.name) for one in fields(Given)}
        return Course(noise=noise, at_inputs=at["input"], at_outputs=at["output"], v=at["measured"], **same)


def acting_on(
    plant: Plant | StateSpace,
    regulator: Regulator,
    reference: Any,
    *,
    steps: int | None,
    noise: Any,
    input_disturbance: Any,
    output_disturbance: Any,
    measured_disturbance: Any,
    loads: Sequence[Load],
    valves: Valves | None,
    u_initial: Any,
    variant: str | Sequence[str] | None = None,
    limits: Limits | Sequence[Limits | None] | None = None,
    manual: Any = None,
) -> Acting:
    """What the arguments of `simulate` say, checked."""
    as_instance("regulator", regulator, Regulator)
    if not isinstance(plant, StateSpace):
        require_plant(plant)
    model = regulator.controller.problem.model
    m, l, d = model.n_inputs, model.n_outputs, len(plant.names.disturbances)
    if (len(plant.names.inputs), len(plant.names.outputs)) != (m, l) or model.n_disturbances not in (0, d):
        raise MampcError(
            f"simulate: expected a plant with {m} inputs, {l} outputs and {model.n_disturbances} measured "
            f"disturbances, received {len(plant.names.inputs)}, {len(plant.names.outputs)} and {d}"
        )
    zone = reference if isinstance(reference, Zone) else None
    reference = as_array("reference", reference) if zone is None else zone.centre
    T = _length(reference, steps)
    if zone is None:
        rows = _trajectory("reference", reference, l, None if reference.ndim == 2 else T)
    elif reference.shape[-1] == l and len(reference) > 0:
        rows = np.tile(reference, (1 if reference.ndim == 2 else T, 1))
    else:
        raise MampcError(
            f"reference: expected a Zone of shape ({l},) or (T, {l}), received {reference.shape}"
        )
    ahead = np.minimum(np.arange(T + regulator.controller.problem.prediction_horizon), len(rows) - 1)
    if zone is not None:
        low, high = (np.broadcast_to(end, rows.shape)[ahead] for end in (zone.low, zone.high))
        zone = Zone(low, high)
        for controller in regulator.controller.each:
            controller.condensed.parameter.of_zones(zone)  # complains where it does not fit
    spread = as_vector("noise", noise, l, 0.0)
    usual = getattr(plant, "v_op", np.zeros(d))
    at = {
        "input": _trajectory("input_disturbance", _default(input_disturbance, 0.0), m, T),
        "output": _trajectory("output_disturbance", _default(output_disturbance, 0.0), l, T),
        "measured": _trajectory("measured_disturbance", _default(measured_disturbance, usual), d, T),
    }
    if valves is not None:
        as_instance("valves", valves, Valves)
    if valves is not None and manual is not None:
        raise MampcError(
            "manual: expected none beside valves, whose stems nobody else moves here, received some"
        )
    start = as_vector("u_initial", _default(u_initial, getattr(plant, "u_op", model.u_op)), m)
    return Acting(
        dt=model.dt, reference=rows[ahead], zone=zone, spread=spread, at=at,
        loads=loads, u_initial=start, stems=None if valves is None else valves.initial(start),
        variants=_variants(variant, T, regulator.controller),
        interventions=Interventions.of(limits, manual, T, regulator.controller),
    )  # fmt: skip


def closed_loop(
    plant: Plant | StateSpace,
    regulator: Regulator,
    course: Course,
    *,
    preview: bool,
    progress: bool | None,
) -> Run:
    """The loop sample by sample."""
    model, horizon = regulator.controller.problem.model, regulator.controller.problem.prediction_horizon
    T, start, v, ahead = len(course), course.u_initial, course.v, horizon + 1 if preview else None
    motion = motion_of(plant, model.dt)
    x, state = at_rest(plant, regulator, start, v[0])
    shape = (T, len(start))
    inputs, positions, outputs = np.empty(shape), np.empty(shape), np.empty((T, model.n_outputs))
    decisions, found = [], dict[int, Faults]()
    stems, position = course.stems, start
    for k in watched(T, progress):
        outputs[k] = (
            motion.output(x, np.concatenate([position + course.at_inputs[k], v[k]])) + course.at_outputs[k]
        )
        decision = regulator.step(
            state,
            outputs[k] + course.noise[k],
            course.asked(k, ahead),
            **course.told(k, v[k] if model.n_disturbances else None),
        )
        state, position = decision.state, decision.u
        inputs[k] = decision.u
        if stems is not None:
            stems = stems.moved(decision.u)
            position = stems.position
        if course.interventions is not None:
            position = course.interventions.moved(k, position)
        positions[k] = position
        decisions.append(decision._replace(state=None))
        applied = np.concatenate([position + course.at_inputs[k], v[k]])
        x = motion.move(x, applied)
        wrong = motion.faults(x, applied)
        if wrong:
            found[k] = wrong
    return Run(
        t=np.arange(T) * model.dt, u=inputs, y=outputs, y_measured=outputs + course.noise, r=course.reference[:T],
        u_initial=start, decisions=tuple(decisions), dt=model.dt, names=plant.names, v=v, faults=found,
        position=positions, resolution=regulator.controller.resolution, zone=course.ranges(regulator.controller),
        zone_told=course.zone is not None, told=course.told_beside(),
    )  # fmt: skip


def at_rest(
    plant: Plant | StateSpace, regulator: Regulator, u: Array, v: Array
) -> tuple[Array, RegulatorState]:
    """The states of plant and regulator before the first sample, at rest under inputs u (m,) and measured
    disturbances v (d,).
    """
    model, both = regulator.controller.problem.model, np.concatenate([u, v])
    x = plant.steady_state(both)
    y = motion_of(plant, model.dt).output(x, both)
    told = {"measured_disturbance": v} if model.n_disturbances else {}
    return x, regulator.initial_state(u, y, **told)


def _variants(variant: str | Sequence[str] | None, T: int, controller: Controller) -> list[str] | None:
    if variant is None:
        return None
    if not isinstance(controller, ControllerBank):
        raise MampcError(f"variant: expected none without a ControllerBank, received {shown(variant)}")
    names = (
        [variant] * T if isinstance(variant, str) else list(variant) if isinstance(variant, Sequence) else []
    )
    if len(names) != T or not all(isinstance(name, str) for name in names):
        raise MampcError(
            f"variant: expected a name or one for each of {T} samples, received {shown(variant)}"
        )
    for name in sorted(set(names)):
        as_choice("variant", name, controller.variants)
    return names


def _length(reference: Array, steps: int | None) -> int:
    if steps is not None:
        return as_whole("steps", steps, 1, LONGEST_RUN)
    if reference.ndim != 2:
        raise MampcError(
            "steps: expected a number of samples, since the reference is constant, received none"
        )
    return len(reference)


def _default(value: Any, otherwise: Any) -> Any:
    return otherwise if value is None else value


def _trajectory(name: str, value: Any, width: int, steps: int | None) -> Array:
    """One row per sample, from a constant or from rows of which the last is repeated."""
    array = as_array(name, value)
    if array.ndim < 2:
        if steps is None:
            raise MampcError(f"steps: expected a number of samples, since {name} is constant")
        return np.tile(as_vector(name, array, width), (as_whole("steps", steps, 1, LONGEST_RUN), 1))
    rows = as_matrix(name, array, None, width)
    steps = len(rows) if steps is None else as_whole("steps", steps, 1, LONGEST_RUN)
    if len(rows) == 0:
        raise MampcError(f"{name}: expected at least one row, received none")
    return rows[np.minimum(np.arange(steps), len(rows) - 1)]
