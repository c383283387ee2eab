"""The command line: `mampc run`, `replay`, `reproduce`, `new`, `identify`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
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
POOR_FIT = 40.0  # percent; a model below it is hardly one to control with


def main() -> None:
    """Run the command line; complaints go to standard error and exit with 2."""
    try:
        app()
    except MampcError as error:
        Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(f"mampc: {error}")
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


@app.command()
def identify(
    data: Annotated[Path, typer.Argument(help="CSV file with a header row.")],
    inputs: Annotated[str, typer.Option(help="Input columns, separated by commas.")],
    outputs: Annotated[str, typer.Option(help="Output columns, separated by commas.")],
    dt: Annotated[
        float | None, typer.Option(help="Sample time in seconds; default from a column named time.")
    ] = None,
    disturbances: Annotated[
        str, typer.Option(help="Columns of inputs that are measured and not manipulated.")
    ] = "",
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
        Path | None, typer.Option("--out", "-o", help="Model file; default the data file's name with .json.")
    ] = None,
) -> None:
    """Identify a model from plant data, validate it on the part it has not seen, write it to a file.

    Writes the model file and a validation figure (PNG, SVG) of the same name. Use the file in a study
    with a table [model] and file = "NAME.json".

    Example:

        mampc identify data.csv --inputs u1,u2 --outputs y1,y2 --dt 10
    """
    from mampc.identification import IOData, n4sid
    from mampc.report.figures import validation_figure
    from mampc.report.output import save_figure

    target = data.with_suffix(".json") if out is None else out
    if not target.parent.is_dir():
        raise MampcError(f"--out: expected a file in a folder that exists, received {target}")
    if target.exists() and not _is_model(target):
        raise MampcError(
            f"--out: expected a new file or a model to replace, received {target}, which is neither"
        )
    if target.suffix != ".json":
        raise MampcError(f"--out: expected a name that ends in .json, received {target}")
    with _progress() as show:
        show("reading the record")
        record = IOData.from_csv(
            data, inputs=_words(inputs), outputs=_words(outputs), disturbances=_words(disturbances), dt=dt
        )
        estimation, rest = record.split(share)
        show("identifying a model")
        identified = n4sid(
            estimation, order=order, weighting=weighting, block_rows=block_rows, feedthrough=feedthrough
        )
        validation = identified.validate(rest)
        show("writing the model and its figure")
        identified.model.save(target)
        missing = None
        try:
            save_figure(validation_figure(rest, validation), target.with_suffix(""))
        except MampcError as error:
            missing = str(error)
    console = _console()
    console.print(_fit_table(record.names.outputs, identified.fit, validation))
    values = " ".join(f"{value:.3g}" for value in identified.singular_values[:8])
    console.print(f"Order {identified.order}; first singular values {values}", soft_wrap=True)
    if identified.integrators:
        console.print(
            f"{identified.integrators} of its poles integrate: they are exactly one", soft_wrap=True
        )
    if identified.stabilised:
        _complain(
            "warning: poles outside the unit circle were mirrored to its inside; check the record for drifts"
        )
    poor = [
        name for name, fit in zip(record.names.outputs, validation.fit, strict=True) if not fit > POOR_FIT
    ]
    if poor:
        _complain(
            f"warning: the model explains less than {POOR_FIT:g} % of {', '.join(poor)} on the hold-out part; look at "
            "the figure, and try another --order, more --block-rows for long delays, or a richer record"
        )
    if missing is not None:
        _complain(f"note: no figure written; {missing}")
    console.print(f"Wrote {target}", soft_wrap=True, markup=False)


def _is_model(path: Path) -> bool:
    from mampc.systems.state_space import StateSpace

    try:
        StateSpace.load(path)
    except MampcError:
        return False
    return True


def _fit_table(outputs: tuple[str, ...], fit: Any, validation: Any) -> Any:
    from rich.markup import escape
    from rich.table import Table

    table = Table()
    table.add_column("output")
    for header in ("fit, estimation part (%)", "fit, hold-out part (%)", "whiteness of residuals (p)"):
        table.add_column(header, justify="right")
    for name, on_own, on_rest, p in zip(outputs, fit, validation.fit, validation.whiteness, strict=True):
        table.add_row(escape(name), f"{on_own:.1f}", f"{on_rest:.1f}", f"{p:.3f}")
    return table


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


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
