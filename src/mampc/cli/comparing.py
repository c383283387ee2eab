"""Commands that compare: `sweep`, `front`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mampc.base.errors import MampcError, shown
from mampc.cli.app import app
from mampc.cli.console import bar, complain, console_for_tables
from mampc.cli.options import Jobs, Points, Scheduler, Seeds, SweepFolder, Trust, Yes

if TYPE_CHECKING:
    from mampc.compare.sweep import Sweep

LARGE_SWEEP = 20_000  # runs of a sweep that asks first


@app.command()
def sweep(
    study: Annotated[str, typer.Argument(help="A built-in study or a TOML file.")],
    out: SweepFolder = None,
    seeds: Seeds = 8,
    points: Points = 9,
    table: Annotated[str, typer.Option(help="Name of the table; .csv or .parquet.")] = "sweep.csv",
    jobs: Jobs = -1,
    scheduler: Scheduler = None,
    yes: Yes = False,
    trust: Trust = False,
) -> None:
    """Run every controller of a study over the values of its knob, in every scenario, under many seeds.

    The knob is a price or budget, a dead-band, a step, a weight: the number that trades moves for error. Writes one
    table with a row a run. A killed sweep goes on where it stopped when it is called again.

    Examples:

        mampc sweep quadruple-tank --seeds 16

        mampc sweep my-study.toml --points 15 --table runs.parquet
    """
    from mampc.report.fronts import write_rows

    if Path(table).name != table or Path(table).suffix not in (".csv", ".parquet"):
        raise MampcError(f"--table: expected a name that ends in .csv or .parquet, received {shown(table)}")
    _, rows, folder = _swept(study, out, seeds, points, jobs, scheduler, yes, trust)
    write_rows(rows, folder / table)
    console_for_tables().print(f"{len(rows)} runs are in {folder / table}", soft_wrap=True, markup=False)


@app.command()
def front(
    study: Annotated[str, typer.Argument(help="A built-in study or a TOML file.")],
    out: SweepFolder = None,
    seeds: Seeds = 8,
    points: Points = 9,
    jobs: Jobs = -1,
    scheduler: Scheduler = None,
    yes: Yes = False,
    trust: Trust = False,
) -> None:
    """Which controller needs the fewest moves at equal tracking error? Runs the sweep, then draws and tabulates.

    Writes report.html too, one page to send on: a slider along the fronts changes the trajectories that it shows.
    Takes what `mampc sweep` has finished in the same folder and runs what is missing.

    Example:

        mampc front quadruple-tank --seeds 16 --out results/tank-front
    """
    from mampc.report.front_page import write_front_page
    from mampc.report.fronts import front_figure, front_tables, scenarios_of, write_rows
    from mampc.report.output import save_figure
    from mampc.study.values import file_word

    plan, rows, folder = _swept(study, out, seeds, points, jobs, scheduler, yes, trust)
    write_rows(rows, folder / "sweep.csv")
    console = console_for_tables()
    for found in front_tables(rows):
        console.print(found)
        console.print()
    try:
        for scenario in scenarios_of(rows):
            save_figure(front_figure(rows, scenario), folder / f"{file_word(scenario)}_front")
    except MampcError as error:
        complain(f"note: no figures written; {error}")
    try:
        with bar("report.html") as show:
            write_front_page(plan, rows, folder, show)
    except MampcError as error:
        complain(f"note: no report.html written; {error}")
    console.print(f"Results are in {folder}", soft_wrap=True, markup=False)


def _swept(
    source: str,
    out: Path | None,
    seeds: int,
    points: int,
    jobs: int,
    scheduler: str | None,
    yes: bool,
    trust: bool,
) -> tuple[Sweep, list[dict[str, Any]], Path]:
    """A sweep, its rows, and the folder that holds its results."""
    from time import perf_counter

    from mampc.compare.sweep import Sweep, run_sweep, run_task
    from mampc.study import load_study
    from mampc.study.running import prepare
    from mampc.systems.properties import time_in_words

    plan = Sweep(load_study(source, trust=True if trust else None), seeds, points)
    folder = Path("results") / f"{Path(source).stem}-sweep" if out is None else out
    if plan.runs > LARGE_SWEEP and not yes:
        prepared, start = prepare(plan.study), perf_counter()
        run_task(Sweep(plan.study, 1, points), prepared, plan.tasks[-1])
        seconds = (perf_counter() - start) * plan.runs / 2
        if not typer.confirm(
            f"{plan.runs} runs may take {time_in_words(seconds)} on two cores. Go on?", err=True
        ):
            raise typer.Exit(1)
    with bar(source) as show:
        rows = run_sweep(plan, folder, jobs=jobs, scheduler=scheduler, on_task=show)
    return plan, rows, folder
