"""The command line: `mampc run`, `replay`, `reproduce`, `new`, `inspect`, `identify`."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from mampc.base.errors import MampcError

app = typer.Typer(
    name="mampc",
    help="Minimum-attention model predictive control: track references with few actuator moves.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_NARROW = 125  # columns of a table that is not on a terminal


def main() -> None:
    """Run the command line; complaints go to standard error and exit with 2."""
    try:
        app()
    except (MampcError, OSError) as error:  # OSError: such as a name longer than any file's
        expected = (
            "" if isinstance(error, MampcError) else "expected a file or folder that can be used, received: "
        )
        Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(f"mampc: {expected}{error}")
        sys.exit(2)
    except KeyboardInterrupt:
        print("mampc: interrupted; what had finished is written", file=sys.stderr)
        sys.exit(130)


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        import mampc

        print(f"mampc {mampc.__version__}")
        raise typer.Exit


@app.command()
def run(
    study: Annotated[str, typer.Argument(help="A built-in study (quadruple-tank, sofc) or a TOML file.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results; default results/NAME.")
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Allow a study from elsewhere to import its plant (module:Class).")
    ] = False,
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
    with _progress() as show:
        result, summary, missing = run_and_write(plan, directory, show)
    console = _console()
    for table in comparison_tables(plan, summary):
        console.print(table)
        console.print()
    for warning in result.warnings:
        _complain(f"warning: {warning}")
    for note in missing:
        _complain(f"note: {note}")
    console.print(f"Results are in {directory}", soft_wrap=True, markup=False)


@app.command()
def replay(
    run: Annotated[
        Path, typer.Argument(help="A trajectory that `mampc run` wrote, SCENARIO_CONTROLLER.csv.")
    ],
    study: Annotated[
        str, typer.Option("--study", "-s", help="The study it came from: a name or a TOML file.")
    ],
    tolerance: Annotated[
        float, typer.Option(help="Of inputs and objectives, relative to their size; 0 for the same bits.")
    ] = 1e-9,
    trust: Annotated[
        bool, typer.Option("--trust", help="Allow a study from elsewhere to import its plant (module:Class).")
    ] = False,
) -> None:
    """Decide again on the recorded measurements of a run, and find the first decision that differs.

    The model is the model.json beside the run, if there is one, else it is identified again. Exits with 0 if
    every decision comes out as recorded, with 1 if one differs.

    Example:

        mampc replay results/quadruple-tank/noisy_exact-price.csv --study quadruple-tank
    """
    from mampc.report.replaying import replay_trajectory
    from mampc.study import load_study

    plan = load_study(study, trust=True if trust else None)
    with _progress() as show:
        samples, difference = replay_trajectory(run, plan, tolerance, show)
    if difference is not None:
        _console().print(f"{run}: the first difference is at {difference}", soft_wrap=True, markup=False)
        raise typer.Exit(1)
    _console().print(f"{run}: all {samples} decisions come out as recorded", soft_wrap=True, markup=False)


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

    with _progress() as show:
        cases = run_all(out, show)
    console = _console()
    for case in cases:
        for table in comparison_tables(case.study, case.summary):
            console.print(table)
            console.print()
        for warning in case.result.warnings:
            _complain(f"warning: {warning}")
    console.print(f"Open {out / 'report.html'}", soft_wrap=True)


@app.command()
def new(path: Annotated[Path, typer.Argument(help="File to write; must not exist yet.")]) -> None:
    """Write a commented study to start your own from.

    Example:

        mampc new my-study.toml && mampc run my-study.toml
    """
    from mampc.study import template

    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(template())
    except FileExistsError:
        raise MampcError(f"new: expected a file that does not exist yet, received {path}") from None
    except OSError as error:
        raise MampcError(f"new: expected a file that can be written, received: {error}") from None
    _console().print(f"Wrote {path}; edit it, then run: mampc run {path}", soft_wrap=True)


Inputs = Annotated[str, typer.Option(help="Input columns, separated by commas.")]
Outputs = Annotated[str, typer.Option(help="Output columns, separated by commas.")]
Disturbances = Annotated[str, typer.Option(help="Columns of inputs that are measured and not manipulated.")]
SampleTime = Annotated[
    float | None, typer.Option("--dt", help="Sample time in seconds, where no column tells it.")
]
TimeColumn = Annotated[str | None, typer.Option("--time", help="Column of times; default found.")]
TimeUnit = Annotated[str | None, typer.Option(help="Of times that are numbers: ms, s, min, h or d.")]
TimeFormat = Annotated[
    str | None, typer.Option(help="Of time stamps, as strptime has it, such as '%d/%m/%Y %H:%M'.")
]
TimeZone = Annotated[str | None, typer.Option(help="Of local time stamps, such as Europe/Berlin.")]
Decimal = Annotated[str | None, typer.Option(help="Decimal mark, . or , where it is in doubt.")]
Bad = Annotated[
    list[str] | None, typer.Option(help="A further word or number in place of a missing value; repeat it.")
]
Good = Annotated[
    list[str] | None, typer.Option(help="A word of quality columns for a good value; repeat it.")
]
Ranges = Annotated[
    list[str] | None,
    typer.Option("--range", help="Lowest and highest believable value, COLUMN=LOW:HIGH; repeat it."),
]


@app.command()
def inspect(
    export: Annotated[Path, typer.Argument(help="CSV, Excel or Parquet file.")],
    inputs: Inputs = "",
    outputs: Outputs = "",
    disturbances: Disturbances = "",
    dt: SampleTime = None,
    time: TimeColumn = None,
    time_unit: TimeUnit = None,
    time_format: TimeFormat = None,
    time_zone: TimeZone = None,
    decimal: Decimal = None,
    bad: Bad = None,
    good: Good = None,
    ranges: Ranges = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Picture; default NAME-columns.png beside the file.")
    ] = None,
) -> None:
    """Look at an export before anything is identified from it.

    Shows columns, units, span, gaps and bad values, which columns move enough to be inputs, what excitation is
    missing, and what has to be decided first; draws every column over time (PNG, SVG).

    Examples:

        mampc inspect export.csv

        mampc inspect export.csv --inputs FIC-1.OP --outputs TI-3 --range TI-3=0:200 --out look.png
    """
    from mampc.identification.export import inspect_export
    from mampc.report.inspecting import inspection_figure, inspection_table, inspection_words
    from mampc.report.output import save_figure

    reading = _reading(
        inputs, outputs, disturbances, ranges, bad, good, dt=dt,
        time=time, time_unit=time_unit, time_format=time_format, time_zone=time_zone, decimal=decimal,
    )  # fmt: skip
    target = export.parent / f"{export.stem}-columns.png" if out is None else out
    with _progress() as show:
        show("reading the file")
        seen = inspect_export(export, **reading)
        missing = None
        try:
            if seen.columns:
                show("drawing its columns")
                save_figure(inspection_figure(seen), target.with_suffix(""))
        except MampcError as error:
            missing = str(error)
    console = _console()
    if seen.columns:
        console.print(inspection_table(seen))
    for line in inspection_words(seen):
        console.print(line, soft_wrap=True, markup=False)
    for title, sentences in (
        ("Noticed", seen.notes),
        ("Missing in the movement of inputs", seen.excitation),
        ("To decide before a model can be identified", seen.doubts),
    ):
        _print_list(console, title, sentences)
    if missing is not None:
        _complain(f"note: no figure written; {missing}")
    elif seen.columns:
        console.print(f"Wrote {target.with_suffix('.png')} and .svg", soft_wrap=True, markup=False)


@app.command()
def identify(
    exports: Annotated[list[Path], typer.Argument(help="CSV, Excel or Parquet files of one plant.")],
    inputs: Inputs,
    outputs: Outputs,
    dt: SampleTime = None,
    disturbances: Disturbances = "",
    time: TimeColumn = None,
    time_unit: TimeUnit = None,
    time_format: TimeFormat = None,
    time_zone: TimeZone = None,
    decimal: Decimal = None,
    bad: Bad = None,
    good: Good = None,
    ranges: Ranges = None,
    order: Annotated[int | None, typer.Option(help="Model order; default from the singular values.")] = None,
    weighting: Annotated[str, typer.Option(help="cva, n4sid or moesp.")] = "cva",
    block_rows: Annotated[
        int | None, typer.Option(help="Samples of past and future; more than the longest delay.")
    ] = None,
    feedthrough: Annotated[
        bool, typer.Option(help="Estimate D: inputs that show in the outputs within their own sample.")
    ] = False,
    share: Annotated[float, typer.Option(help="Part of the record to estimate on; the rest validates.")] = 2
    / 3,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Model file; default the first file's name with .json.")
    ] = None,
) -> None:
    """Identify a model from plant data, validate it on the part it has not seen, write it to a file.

    Reads exports as `mampc inspect` shows them; gaps split them into several records. Writes the model file and a
    validation figure (PNG, SVG) of the same name. Use the file in a study with a table [model] and
    file = "NAME.json".

    Examples:

        mampc identify data.csv --inputs u1,u2 --outputs y1,y2

        mampc identify may.xlsx june.xlsx --inputs FIC-1.OP --outputs TI-3 --bad "Intf Shut" --out column.json
    """
    from mampc.report.identifying import fit_table, identify_and_write

    target = exports[0].parent / f"{exports[0].stem}.json" if out is None else out
    reading = _reading(
        inputs, outputs, disturbances, ranges, bad, good, dt=dt,
        time=time, time_unit=time_unit, time_format=time_format, time_zone=time_zone, decimal=decimal,
    )  # fmt: skip
    settings = {
        "order": order, "weighting": weighting, "block_rows": block_rows, "feedthrough": feedthrough,
    }  # fmt: skip
    with _progress() as show:
        outcome = identify_and_write(
            exports,
            target,
            show,
            reading=reading,
            settings=settings,
            share=share,
        )
    console = _console()
    identified = outcome.identified
    _print_list(console, "Noticed in the export", outcome.notes)
    if len(outcome.records) > 1:
        lengths = ", ".join(map(str, outcome.records[:8])) + (", ..." if len(outcome.records) > 8 else "")
        console.print(f"Estimated on {len(outcome.records)} pieces of {lengths} samples", soft_wrap=True)
    console.print(fit_table(outcome))
    values = " ".join(f"{value:.3g}" for value in identified.singular_values[:8])
    console.print(f"Order {identified.order}; first singular values {values}", soft_wrap=True)
    if identified.integrators:
        console.print(
            f"{identified.integrators} of its poles integrate: they are exactly one", soft_wrap=True
        )
    for warning in outcome.warnings:
        _complain(f"warning: {warning}")
    console.print(f"Wrote {target}", soft_wrap=True, markup=False)


def _reading(
    inputs: str, outputs: str, disturbances: str, ranges: list[str] | None, bad: list[str] | None,
    good: list[str] | None, **plain: Any,
) -> dict[str, Any]:  # fmt: skip
    """The arguments of `read_export`, out of those of the command line."""
    words = {"inputs": _words(inputs), "outputs": _words(outputs), "disturbances": _words(disturbances)}
    limits = {}
    for text in ranges or ():
        name, _, values = text.rpartition("=")
        low, _, high = values.partition(":")
        try:
            limits[name.strip()] = (float(low), float(high))
        except ValueError:
            raise MampcError(f"--range: expected COLUMN=LOW:HIGH, received {text!r}") from None
    return words | plain | {"bad": bad or (), "good": good or (), "ranges": limits}


def _print_list(console: Console, title: str, sentences: Sequence[str]) -> None:
    if sentences:
        console.print(f"{title}:", markup=False)
        for sentence in sentences:
            console.print(f"  - {sentence}", soft_wrap=True, markup=False)


def _words(text: str) -> list[str]:
    """Words between commas; one that holds a comma stands in quotation marks."""
    return [word.strip() for row in csv.reader([text], skipinitialspace=True) for word in row if word.strip()]


def _console() -> Console:
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=max(_NARROW, console.width))
    return console


def _complain(message: str) -> None:
    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(message)


@contextmanager
def _progress() -> Iterator[Any]:
    """A function that shows the current stage: a spinner on a terminal, a line each elsewhere."""
    console = Console(stderr=True, highlight=False, markup=False)
    if not console.is_terminal:
        yield lambda stage: None if stage.startswith(("figure", "report.html")) else _complain(f"{stage} ...")
        return
    with console.status("") as status:
        yield lambda stage: status.update(f"{stage} ...")
