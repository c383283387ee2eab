"""Commands about studies: `run`, `replay`, `reproduce`, `new`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from mampc.base.errors import MampcError
from mampc.cli.app import app
from mampc.cli.console import complain, console_for_tables, progress
from mampc.cli.options import Trust


@app.command()
def run(
    study: Annotated[str, typer.Argument(help="A built-in study (quadruple-tank, sofc) or a TOML file.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results; default results/NAME.")
    ] = None,
    trust: Trust = False,
) -> None:
    """Run a study: identify a model, close the loop with every controller, compare.

    Prints a table and writes summary.json, a CSV of every trajectory, the model, figures (PNG, SVG) and
    report.html, one page to send on: it needs no other file and no network.

    Examples:

        mampc run quadruple-tank

        mampc run sofc --out results/stack

        mampc run my-study.toml --out results/valves
    """
    from mampc.report.output import run_and_write
    from mampc.report.tables import comparison_tables
    from mampc.study import load_study

    plan = load_study(study, trust=True if trust else None)
    directory = Path("results") / Path(study).stem if out is None else out
    with progress() as show:
        result, summary, missing = run_and_write(plan, directory, show)
    console = console_for_tables()
    for table in comparison_tables(plan, summary):
        console.print(table)
        console.print()
    for warning in result.warnings:
        complain(f"warning: {warning}")
    for note in missing:
        complain(f"note: {note}")
    console.print(f"Results are in {directory}", soft_wrap=True, markup=False)


@app.command()
def replay(
    run: Annotated[
        Path,
        typer.Argument(
            help="A trajectory that `mampc run` wrote, SCENARIO_CONTROLLER.csv, or a live loop's `Recorder`."
        ),
    ],
    study: Annotated[
        str, typer.Option("--study", "-s", help="The study it came from: a name or a TOML file.")
    ],
    tolerance: Annotated[
        float, typer.Option(help="Of inputs and objectives, relative to their size; 0 for the same bits.")
    ] = 1e-9,
    controller: Annotated[
        str | None, typer.Option("--controller", "-c", help="Of the study, which a live loop ran with.")
    ] = None,
    trust: Trust = False,
) -> None:
    """Decide again on the recorded measurements of a run, and find the first decision that differs.

    The model is the model.json beside the run, if there is one, else it is identified again. Exits with 0 if
    every decision comes out as recorded, with 1 if one differs.

    Examples:

        mampc replay results/quadruple-tank/noisy_exact-price.csv --study quadruple-tank

        mampc replay monday.csv --study my-study.toml --controller "exact price"
    """
    from mampc.report.replaying import replay_trajectory
    from mampc.study import load_study

    plan = load_study(study, trust=True if trust else None)
    with progress() as show:
        samples, difference = replay_trajectory(run, plan, tolerance, show, controller)
    if difference is not None:
        console_for_tables().print(
            f"{run}: the first difference is at {difference}", soft_wrap=True, markup=False
        )
        raise typer.Exit(1)
    console_for_tables().print(
        f"{run}: all {samples} decisions come out as recorded", soft_wrap=True, markup=False
    )


@app.command()
def reproduce(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the page and all results.")] = Path(
        "results/reproduction"
    ),
) -> None:
    """Run both case studies of the paper and put its results beside ours on one page.

    Writes report.md and a self-contained report.html: the paper's tables and figures redrawn, how the
    ratios to MPC move with the settings that the paper leaves open, and where its claim holds.

    Example:

        mampc reproduce --out results/paper
    """
    from mampc.report.reproduction import reproduce as run_all
    from mampc.report.tables import comparison_tables

    with progress() as show:
        cases = run_all(out, show)
    console = console_for_tables()
    for case in cases:
        for table in comparison_tables(case.study, case.summary):
            console.print(table)
            console.print()
        for warning in case.result.warnings:
            complain(f"warning: {warning}")
    console.print(f"Open {out / 'report.html'}", soft_wrap=True, markup=False)


@app.command()
def new(
    path: Annotated[Path, typer.Argument(help="File to write; must not exist yet.")],
    model: Annotated[
        Path | None, typer.Option("--model", "-m", help="A model file; the study is made for its plant.")
    ] = None,
) -> None:
    """Write a study to start your own from: a commented example, or with --model one that fits your plant.

    With a model, limits, weights, horizons, reference, price and noise come from it and from what its record
    said; what nobody told is marked as a placeholder.

    Examples:

        mampc new my-study.toml && mampc run my-study.toml

        mampc new column.toml --model column.json
    """
    from mampc.base.files import written_whole
    from mampc.study import template

    if path.exists():
        raise MampcError(f"new: expected a file that does not exist yet, received {path}")
    text = template() if model is None else _own_study(path, model)
    with written_whole(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    console_for_tables().print(
        f"Wrote {path}; edit it, then run: mampc run {shlex.quote(str(path))}", soft_wrap=True, markup=False
    )


def _own_study(path: Path, model: Path) -> str:
    """The text of a study at a path, of a model file that it names relative to its folder where it can."""
    from mampc.study import parse_study
    from mampc.study.own import own_study
    from mampc.systems.state_space import StateSpace

    loaded = StateSpace.load(model)
    folder, place = path.resolve().parent, model.resolve()
    inside = place.is_relative_to(folder)
    file = place.relative_to(folder).as_posix() if inside else str(place)
    try:
        with progress() as show:
            text = own_study(loaded, file, path.stem[:80], show)
    except MampcError as error:
        raise MampcError(f"{model}: {error}") from None
    parse_study(text, str(path), folder=folder)
    return text
