"""Many closed loops as arrays: the same regulator and plant under many seeds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_array, as_flag, as_whole
from mampc.base.errors import MampcError, shown
from mampc.base.names import Names
from mampc.base.progress import watched
from mampc.controllers.decision import Decision
from mampc.loop.batched_loops import BatchedLoops, Records
from mampc.loop.batched_plans import EachPlans, batched_plans
from mampc.loop.kalman_filter import KalmanFilter
from mampc.loop.load_bank import LoadBank
from mampc.loop.loads import Load
from mampc.loop.metrics import Metrics
from mampc.loop.one_by_one import closed_loops
from mampc.loop.regulator import Regulator
from mampc.loop.run import Run
from mampc.loop.simulation import Acting, acting_on
from mampc.loop.valves import Valves
from mampc.plants import Plant
from mampc.program.problem import Limits
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
        zone_told, told: as in `Run`.
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
    told: tuple[Mapping[str, Any], ...]

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, loop: int) -> Run:
        """One loop as a run."""
        own = (
            "u", "y", "y_measured", "r", "u_initial", "v", "position", "faults", "decisions", "resolution", "zone"
        )  # fmt: skip
        shared = ("t", "dt", "names", "zone_told", "told")
        return Run(
            **{name: getattr(self, name)[loop] for name in own},
            **{name: getattr(self, name) for name in shared},
        )

    def metrics(
        self, *, threshold: float = 0.1, skip: int = 0, dead_band: Any = 0.0, output_weight: Any = None
    ) -> BatchMetrics:
        """`Metrics` of each loop; an attribute of all of them together, such as `.tracking_error`, is an array."""
        settings = {"threshold": threshold, "skip": skip, "dead_band": dead_band}
        return BatchMetrics(
            self[s].metrics(**settings, output_weight=output_weight) for s in range(len(self))
        )


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
    limits: Limits | Sequence[Limits | None] | None = None,
    manual: Any = None,
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
        variant, limits, manual: as in `simulate`, the same for all loops; with the latter two, loop by loop.
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
    preview = as_flag("preview", preview)
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
                variant=variant, limits=limits, manual=manual, **one,
            )
        )  # fmt: skip
    courses = [one.drawn(seed) for one, seed in zip(acting, seeds, strict=True)]
    keep = as_flag("keep_decisions", keep_decisions)
    first, plans = regulators[0], None
    if not keep and limits is None and manual is None and all(_steps_like(own, first) for own in regulators):
        ahead = preview or first.reference_filter is not None
        if not isinstance(reference, Zone) or first.reference_filter is None:
            plans = batched_plans([own._planner for own in regulators], ahead)
    model, T = first.controller.problem.model, len(courses[0])
    if any(own.controller.problem.model.dt != model.dt for own in regulators):
        raise MampcError("regulator: expected the same sample time in all, received several")
    records = Records(courses, model.n_outputs)
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
        loops = BatchedLoops(
            plants[rows], regulators[rows], courses[rows], EachPlans(plans[rows]), preview, valves
        )
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
        zone_told=isinstance(reference, Zone), told=courses[0].told_beside(),
    )  # fmt: skip


class BatchMetrics(tuple[Metrics, ...]):
    """The metrics of each loop; attributes of `Metrics` give the values of all loops, loops first."""

    __slots__ = ()

    def __getattr__(self, name: str) -> Array:
        if name not in {one.name for one in fields(Metrics)}:
            raise AttributeError(name)
        return np.array([getattr(one, name) for one in self])


def _steps_like(own: Regulator, other: Regulator) -> bool:
    """Whether a regulator estimates as arrays can, and as another one."""
    if type(own) is not Regulator or type(own.estimator) not in (KalmanFilter, LoadBank) or own.learns_gains:
        return False
    return own is other or (
        own.estimator is other.estimator
        and own.controller.problem is other.controller.problem
        and own.sensors is other.sensors
        and own.reference_filter is other.reference_filter
        and own.valves is None
    )
