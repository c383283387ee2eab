"""Sweeps: every controller of a study over the values of its knob, in every scenario, under many seeds."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mampc.base.checks import as_jobs
from mampc.base.errors import MampcError, shown
from mampc.base.files import made_folder, read_bounded
from mampc.base.workers import in_parallel
from mampc.compare.fronts import Point
from mampc.compare.journal import Journal
from mampc.compare.knobs import variants
from mampc.study.regulators import regulator_of
from mampc.study.running import Prepared, files_of, prepare, run_seeds
from mampc.study.scenario_tables import ScenarioTable
from mampc.study.schema import ControllerTable, Study

BASELINE = ControllerTable(name="MPC", method="mpc")
FILE_LIMIT = 2**30  # bytes
SCHEDULER_SECONDS = 6  # that a cluster has to answer within


@dataclass(frozen=True)
class Task:
    """One controller with one value of its knob in one scenario, under all seeds."""

    scenario: ScenarioTable
    table: ControllerTable
    value: float

    @property
    def name(self) -> str:
        return f"{self.scenario.name} | {self.table.name} | {self.value:.12g}"


@dataclass(frozen=True)
class Sweep:
    """What is swept.

    Args:
        study: its controllers, and plain MPC if it has none, in its scenarios.
        seeds: how many, counted from each scenario's own.
        points: values of each controller's knob.
    """

    study: Study
    seeds: int = 8
    points: int = 9

    @property
    def controllers(self) -> list[ControllerTable]:
        tables = list(self.study.controllers)
        return tables if any(table.method == "mpc" for table in tables) else [BASELINE, *tables]

    @property
    def tasks(self) -> list[Task]:
        """All of them, plain MPC first."""
        tables = sorted(self.controllers, key=lambda table: table.method != "mpc")
        return [
            Task(scenario, changed, value)
            for scenario in self.study.scenarios
            for table in tables
            for value, changed in variants(table, self.points)
        ]

    @property
    def runs(self) -> int:
        return len(self.tasks) * self.seeds

    @property
    def identity(self) -> str:
        """What tells this sweep from others, the content of the study's files included."""
        text = self.study.model_dump_json(exclude={"place"})
        told = hashlib.sha256(f"{text} {self.seeds} {self.points}".encode())
        for file in files_of(self.study):
            told.update(read_bounded(file, FILE_LIMIT, "file of a study"))
        return told.hexdigest()[:16]


def run_sweep(
    sweep: Sweep,
    folder: Path,
    *,
    jobs: int = -1,
    scheduler: str | None = None,
    on_task: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """Run what has not been run yet; every finished task is in `folder`/sweep.jsonl at once.

    Args:
        sweep: what to run.
        folder: of the journal.
        jobs: processes, -1 for one a core.
        scheduler: address of a Dask scheduler, such as tcp://host:8786, in place of processes here.
        on_task: called with the number of finished and of all tasks.

    Returns:
        One row a run: scenario, controller, method, value, seed, moves, error and what `Metrics` counts.

    Raises:
        MampcError: values that do not fit the study, results of another sweep, or a scheduler that is not there.
    """
    as_jobs(jobs)
    journal = Journal(made_folder(folder) / "sweep.jsonl", sweep.identity)
    tasks = sweep.tasks
    missing = [task for task in tasks if task.name not in journal.done]
    on_task(len(tasks) - len(missing), len(tasks))
    if missing:
        cluster = None if scheduler is None else _cluster(scheduler)
        prepared = prepare(sweep.study)
        for task in {task.table.name: task for task in missing}.values():  # complain now rather than half-way
            regulator_of(sweep.study, prepared.model, task.table)
        for number, (name, rows) in enumerate(_results(sweep, prepared, missing, jobs, cluster), 1):
            journal.add(name, rows)
            on_task(len(tasks) - len(missing) + number, len(tasks))
    return [row for task in tasks for row in journal.done[task.name]]


def _results(
    sweep: Sweep, prepared: Prepared, tasks: list[Task], jobs: int, cluster: Any
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Each task's name and rows, as they finish."""
    if cluster is not None:
        yield from _on_cluster(sweep, prepared, tasks, cluster)
        return
    if jobs == 1 or len(tasks) == 1:
        for task in tasks:
            yield task.name, run_task(sweep, prepared, task)
        return
    from joblib import delayed

    calls = (delayed(_named)(sweep, prepared, task) for task in tasks)
    yield from in_parallel(calls, jobs, ordered=False, max_nbytes=None)


def _cluster(address: str) -> Any:
    """A client of a Dask cluster."""
    try:
        from distributed import Client
    except ImportError:
        raise MampcError("--scheduler: expected the extra mampc[cluster], received none installed") from None
    try:
        return Client(address, timeout=SCHEDULER_SECONDS)
    except Exception as error:  # whatever answers there, it is no scheduler
        raise MampcError(
            f"--scheduler: expected a Dask scheduler at {shown(address)}, received: {shown(str(error), 200)}"
        ) from None


def _on_cluster(
    sweep: Sweep, prepared: Prepared, tasks: list[Task], client: Any
) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """The same on a Dask cluster, which gives the tasks of a lost worker to others."""
    from distributed import as_completed

    with client:
        shared = client.scatter((sweep, prepared), broadcast=True)
        futures = [client.submit(_shared, shared, task, pure=False, retries=3) for task in tasks]
        for _, result in as_completed(futures, with_results=True):
            yield result


def _shared(shared: tuple[Sweep, Prepared], task: Task) -> tuple[str, list[dict[str, Any]]]:
    return _named(*shared, task)


def _named(sweep: Sweep, prepared: Prepared, task: Task) -> tuple[str, list[dict[str, Any]]]:
    return task.name, run_task(sweep, prepared, task)


def run_task(sweep: Sweep, prepared: Prepared, task: Task) -> list[dict[str, Any]]:
    """The rows of one task, one a seed."""
    study, first = sweep.study, task.scenario.seed
    regulator = regulator_of(study, prepared.model, task.table)
    seeds = range(first, first + sweep.seeds)
    batch = run_seeds(study, prepared, task.scenario, regulator, seeds)
    rows = []
    figures = batch.metrics(threshold=study.threshold, skip=study.skip, output_weight=study.error_weight)
    for seed, metrics in zip(seeds, figures, strict=True):
        rows.append({
            "scenario": task.scenario.name, "controller": task.table.name, "method": task.table.method,
            "value": task.value, "seed": seed, "moves": int(metrics.moves.sum()),
            "error": metrics.weighted_error, "steps": metrics.steps,
            "moves_per_hour": float(metrics.moves.sum() * 3600 / (metrics.steps * study.dt)),
            "reversals": int(metrics.reversals.sum()),
            **{f"moves_{i}": int(count) for i, count in enumerate(metrics.moves.tolist())},
            **{f"travel_{i}": float(way) for i, way in enumerate(metrics.travel.tolist())},
        })  # fmt: skip
    return rows


def points_of(rows: list[dict[str, Any]], scenario: str) -> tuple[Point, dict[str, list[Point]]]:
    """Plain MPC, and the points of every other controller, in one scenario.

    Raises:
        MampcError: a table without plain MPC.
    """
    grouped: dict[tuple[str, str, float], list[dict[str, Any]]] = {}
    for row in rows:
        if row["scenario"] == scenario:
            grouped.setdefault((row["controller"], row["method"], float(row["value"])), []).append(row)
    baseline, points = None, dict[str, list[Point]]()
    for (name, method, value), group in grouped.items():
        group.sort(key=lambda row: int(row["seed"]))
        point = Point(
            name, value, np.array([float(row["moves"]) for row in group]),
            np.array([float(row["error"]) for row in group]),
        )  # fmt: skip
        if method == "mpc" and baseline is None:
            baseline = point
        else:
            points.setdefault(name, []).append(point)
    if baseline is None:
        raise MampcError(f"sweep: expected runs of plain MPC in {scenario!r}, received none")
    return baseline, points
