"""Running a study: excite, identify, close the loop with every controller in every scenario."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mampc.controllers import MAMPC, MPC
from mampc.controllers.controller import Controller
from mampc.controllers.mampc import METHODS
from mampc.errors import MampcError, StudyError
from mampc.identification import Identified, IOData, excite, n4sid
from mampc.lti import StateSpace
from mampc.patterns import MoveRules
from mampc.plants import Plant
from mampc.problem import Limits, TrackingProblem
from mampc.regulator import Regulator
from mampc.signals import prbs, steps
from mampc.simulation import Run, simulate
from mampc.study.schema import (
    PLANTS,
    ControllerTable,
    IdentificationTable,
    PlantTable,
    ScenarioTable,
    Study,
    Values,
)


@dataclass(frozen=True, eq=False)
class StudyResult:
    """A study's outcome.

    Attributes:
        study: what was asked.
        model: the model the controllers use.
        data, identified: the record and the identification, None where the model came from a file.
        runs: scenario name -> controller name -> `Run`.
        warnings: what the user should know before trusting the figures.
    """

    study: Study
    model: StateSpace
    data: IOData | None
    identified: Identified | None
    runs: dict[str, dict[str, Run]]
    warnings: tuple[str, ...]


def run_study(study: Study, on_stage: Callable[[str], None] = lambda stage: None) -> StudyResult:
    """Excite, identify and run every controller in every scenario.

    Args:
        study: from `load_study`.
        on_stage: called with a line of text when a stage begins, to show progress.

    Raises:
        MampcError: values of the study that do not fit its plant or model.
    """
    data = identified = None
    if study.model is not None:
        model = StateSpace.load(_inside(study._folder, study.model.file))
        if not np.isclose(model.dt, study.dt, rtol=1e-6):
            raise StudyError(f"dt: expected the model's {model.dt:g} s, received {study.dt:g} s")
        plant: Plant | StateSpace = model if study.plant.kind == "model" else _plant(study.plant)
    else:
        plant = _plant(study.plant)
        assert study.identification is not None
        on_stage("exciting the plant")
        data = _record(plant, study.identification, study.dt)
        on_stage("identifying a model")
        settings = study.identification
        identified = n4sid(
            data, order=settings.order, weighting=settings.weighting, feedthrough=settings.feedthrough
        )
        model = identified.model
    problem = _problem(study, model)
    controllers = {table.name: _controller(problem, table) for table in study.controllers}
    warnings = _warnings(next(iter(controllers.values())))
    reference = _reference(study, plant)
    runs: dict[str, dict[str, Run]] = {}
    for scenario in study.scenarios:
        runs[scenario.name] = {}
        for name, controller in controllers.items():
            on_stage(f"{scenario.name}: {name}")
            runs[scenario.name][name] = simulate(
                plant,
                Regulator(controller),
                reference,
                noise=scenario.noise,
                seed=scenario.seed,
                preview=study.reference.preview,
                input_disturbance=_from_sample(
                    scenario.input_disturbance, scenario, study.steps, model.n_inputs
                ),
                output_disturbance=_from_sample(
                    scenario.output_disturbance, scenario, study.steps, model.n_outputs
                ),
                progress=False,
            )
    return StudyResult(study, model, data, identified, runs, warnings)


def _problem(study: Study, model: StateSpace) -> TrackingProblem:
    table = study.problem
    try:
        return TrackingProblem(
            model, **table.model_dump(exclude={"limits"}), limits=Limits(**table.limits.model_dump())
        )
    except MampcError as error:
        raise StudyError(f"[problem] {error}") from None


def _plant(table: PlantTable) -> Plant:
    kind = PLANTS[table.kind]
    try:
        plant: Plant = kind(**table.parameters)
    except TypeError as error:
        raise StudyError(
            f"plant.parameters: expected parameters of {kind.__name__}, received: {error}"
        ) from None
    except MampcError as error:
        raise StudyError(f"plant.parameters: {error}") from None
    return plant


def _record(plant: Plant, table: IdentificationTable, dt: float) -> IOData:
    signal = prbs(
        order=table.prbs_order,
        amplitude=table.amplitude,
        hold=table.hold,
        mean=getattr(plant, "u_op", 0.0),
        inputs=len(plant.names.inputs),
        seed=table.seed,
    )
    return excite(plant, signal, dt=dt, noise=table.noise, seed=table.seed)


def _controller(problem: TrackingProblem, table: ControllerTable) -> Controller:
    if table.method == "mpc":
        return MPC(problem)
    assert table.rules is not None
    try:
        method = METHODS[table.method](**table.settings)
    except (TypeError, MampcError) as error:
        raise StudyError(f"controllers, {table.name!r}, settings: {error}") from None
    return MAMPC(problem, MoveRules(**table.rules.model_dump()), method=method)


def _reference(study: Study, plant: Plant | StateSpace) -> Any:
    table = study.reference
    staircase = steps(study.steps, table.initial, [(change.at, change.value) for change in table.changes])
    if staircase.shape[1] != len(plant.names.outputs):
        raise StudyError(
            f"reference.initial: expected {len(plant.names.outputs)} values, received {staircase.shape[1]}"
        )
    if not table.relative:
        return staircase
    u_op = np.asarray(getattr(plant, "u_op", None))
    y_op = plant.y_op if isinstance(plant, StateSpace) else plant.output(plant.steady_state(u_op), u_op)
    return y_op + staircase


def _from_sample(value: Values | None, scenario: ScenarioTable, samples: int, width: int) -> Any:
    if value is None:
        return None
    return steps(samples, np.zeros(width), [(scenario.disturbance_at, value)])


def _warnings(controller: Controller) -> tuple[str, ...]:
    radius = float(np.abs(controller.condensed.closed_loop_poles()).max())
    if radius < 1.0:
        return ()
    problem = controller.problem
    return (
        f"the closed loop without limits is unstable: spectral radius {radius:.3f} "
        f"at dt = {problem.model.dt:g} s with horizons "
        f"{problem.prediction_horizon} and {problem.control_horizon}; "
        "lengthen the prediction horizon or the sample time, or raise move_weight",
    )


def _inside(folder: Path, name: str) -> Path:
    """A path named in a study: absolute on purpose, or within the study's folder."""
    path = Path(name)
    if path.is_absolute():
        return path
    resolved = (folder / path).resolve()
    if not resolved.is_relative_to(folder.resolve()):
        raise StudyError(f"expected a path within the study's folder (or an absolute one), received {name!r}")
    return resolved
