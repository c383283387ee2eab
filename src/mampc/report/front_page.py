"""report.html of a front: moves against error of every setting, and the runs of those worth choosing among.

Moves and errors are means over all seeds of a sweep. Trajectories are of the scenario's own seed; these runs are made
anew, as a sweep keeps no trajectories.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mampc.base.files import written_whole
from mampc.compare.fronts import Point, error_ratio, moves_at, non_dominated
from mampc.compare.knobs import knob_of
from mampc.compare.sweep import Sweep, Task, points_of
from mampc.loop.run import Run
from mampc.report.fronts import SHOWN, WIDEST
from mampc.report.interactive import interactive_page
from mampc.report.page_content import DAY, Means
from mampc.study.regulators import regulator_of
from mampc.study.running import Made, StudyResult, prepare, run_controller
from mampc.study.schema import ControllerTable

Rows = list[dict[str, Any]]
PAGE = "report.html"
MOST_SETTINGS = 12  # of a method in a scenario, evenly along its front


def write_front_page(
    sweep: Sweep, rows: Rows, folder: Path, on_run: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Write report.html into a folder; raises `MampcError` where plotly is missing."""
    with written_whole(folder / PAGE) as unfinished:
        unfinished.write_text(front_page(sweep, rows, on_run), encoding="utf-8")


def front_page(
    sweep: Sweep, rows: Rows, on_run: Callable[[int, int], None] = lambda done, total: None
) -> str:
    """The text of report.html; `on_run` is called with the number of finished and of all runs."""
    study, prepared = sweep.study, prepare(sweep.study)
    tasks = {(task.scenario.name, task.table.name, task.value): task for task in sweep.tasks}
    chosen: list[tuple[Task, str, Point]] = []
    group, first, notes = dict[str, str](), dict[str, str](), list[str]()
    for scenario in study.scenarios:
        baseline, points = points_of(rows, scenario.name)
        chosen.append((tasks[scenario.name, baseline.method, baseline.value], baseline.method, baseline))
        at = {name: moves_at(own, baseline, SHOWN).value for name, own in points.items()}
        best = min(at, key=lambda name: at[name] if np.isfinite(at[name]) else np.inf, default="")
        first[scenario.name] = baseline.method
        for name, own in points.items():
            shown = worth_showing(own, baseline)
            if not shown:
                notes.append(
                    f"In {scenario.name}, no setting of {name} comes within {WIDEST:g} times the error of plain MPC."
                )
            allowed = [p for p in shown if error_ratio(p, baseline) <= SHOWN]
            for point in shown:
                task = tasks[scenario.name, name, point.value]
                named = setting_name(task.table, point.value)
                if any(named == other and task.scenario is before.scenario for before, other, _ in chosen):
                    named = setting_name(task.table, point.value, digits=8)
                group[named] = name
                chosen.append((task, named, point))
                if name == best and allowed and point is min(allowed, key=lambda p: float(p.moves.mean())):
                    first[scenario.name] = named
    means: dict[str, dict[str, tuple[float, float]]] = {s.name: {} for s in study.scenarios}
    runs: dict[str, dict[str, Run]] = {s.name: {} for s in study.scenarios}
    tables: dict[str, ControllerTable] = {}
    made: dict[str, Made] = {}
    for number, (task, named, point) in enumerate(chosen, 1):
        regulator = regulator_of(study, prepared.model, task.table)
        run = run_controller(study, prepared, task.scenario, regulator)
        days = (study.steps - study.skip) * study.dt / DAY
        means[task.scenario.name][named] = float(point.moves.mean()) / days, float(point.error.mean())
        runs[task.scenario.name][named] = run
        made[named] = Made.of(regulator)
        tables[named] = task.table.model_copy(update={"name": named})
        on_run(number, len(chosen))
    shown_study = study.model_copy(update={"controllers": list(tables.values())})
    result = StudyResult(shown_study, prepared.model, prepared.data, prepared.identified, runs, (), made)
    told = (
        f"Moves and errors are means over {sweep.seeds} {'seeds' if sweep.seeds > 1 else 'seed'} of noise and loads; "
        "trajectories, and what they mean for the actuators, are of one of them."
    )
    return interactive_page(result, Means(study, means, group, first, told, " ".join(notes)))


def worth_showing(points: list[Point], baseline: Point) -> list[Point]:
    """The front of a method, as far as its errors are not far beyond that of plain MPC; some of it where it is long."""
    moves, errors = np.array([p.moves.mean() for p in points]), np.array([p.error.mean() for p in points])
    front = [points[i] for i in non_dominated(moves, errors).tolist()]
    front = [point for point in front if error_ratio(point, baseline) <= WIDEST]
    places = np.linspace(0, len(front) - 1, min(len(front), MOST_SETTINGS)).round().astype(int)
    return [front[place] for place in places.tolist()]


def setting_name(table: ControllerTable, value: float, digits: int = 3) -> str:
    """A controller with its knob, such as "dead-band, size 0.5"."""
    place = knob_of(table)
    if place is None:
        return table.name
    part, name = place.split(".")
    own = getattr(table, part)
    own = getattr(own, name) if part == "rules" else own.get(name, value)
    if isinstance(own, list | tuple):
        own = ", ".join(f"{entry:.{digits}g}" for entry in np.ravel(own))
        return f"{table.name}, {name} ({own})"
    return f"{table.name}, {name} {own:.{digits}g}"
