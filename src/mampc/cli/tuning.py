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
        str | None, typer.Option(help="Over the error of plain MPC, such as 25% or 0.25; the default is 25%.")
    ] = None,
    max_moves_per_hour: Annotated[
        float | None, typer.Option(help="Of all inputs together, in place of an error.")
    ] = None,
    u_min: Annotated[
        str | None, typer.Option(help="Of a model file: lower limits of the inputs, one or 0,0,...")
    ] = None,
    u_max: Annotated[str | None, typer.Option(help="Of a model file: upper limits of the inputs.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results; default results/NAME-tuned.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal results.")] = 0,
    jobs: Jobs = -1,
    trust: Trust = False,
) -> None:
    """Which controller moves least often at the error that you allow? Give one number.

    Tries out estimators, move weights, tails and prices on stand-ins for the plant, off its model in gains, lags and
    dead times, under loads of every kind. The promise is a mean over scenarios with its standard error, not one for a
    single run. Writes a study to run (tuned.toml), the model and the front of moves against error.

    Examples:

        mampc tune quadruple-tank --max-error-increase 25%

        mampc tune my-study.toml --max-moves-per-hour 60 --out results/calm

        mampc tune model.json --u-min 0 --u-max 100,80
    """
    from mampc.base.files import made_folder
    from mampc.compare.tuned_study import study_of_model, told_by, with_tuning
    from mampc.compare.tuning import tune as search
    from mampc.report.tuning import STUDY_FILE, told, tuning_table, write_tuning
    from mampc.study.running import prepare

    if max_error_increase is not None and max_moves_per_hour is not None:
        raise MampcError("tune: expected one of --max-error-increase and --max-moves-per-hour, received both")
    allowed = None if max_moves_per_hour is not None else _share(max_error_increase or "25%")
    wanted = (
        f"at most {max_moves_per_hour:g} moves per hour"
        if allowed is None
        else f"an error of at most {1 + allowed:g} times that of plain MPC"
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
                "tune: expected --u-min and --u-max with a model file, received one or none of them"
            )
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
        model, given = prepared.model, told_by(study, prepared)
    made_folder(folder)  # what cannot be written is said before the work
    with bar(source, "closed loops") as tell:
        tuned = search(model, **goal, **given, seed=seed, jobs=jobs, progress=False, on_task=tell)
    base = study_of_model(model, tuned, Path(source).stem[:80]) if study is None else study
    note = write_tuning(
        tuned, with_tuning(base, tuned), folder, wanted, None if allowed is None else 1 + allowed
    )
    console = console_for_tables()
    if tuned.front:
        console.print(tuning_table(tuned))
    console.print(told(tuned, wanted), soft_wrap=True, markup=False)
    if note is not None:
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
    """25% or 0.25 as a number."""
    expected = "a share such as 25% or 0.25"
    share = number("--max-error-increase", text, expected)
    if not 0 < share <= LARGEST_INCREASE:
        raise MampcError(f"--max-error-increase: expected {expected}, received {shown(text)}")
    return share
