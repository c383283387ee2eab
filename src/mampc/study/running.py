"""Running a study: excite, identify, close the loop with every controller in every scenario."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, as_vector
from mampc.base.errors import StudyError, said_at, shown
from mampc.controllers import ControllerBank
from mampc.identification import Identified, IOData, excite, n4sid
from mampc.loop.batch import Batch, simulate_batch
from mampc.loop.loads import Load, Residuals
from mampc.loop.regulator import Regulator
from mampc.loop.run import Run
from mampc.loop.simulation import Course, acting_on, at_rest, closed_loop
from mampc.loop.state import RegulatorState
from mampc.loop.valves import Valves
from mampc.plants import Plant
from mampc.program.problem import Limits
from mampc.program.zone import Zone
from mampc.study.cautions import cautions
from mampc.study.plugins import make_plant
from mampc.study.regulators import problem_of, regulator_of
from mampc.study.scenario_tables import LoadTable, ScenarioTable
from mampc.study.schema import IdentificationTable, Study
from mampc.study.values import Values
from mampc.study.wear import ratings_of
from mampc.systems.mismatch import Mismatch
from mampc.systems.signals import prbs, steps
from mampc.systems.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class StudyResult:
    """A study's outcome.

    Attributes:
        study: what was asked.
        model: the model the controllers use.
        data, identified: the record and the identification, None where the model came from a file.
        runs: scenario name -> controller name -> `Run`.
        warnings: what the user should know before trusting the figures.
        made: controller name -> what is known of its regulator beside its runs.
    """

    study: Study
    model: StateSpace
    data: IOData | None
    identified: Identified | None
    runs: dict[str, dict[str, Run]]
    warnings: tuple[str, ...]
    made: dict[str, Made]


class Made(NamedTuple):
    """What is known of a regulator before it runs.

    Attributes:
        counts_on_later_data: whether its plans do.
        largest_offset: of each output, shape (l,), that may stay for good; infinite where nothing is promised.
    """

    counts_on_later_data: bool
    largest_offset: Array

    @classmethod
    def of(cls, regulator: Regulator) -> Made:
        return cls(regulator.value_of_information, regulator.largest_offset())


@dataclass(frozen=True, eq=False)
class Prepared:
    """What all runs of a study share: plant, its usual inputs and disturbances, model and its record."""

    plant: Plant | StateSpace
    u_op: Array
    v_op: Array
    model: StateSpace
    data: IOData | None
    identified: Identified | None


def run_study(
    study: Study,
    on_stage: Callable[[str], None] = lambda stage: None,
    *,
    on_begin: Callable[[Prepared], None] = lambda prepared: None,
    on_run: Callable[[str, str, Run], None] = lambda scenario, controller, run: None,
) -> StudyResult:
    """Excite, identify and run every controller in every scenario.

    Args:
        study: from `load_study`.
        on_stage: called with a line of text when a stage begins, to show progress.
        on_begin: called before the first run, when everything the study says has been found to fit.
        on_run: called with scenario, controller and run when one has finished.

    Raises:
        MampcError: values of the study that do not fit its plant or model.
    """
    prepared = prepare(study, on_stage)
    regulators = {table.name: regulator_of(study, prepared.model, table) for table in study.controllers}
    ratings_of(study, prepared.model.n_inputs)
    for scenario in study.scenarios:  # complain now rather than after the first results
        _course(study, prepared, scenario, next(iter(regulators.values())))
    on_begin(prepared)
    runs: dict[str, dict[str, Run]] = {}
    for scenario in study.scenarios:
        runs[scenario.name] = {}
        for table in study.controllers:
            on_stage(f"{scenario.name}: {table.name}")
            run = run_controller(study, prepared, scenario, regulators[table.name])
            runs[scenario.name][table.name] = run
            on_run(scenario.name, table.name, run)
    made = {name: Made.of(regulator) for name, regulator in regulators.items()}
    offsets = {name: one.largest_offset for name, one in made.items()}
    problem, reference = problem_of(study, prepared.model), _reference(study, prepared)
    warnings = cautions(study, problem, reference, offsets) + _faults(runs)
    return StudyResult(study, prepared.model, prepared.data, prepared.identified, runs, warnings, made)


def prepare(
    study: Study, on_stage: Callable[[str], None] = lambda stage: None, model: StateSpace | None = None
) -> Prepared:
    """The plant of a study, and a model of it: given, read from a file, or identified from an excitation.

    Raises:
        MampcError: values of the study that do not fit its plant or model.
    """
    if model is None and study.model is not None:
        model = StateSpace.load(_inside(study.place.folder, study.model.file))
    if model is not None:
        if not np.isclose(model.dt, study.dt, rtol=1e-6):
            raise StudyError(f"dt: expected the model's {model.dt:g} s, received {study.dt:g} s")
        plant = model if study.plant.kind == "model" else make_plant(study)
        return Prepared(plant, *_operating_point(study, plant), model, None, None)
    settings = study.identification
    assert settings is not None
    tested = make_plant(study)
    u_op, v_op = _operating_point(study, tested)
    on_stage("exciting the plant")
    data = _record(tested, u_op, v_op, settings, study.dt)
    on_stage("identifying a model")
    identified = n4sid(
        data, order=settings.order, weighting=settings.weighting, feedthrough=settings.feedthrough
    )
    return Prepared(tested, u_op, v_op, identified.model, data, identified)


def run_controller(study: Study, prepared: Prepared, scenario: ScenarioTable, regulator: Regulator) -> Run:
    """One controller in one scenario of a study."""
    plant, course = _course(study, prepared, scenario, regulator)
    return closed_loop(plant, regulator, course, preview=study.reference.preview, progress=False)


def initial_state(
    study: Study, prepared: Prepared, scenario: ScenarioTable, regulator: Regulator
) -> RegulatorState:
    """The state from which `run_controller` starts."""
    plant, course = _course(study, prepared, scenario, regulator)
    return at_rest(plant, regulator, course.u_initial, course.v[0])[1]


def run_seeds(
    study: Study, prepared: Prepared, scenario: ScenarioTable, regulator: Regulator, seeds: Sequence[int]
) -> Batch:
    """One controller in one scenario of a study, once a seed of noise, loads and mismatch."""
    plant: Any = prepared.plant
    if scenario.mismatch is not None:
        plant = [_plant(study, prepared, scenario, seed) for seed in seeds]
    acting = _acting(study, prepared, scenario)
    with said_at(f"scenarios, {scenario.name!r}: "):
        return simulate_batch(
            plant, regulator, seeds=seeds, preview=study.reference.preview, progress=False,
            variant=_variants(study, scenario, regulator), **acting,
        )  # fmt: skip


def _course(
    study: Study, prepared: Prepared, scenario: ScenarioTable, regulator: Regulator
) -> tuple[Plant | StateSpace, Course]:
    """What a scenario makes of the plant, and what acts on it."""
    plant = _plant(study, prepared, scenario, scenario.seed)
    acting = _acting(study, prepared, scenario) | {"variant": _variants(study, scenario, regulator)}
    with said_at(f"scenarios, {scenario.name!r}: "):
        return plant, acting_on(plant, regulator, steps=None, **acting).drawn(scenario.seed)


def _variants(study: Study, scenario: ScenarioTable, regulator: Regulator) -> list[str] | None:
    """Which variant of a bank decides each sample; None for other controllers, which have none."""
    if not isinstance(regulator.controller, ControllerBank):
        return None
    names = [regulator.controller.usual] * study.steps
    for switch in sorted(scenario.switches, key=lambda switch: switch.at):
        names[switch.at :] = [switch.variant] * len(names[switch.at :])
    return names


def _plant(study: Study, prepared: Prepared, scenario: ScenarioTable, seed: int) -> Plant | StateSpace:
    """The plant, off its model where the scenario says so."""
    plant = prepared.plant
    if scenario.mismatch is None:
        return plant
    if not isinstance(plant, StateSpace):
        raise StudyError(
            f"scenarios, {scenario.name!r}, mismatch: expected a plant that is a model, such as plant.kind = "
            f"'model', received {study.plant.kind!r}"
        )
    return Mismatch(**scenario.mismatch.model_dump()).drawn(plant, seed)


def _acting(study: Study, prepared: Prepared, scenario: ScenarioTable) -> dict[str, Any]:
    """What acts on the loop in a scenario, as `simulate` takes it."""
    model = prepared.model

    def disturbance(value: Values | None, usual: Any) -> Any:
        with said_at(f"scenarios, {scenario.name!r}, disturbances: "):
            return None if value is None else steps(study.steps, usual, [(scenario.disturbance_at, value)])

    return {
        "reference": _asked(study, prepared),
        "noise": scenario.noise,
        "input_disturbance": disturbance(scenario.input_disturbance, np.zeros(model.n_inputs)),
        "output_disturbance": disturbance(scenario.output_disturbance, np.zeros(model.n_outputs)),
        "measured_disturbance": disturbance(scenario.measured_disturbance, prepared.v_op),
        "loads": [load_of(study, model, table) for table in scenario.loads],
        "valves": None if scenario.valves is None else Valves(**scenario.valves.model_dump()),
        "u_initial": prepared.u_op,
        "limits": _limits(study, scenario),
        "manual": _manual(study, prepared, scenario),
    }


def _limits(study: Study, scenario: ScenarioTable) -> list[Limits | None] | None:
    """Limits of each sample, None for those of the problem."""
    if not scenario.limits:
        return None
    each: list[Limits | None] = [None] * study.steps
    for table in sorted(scenario.limits, key=lambda table: table.at):
        told = table.model_dump(exclude={"at"}, exclude_none=True)
        each[table.at :] = [Limits(**told) if told else None] * len(each[table.at :])
    return each


def _manual(study: Study, prepared: Prepared, scenario: ScenarioTable) -> Array | None:
    """Where inputs are put by hand, shape (T, m), not-a-number in automatic; None where none is."""
    if not scenario.manual:
        return None
    names = prepared.plant.names.inputs
    rows = np.full((study.steps, len(names)), np.nan)
    for table in scenario.manual:
        if table.input not in names:
            raise StudyError(
                f"scenarios, {scenario.name!r}, manual: expected one of {', '.join(names)}, received {table.input!r}"
            )
        rows[table.at : table.until, names.index(table.input)] = table.value
    return rows


def files_of(study: Study) -> list[Path]:
    """The files that a study names: its model, and the records that its loads come from.

    Raises:
        StudyError: a path that leads out of its folder.
    """
    folder = study.place.folder
    models = [] if study.model is None else [_inside(folder, study.model.file)]
    loads = [load.file for scenario in study.scenarios for load in scenario.loads if load.file is not None]
    return [*models, *(_inside(folder, file, "scenarios.loads.file") for file in loads)]


def load_of(study: Study, model: StateSpace, table: LoadTable) -> Load:
    """The load that a table describes."""
    if table.file is None:
        return table.made()
    names = model.names
    record = IOData.from_csv(
        _inside(study.place.folder, table.file, "scenarios.loads.file"),
        inputs=names.inputs, outputs=names.outputs, disturbances=names.disturbances, dt=model.dt,
    )  # fmt: skip
    residuals = Residuals.of(model, record)
    return residuals if table.at is None else replace(residuals, at=table.at)


def _operating_point(study: Study, plant: Plant | StateSpace) -> tuple[Array, Array]:
    """Usual inputs (m,) and measured disturbances (d,) of the plant."""
    m, d = len(plant.names.inputs), len(plant.names.disturbances)
    given = study.plant.operating_inputs
    u_op = getattr(plant, "u_op", None) if given is None else given
    if u_op is None:
        raise StudyError(
            f"plant.operating_inputs: expected {m} values, since {study.plant.kind!r} has no u_op, "
            "received none"
        )
    return as_vector("plant.operating_inputs", u_op, m), as_vector("v_op", getattr(plant, "v_op", 0.0), d)


def _record(
    plant: Plant | StateSpace, u_op: Array, v_op: Array, table: IdentificationTable, dt: float
) -> IOData:
    """Excite the inputs, and the measured disturbances if an amplitude is given for them too."""
    mean = u_op
    if isinstance(table.amplitude, list) and len(table.amplitude) == len(u_op) + len(v_op):
        mean = np.concatenate([u_op, v_op])
    signal = prbs(
        order=table.prbs_order,
        amplitude=table.amplitude,
        hold=table.hold,
        mean=mean,
        inputs=len(mean),
        seed=table.seed,
    )
    rest = plant.steady_state(np.concatenate([u_op, v_op]))
    return excite(plant, signal, dt=dt, noise=table.noise, seed=table.seed, x0=rest)


def _reference(study: Study, prepared: Prepared) -> Array:
    table, plant = study.reference, prepared.plant
    if len(table.initial) != len(plant.names.outputs):
        raise StudyError(
            f"reference.initial: expected {len(plant.names.outputs)} values, received {len(table.initial)}"
        )
    with said_at("reference."):
        staircase = steps(study.steps, table.initial, [(change.at, change.value) for change in table.changes])
    if not table.relative:
        return staircase
    usual = np.concatenate([prepared.u_op, prepared.v_op])
    if isinstance(plant, StateSpace):
        return staircase + plant.response(usual[None], plant.steady_state(usual))
    return staircase + np.asarray(plant.output(plant.steady_state(usual), usual))


def _asked(study: Study, prepared: Prepared) -> Array | Zone:
    """The reference, or zones about it where these change their widths."""
    reference = _reference(study, prepared)
    if not study.reference.zones:
        return reference
    l, problem = reference.shape[1], problem_of(study, prepared.model)
    below, above = (np.tile(width, (study.steps, 1)) for width in (problem.zone_below, problem.zone_above))
    try:
        for zone in sorted(study.reference.zones, key=lambda zone: zone.at):
            for widths, given in ((below, zone.below), (above, zone.above)):
                widths[zone.at :] = np.broadcast_to(np.asarray(given, dtype=float), l)
    except ValueError:
        raise StudyError(f"reference.zones: expected widths of {l} outputs, or one for all") from None
    return Zone(reference - below, reference + above)


def _faults(runs: dict[str, dict[str, Run]]) -> tuple[str, ...]:
    """What took the plant out of its range, run by run."""
    return tuple(
        f"{scenario}, {name}: the plant left its range at {len(run.faults)} samples "
        f"({', '.join(sorted({fault for faults in run.faults.values() for fault in faults}))})"
        for scenario, controllers in runs.items()
        for name, run in controllers.items()
        if run.faults
    )


def _inside(folder: Path, name: str, key: str = "model.file") -> Path:
    """A path named in a study: absolute on purpose, or within the study's folder."""
    path = Path(name)
    if path.is_absolute():
        return path
    try:
        resolved = (folder / path).resolve()
        inside = resolved.is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError) as error:  # as for links in circles
        raise StudyError(f"{key}: expected the path of a file, received {shown(name)}: {error}") from None
    if not inside:
        raise StudyError(
            f"{key}: expected a path within the study's folder (or an absolute one), received {shown(name)}"
        )
    return resolved
