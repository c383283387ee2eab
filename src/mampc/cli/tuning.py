"""The command `tune`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from mampc.base.errors import MampcError, shown
from mampc.cli.app import app
from mampc.cli.console import bar, complain, console_for_tables, progress
from mampc.cli.numbers import number, row
from mampc.cli.options import Jobs, Trust

LARGEST_INCREASE = 10.0  # of the error; more is a percentage without its sign


@app.command()
def tune(
    source: Annotated[str, typer.Argument(help="A built-in study, a TOML file, or a model file (.json).")],
    max_error_increase: Annotated[
        str | None, typer.Option(help="Over the error of plain MPC, such as 25% or 0.25; default 25%.")
    ] = None,
    max_moves_per_hour: Annotated[
        float | None,
        typer.Option(help="Of all inputs of the plant together, in place of an error: 2.5 for 60 a day."),
    ] = None,
    u_min: Annotated[
        str | None, typer.Option(help="Of a model file: lower limits of the inputs, one or 0,0,...")
    ] = None,
    u_max: Annotated[str | None, typer.Option(help="Of a model file: upper limits of the inputs.")] = None,
    controller: Annotated[
        str | None,
        typer.Option(
            "--controller",
            "-c",
            help="Of a study: whose rules hold at any price; default what all say of the actuators (min_size, dwell, "
            "levels).",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results; default results/NAME-tuned.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal results.")] = 0,
    jobs: Jobs = -1,
    trust: Trust = False,
) -> None:
    """Which controller moves least often at the error that you allow? Give one number.

    Tries out move weights, tails and prices on stand-ins for the plant, off its model by up to 15 % in gains, lags and
    dead times, with set-point changes and loads of every kind. The promise is a mean over these scenarios with its
    standard error, not one for a single run. Moves are counted over all inputs together. Where an actuator may start
    only so often, give it a rule that always holds: levels with starts_per_hour, or dwell, in the study.

    Writes a study to run (tuned.toml), the model, the front of moves against error, and report.html, one page in which
    the front can be clicked.

    Examples:

        mampc tune quadruple-tank --max-error-increase 25%

        mampc tune my-study.toml --max-moves-per-hour 2.5 --out results/60-a-day

        mampc tune model.json --u-min 0 --u-max 100,80
    """
    from mampc.base.files import made_folder
    from mampc.compare.tuned_study import study_of_model, told_by, with_tuning
    from mampc.compare.tuning import tune as search
    from mampc.report.tuning import STUDY_FILE, told, tuning_table, write_tuning
    from mampc.report.tuning_page import write_tuning_page
    from mampc.study.running import prepare

    if max_error_increase is not None and max_moves_per_hour is not None:
        raise MampcError("tune: expected one of --max-error-increase and --max-moves-per-hour, received both")
    allowed = None if max_moves_per_hour is not None else _share(max_error_increase or "25%")
    wanted = (
        f"at most {max_moves_per_hour:g} moves of all inputs together per hour"
        if allowed is None
        else f"an error of at most {1 + allowed:g} times that of "
    )
    goal: dict[str, Any] = {"max_error_increase": allowed, "max_moves_per_hour": max_moves_per_hour}
    folder = Path("results") / f"{Path(source).stem}-tuned" if out is None else out
    study = None
    if Path(source).suffix == ".json":
        from mampc.compare.scenarios import even_weight
        from mampc.program.problem import Limits
        from mampc.systems.state_space import StateSpace

        if u_min is None or u_max is None:
            raise MampcError(
                "tune: expected --u-min and --u-max with a model file, which has no limits: those of the actuators, in "
                "the model's units; received one or none of them"
            )
        if controller is not None:
            raise MampcError("tune: expected --controller with a study only; a model file has none")
        model = StateSpace.load(source)
        limits = Limits(u_min=row("--u-min", u_min), u_max=row("--u-max", u_max))
        given: dict[str, Any] = {"limits": limits, "output_weight": even_weight(model, limits)}
    else:
        from mampc.study import load_study

        if u_min is not None or u_max is not None:
            raise MampcError("tune: expected --u-min and --u-max with a model file only; a study has limits")
        study = load_study(source, trust=True if trust else None)
        with progress() as show:
            prepared = prepare(study, show)
        model, given = prepared.model, told_by(study, prepared, controller)
    made_folder(folder)  # what cannot be written is said before the work
    with bar(source, "closed loops") as tell:
        tuned = search(model, **goal, **given, seed=seed, jobs=jobs, progress=False, on_task=tell)
    wanted += "" if allowed is None else tuned.expected.beside
    base = study_of_model(model, tuned, Path(source).stem[:80]) if study is None else study
    written = with_tuning(base, tuned)
    notes = [write_tuning(tuned, written, folder, wanted, None if allowed is None else 1 + allowed)]
    try:
        with bar("report.html", "runs") as tell:
            by_scenario = study is None or given["loads"] is not None
            write_tuning_page(
                tuned, written, folder, told(tuned, wanted), by_scenario=by_scenario, on_run=tell
            )
    except MampcError as error:
        notes.append(f"no report.html written; {error}")
    console = console_for_tables()
    if tuned.front:
        console.print(tuning_table(tuned))
    console.print(told(tuned, wanted), soft_wrap=True, markup=False)
    for caution in tuned.cautions:
        complain(f"warning: {caution}")
    for note in filter(None, notes):
        complain(f"note: {note}")
    if ":" in base.plant.kind:
        complain(
            f"note: {STUDY_FILE} names the plant {base.plant.kind}; put it beside its module, with its model"
        )
    console.print(
        f"Results are in {folder}; next: mampc run {shlex.quote(str(folder / STUDY_FILE))}",
        soft_wrap=True,
        markup=False,
    )


def _share(text: str) -> float:
    """25% or 0.25 as a number; above 1 only with its sign, since 5 for 5 % is a slip."""
    expected = "a share above 0, such as 25% or 0.25"
    share = number("--max-error-increase", text, expected)
    signed = text.strip().endswith("%")
    if not 0 < share <= LARGEST_INCREASE:
        expected += f", here {text.strip()}%" if not signed and 1 < share <= 100 * LARGEST_INCREASE else ""
        raise MampcError(f"--max-error-increase: expected {expected}, received {shown(text)}")
    if share > 1 and not signed:
        raise MampcError(
            f"--max-error-increase: expected {text.strip()}% or {100 * share:g}%, received {shown(text)}, which "
            "could be either"
        )
    return share
