"""Studies that are tuned, and the study that tuning writes."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mampc.base.checks import LARGEST, Array
from mampc.base.errors import MampcError, listed
from mampc.compare.promise import PLAIN, in_words
from mampc.compare.scenarios import CHANGE, CHANGES, STAND_IN, scenario_length
from mampc.compare.sweep import BASELINE
from mampc.compare.tuned import Tuned
from mampc.loop.loads import Load
from mampc.methods.registry import METHODS
from mampc.moves.rules import MoveRules
from mampc.program.levels import OnOff
from mampc.study.draft import usual_threshold
from mampc.study.regulators import regulator_of
from mampc.study.running import Prepared, load_of
from mampc.study.scenario_tables import (
    LOADS,
    ChangeTable,
    LimitsTable,
    LoadTable,
    MismatchTable,
    ReferenceTable,
    ScenarioTable,
)
from mampc.study.schema import (
    ControllerTable,
    EstimatorTable,
    ModelTable,
    OnOffTable,
    PlantTable,
    ProblemTable,
    RulesTable,
    Study,
)
from mampc.systems.state_space import StateSpace

MODEL_FILE = "model.json"
OF_ACTUATORS = {
    "min_size": True,
    "dwell": True,
    "levels": True,
}  # rules that are no choice, whatever moves cost


def told_by(study: Study, prepared: Prepared, controller: str | None = None) -> dict[str, Any]:
    """What a study tells `tune`: plain MPC with its settings, noise, set-point changes and loads of its scenarios."""
    model = prepared.model
    noise = np.max([np.broadcast_to(s.noise, model.n_outputs) for s in study.scenarios], axis=0)
    levels = np.array([study.reference.initial, *_levels(study, model.n_outputs)])
    rest = 0.0 if study.reference.relative else model.y_op
    loads = [[load_of(study, model, table) for table in scenario.loads] for scenario in study.scenarios]
    return {
        "baseline": regulator_of(study, model, BASELINE),
        "noise": noise if (noise > 0).all() else None,
        "reference_changes": np.abs(levels - rest).max(axis=0),
        "loads": loads if any(loads) else None,
        "rules": rules_of(study, controller),
    }


def rules_of(study: Study, controller: str | None = None) -> MoveRules | None:
    """The rules to keep at any price: those of one controller, or what all of a study say of their actuators.

    Raises:
        MampcError: no such controller with rules, or several that say different things of the actuators.
    """
    tables = {table.name: table for table in study.controllers if table.method in METHODS}
    if controller is not None:
        if controller not in tables:
            raise MampcError(
                f"--controller: expected one with rules, among {listed(list(tables)) or 'none'}, received "
                f"{controller!r}"
            )
        told = tables[controller].rules
        assert told is not None
        return told.made()
    of_actuators = [table.rules.model_dump(include=OF_ACTUATORS) for table in tables.values() if table.rules]
    if any(one != of_actuators[0] for one in of_actuators):
        raise MampcError(
            f"tune: expected controllers with the same {listed(list(OF_ACTUATORS))}, received several; say whose rules "
            f"hold, such as --controller {next(iter(tables))!r}"
        )
    return RulesTable(**of_actuators[0]).made() if of_actuators else None


def study_of_model(model: StateSpace, tuned: Tuned, name: str) -> Study:
    """A study of a model alone, which stands in for its plant off by some shares, under each kind of load."""
    problem = tuned.baseline.controller.problem
    samples = scenario_length(problem)
    size = CHANGE * tuned.noise
    rest = np.clip(model.u_op, problem.limits.u_min, problem.limits.u_max)
    plant = PlantTable(kind="model", operating_inputs=None if (rest == model.u_op).all() else rest.tolist())
    changes = [
        ChangeTable(at=int((k + 0.1) * samples / CHANGES), value=(sign * size).tolist())
        for k, sign in enumerate((1.0, -0.5, 0.5, -1.0))
    ]
    scenarios = [
        ScenarioTable(
            name=in_words(kind), noise=tuned.noise.tolist(), seed=number, loads=[_table(load) for load in kind],
            mismatch=MismatchTable(**vars(STAND_IN)),
        )
        for number, kind in enumerate(tuned.loads)
    ]  # fmt: skip
    return Study(
        name=name, steps=samples, dt=model.dt, plant=plant, threshold=usual_threshold(problem.limits),
        model=ModelTable(file=MODEL_FILE),
        problem=_problem(tuned), reference=ReferenceTable(initial=[0.0] * len(size), changes=changes),
        scenarios=scenarios, controllers=[BASELINE],
    )  # fmt: skip


def with_tuning(study: Study, tuned: Tuned) -> Study:
    """A study with the problem, the estimator and the controller found, and plain MPC beside it."""
    changed: dict[str, Any] = {"identification": None, "model": ModelTable(file=MODEL_FILE)}
    if tuned.is_plain:
        return study.model_copy(update=changed | {"controllers": [baseline_of(tuned)]})
    estimator = EstimatorTable(
        kind="load_bank",
        value_of_information=tuned.regulator.value_of_information,
        price_follows_noise=tuned.noise_guessed,
        measurement_noise=tuned.noise.tolist(),
    )
    controllers = [
        ControllerTable(name="tuned", method="exact", rules=rules_table(tuned.rules)),
        baseline_of(tuned).model_copy(update={"name": "without a price"}),
    ]
    scenarios = [
        scenario.model_copy(update={"loads": [_found(study, load) for load in scenario.loads]})
        for scenario in study.scenarios
    ]
    changed |= {"problem": _problem(tuned), "estimator": estimator, "controllers": controllers}
    return study.model_copy(update=changed | {"scenarios": scenarios})


def baseline_of(tuned: Tuned) -> ControllerTable:
    """Plain MPC, or the rules that were told alone."""
    if tuned.expected.beside == PLAIN:
        return BASELINE
    return ControllerTable(
        name=tuned.expected.beside, method="exact", rules=rules_table(replace(tuned.rules, price=0.0))
    )


def rules_table(rules: MoveRules) -> RulesTable:
    """Rules as a study says them."""
    told: dict[str, Any] = {one.name: getattr(rules, one.name) for one in fields(rules)}
    entries = told.pop("levels")
    levels = [_entry(entry) for entry in entries] if isinstance(entries, tuple) else entries
    if isinstance(entries, OnOff):
        levels = _entry(entries)
    plain = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in told.items()}
    return RulesTable(**{name: value for name, value in plain.items() if value is not None}, levels=levels)


def _entry(levels: Any) -> Any:
    if isinstance(levels, OnOff):
        return OnOffTable(**{one.name: getattr(levels, one.name) for one in fields(levels)})
    return "any" if levels is None else list(levels) if isinstance(levels, tuple) else levels


def _levels(study: Study, outputs: int) -> list[list[float]]:
    return [np.broadcast_to(change.value, outputs).tolist() for change in study.reference.changes]


def _table(load: Load) -> LoadTable:
    """A load of `mampc.loads` as a study says it."""
    kind = next(name for name, known in LOADS.items() if known is type(load))
    told = {one.name: getattr(load, one.name) for one in fields(load)}  # type: ignore[arg-type]
    return LoadTable(kind=kind, **{k: list(v) if isinstance(v, tuple) else v for k, v in told.items()})  # type: ignore[arg-type]


def _found(study: Study, load: LoadTable) -> LoadTable:
    """A load whose file is found from anywhere."""
    if load.file is None:
        return load
    return load.model_copy(update={"file": str((study.place.folder / Path(load.file)).resolve())})


def _problem(tuned: Tuned) -> ProblemTable:
    problem = tuned.problem
    limits = {one.name: _limit(getattr(problem.limits, one.name)) for one in fields(problem.limits)}
    return ProblemTable(
        prediction_horizon=problem.prediction_horizon, control_horizon=problem.control_horizon,
        output_weight=_weight(problem.output_weight), move_weight=_weight(problem.move_weight),
        limits=LimitsTable(**limits), weigh_first_move=problem.weigh_first_move,
        output_limit_weight=problem.output_limit_weight, tail_horizon=problem.tail_horizon,
        u_target=None if problem.u_target is None else problem.u_target.tolist(),
        u_target_weight=_weight(problem.u_target_weight), u_cost=problem.u_cost.tolist(),
        zone_below=problem.zone_below.tolist(), zone_above=problem.zone_above.tolist(),
        zone_pull=problem.zone_pull,
        output_rank=None if problem.output_rank is None else problem.output_rank.tolist(),
    )  # fmt: skip


def _weight(matrix: Array) -> Any:
    diagonal = np.diag(matrix)
    return diagonal.tolist() if not (matrix - np.diag(diagonal)).any() else matrix.tolist()


def _limit(values: Array) -> list[float] | None:
    if np.isinf(values).all():
        return None
    finite: list[float] = np.clip(values, -LARGEST, LARGEST).tolist()
    return finite
