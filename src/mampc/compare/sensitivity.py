"""Sensitivity: a study run again with one setting changed at a time, in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mampc.base.workers import in_parallel
from mampc.study.regulators import regulator_of
from mampc.study.running import Prepared, prepare, run_controller
from mampc.study.scenario_tables import ScenarioTable
from mampc.study.schema import ControllerTable, Study

SETTINGS = {
    "move_weight": "move weight lambda",
    "penalty": "penalty mu",
    "sparsity_horizon": "sparsity horizon ns",
    "max_moves": "budget s",
    "dt": "sample time (s)",
    "noise": "measurement noise",
    "reference": "size of the reference steps",
}


@dataclass(frozen=True)
class Point:
    """One run with one setting changed: its value, and changes and error as ratios to plain MPC.

    `changes_ratio` counts changes above the threshold of all inputs together; a ratio is None where plain
    MPC's figure is zero.
    """

    setting: str
    value: float
    changes_ratio: float | None
    error_ratio: float | None


def sensitivity(
    study: Study,
    scenario: ScenarioTable,
    sparse: ControllerTable,
    grid: dict[str, list[float]],
    *,
    jobs: int = -1,
    on_point: Callable[[int, int], None] = lambda done, total: None,
) -> list[Point]:
    """Compare one sparse controller with the study's first plain MPC, changing one setting at a time.

    Args:
        study: holds the settings that stay, and a controller with method "mpc".
        scenario: noise and disturbances.
        sparse: the controller to compare.
        grid: setting -> values, settings named in `SETTINGS`; "reference" scales the steps.
        jobs: processes, -1 for one a core.
        on_point: called with the number of finished and of all runs.

    Raises:
        MampcError: values that do not fit the study.
    """
    from joblib import delayed

    plain = next(table for table in study.controllers if table.method == "mpc")
    values = [(setting, value) for setting, column in grid.items() for value in column]
    usual = {setting: _usual(study, scenario, sparse, setting) for setting in grid}
    # The settings as they are come up in every column and are run once; a model is identified once a dt.
    tasks = [("dt", study.dt), *((setting, value) for setting, value in values if value != usual[setting])]
    times = sorted({study.dt, *grid.get("dt", [])})
    prepare_each = (delayed(prepare)(study.model_copy(update={"dt": dt})) for dt in times)
    models = in_parallel(prepare_each, jobs)
    prepared = dict(zip(times, models, strict=True))
    work = (
        delayed(_point)(
            study, prepared[value if setting == "dt" else study.dt], scenario, plain, sparse, setting, value
        )
        for setting, value in tasks
    )
    done: dict[tuple[str, float], Point] = {}
    for task, point in zip(tasks, in_parallel(work, jobs), strict=True):
        done[task] = point
        on_point(len(done), len(tasks))
    as_is = done["dt", study.dt]
    return [done.get((s, v), replace(as_is, setting=s, value=v)) for s, v in values]


def _usual(study: Study, scenario: ScenarioTable, sparse: ControllerTable, setting: str) -> Any:
    """The value that a setting has, None where it is not one number."""
    own = {
        "move_weight": study.problem.move_weight,
        "penalty": sparse.settings.get("penalty"),
        "dt": study.dt,
        "noise": scenario.noise,
        "reference": 1.0,
    }
    return own[setting] if setting in own else getattr(sparse.rules, setting)


def _point(
    study: Study,
    prepared: Prepared,
    scenario: ScenarioTable,
    plain: ControllerTable,
    sparse: ControllerTable,
    setting: str,
    value: float,
) -> Point:
    changed, scenario, sparse = varied(study, scenario, sparse, setting, value)
    figures = []
    for table in (plain, sparse):
        regulator = regulator_of(changed, prepared.model, table)
        metrics = run_controller(changed, prepared, scenario, regulator).metrics(threshold=study.threshold)
        figures.append((float(metrics.sparse_density.sum()), metrics.tracking_error))
    (base_changes, base_error), (changes, error) = figures
    return Point(
        setting,
        value,
        changes / base_changes if base_changes > 0 else None,
        error / base_error if base_error > 0 else None,
    )


def varied(
    study: Study, scenario: ScenarioTable, sparse: ControllerTable, setting: str, value: float
) -> tuple[Study, ScenarioTable, ControllerTable]:
    """The study, scenario and controller with one setting changed."""

    def within(table: Any, part: str, **changes: Any) -> Any:
        return table.model_copy(update={part: getattr(table, part).model_copy(update=changes)})

    if setting == "move_weight":
        return within(study, "problem", move_weight=value), scenario, sparse
    if setting == "dt":
        return study.model_copy(update={"dt": value}), scenario, sparse
    if setting == "reference":
        changes = [
            change.model_copy(update={"value": (np.asarray(change.value) * value).tolist()})
            for change in study.reference.changes
        ]
        return within(study, "reference", changes=changes), scenario, sparse
    if setting == "noise":
        return study, scenario.model_copy(update={"noise": value}), sparse
    if setting == "penalty":
        return study, scenario, sparse.model_copy(update={"settings": sparse.settings | {"penalty": value}})
    return study, scenario, within(sparse, "rules", **{setting: int(value)})


def holding(points: list[Point], most_error: float) -> Iterator[Point]:
    """The points at which inputs change less and the error is at most `most_error` times that of MPC."""
    for point in points:
        if point.changes_ratio is None or point.error_ratio is None:
            continue
        if point.changes_ratio < 1.0 and point.error_ratio <= most_error:
            yield point
