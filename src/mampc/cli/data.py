"""Commands about records and models: `inspect`, `identify`, `show`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mampc.base.errors import MampcError
from mampc.cli.app import app
from mampc.cli.console import complain, console_for_tables, print_list, progress
from mampc.cli.numbers import words
from mampc.cli.reading import reads_exports

Inputs = Annotated[
    str, typer.Option(help="Input columns, separated by commas; a name with a comma in quotation marks.")
]
Outputs = Annotated[str, typer.Option(help="Output columns, separated by commas.")]
Disturbances = Annotated[str, typer.Option(help="Columns of inputs that are measured and not manipulated.")]


@app.command()
@reads_exports
def inspect(
    export: Annotated[Path, typer.Argument(help="CSV, Excel, Parquet or JSON file.")],
    inputs: Inputs = "",
    outputs: Outputs = "",
    disturbances: Disturbances = "",
    *,
    reading: dict[str, Any],
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

    reading |= _columns(inputs, outputs, disturbances)
    target = export.parent / f"{export.stem}-columns.png" if out is None else out
    with progress() as show:
        show("reading the file")
        seen = inspect_export(export, **reading)
        missing = None
        try:
            if seen.columns:
                show("drawing its columns")
                save_figure(inspection_figure(seen), target.with_suffix(""))
        except MampcError as error:
            missing = str(error)
    console = console_for_tables()
    if seen.columns:
        console.print(inspection_table(seen))
    for line in inspection_words(seen):
        console.print(line, soft_wrap=True, markup=False)
    for title, sentences in (
        ("Noticed", seen.notes),
        ("Missing in the movement of inputs", seen.excitation),
        ("To decide before a model can be identified", seen.doubts),
    ):
        print_list(console, title, sentences)
    if missing is not None:
        complain(f"note: no figure written; {missing}")
    elif seen.columns:
        console.print(f"Wrote {target.with_suffix('.png')} and .svg", soft_wrap=True, markup=False)


@app.command()
@reads_exports
def identify(
    exports: Annotated[list[Path], typer.Argument(help="CSV, Excel, Parquet or JSON files of one plant.")],
    inputs: Inputs,
    outputs: Outputs,
    disturbances: Disturbances = "",
    *,
    reading: dict[str, Any],
    order: Annotated[int | None, typer.Option(help="Model order; default from the singular values.")] = None,
    weighting: Annotated[str, typer.Option(help="cva, n4sid or moesp.")] = "cva",
    block_rows: Annotated[
        int | None, typer.Option(help="Samples of past and future; default from the record.")
    ] = None,
    feedthrough: Annotated[
        bool, typer.Option(help="Estimate D: inputs that show in the outputs within their own sample.")
    ] = False,
    detrend: Annotated[
        str,
        typer.Option(
            help="none, constant, linear, differences or whitened; auto takes what predicts held-out data best."
        ),
    ] = "auto",
    share: Annotated[
        float, typer.Option(help="Part of the record to estimate on; the rest validates.", show_default="2/3")
    ] = 2 / 3,
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
    reading |= _columns(inputs, outputs, disturbances)
    settings = {
        "order": order, "weighting": weighting, "block_rows": block_rows, "feedthrough": feedthrough,
        "detrend": detrend,
    }  # fmt: skip
    with progress() as show:
        outcome = identify_and_write(exports, target, show, reading=reading, settings=settings, share=share)
    console = console_for_tables()
    print_list(console, "Noticed in the export", outcome.notes)
    if len(outcome.records) > 1:
        lengths = ", ".join(map(str, outcome.records[:8])) + (", ..." if len(outcome.records) > 8 else "")
        console.print(f"Estimated on {len(outcome.records)} pieces of {lengths} samples", soft_wrap=True)
    console.print(fit_table(outcome))
    console.print(f"Order {outcome.order}", soft_wrap=True)
    print_list(console, "Found and decided", outcome.found)
    for warning in outcome.warnings:
        complain(f"warning: {warning}")
    console.print(f"Wrote {target}", soft_wrap=True, markup=False)


@app.command()
def show(
    model: Annotated[Path, typer.Argument(help="A model file, such as `mampc identify` writes.")],
    figure: Annotated[
        Path | None,
        typer.Option("--figure", "-f", help="Draw the step responses (PNG and SVG of this name)."),
    ] = None,
) -> None:
    """What a model says of its plant.

    Gains with their uncertainty where it is known, time constants, dead times, integrators, interaction of
    inputs and outputs, zeros that limit control, noise.

    Example:

        mampc show model.json --figure steps.png
    """
    from mampc.report.output import save_figure
    from mampc.report.showing import model_tables, model_words
    from mampc.systems.state_space import StateSpace

    shown = StateSpace.load(model)
    console = console_for_tables()
    console.print(repr(shown), soft_wrap=True, markup=False)
    if not shown.is_discrete:
        raise MampcError(f"{model}: expected a discrete model, received one in continuous time")
    for table in model_tables(shown):
        console.print(table)
    for sentence in model_words(shown):
        console.print(f"  - {sentence}", soft_wrap=True, markup=False)
    if figure is not None:
        save_figure(shown.plot(), figure.with_suffix(""))
        console.print(f"Wrote {figure.with_suffix('.png')} and .svg", soft_wrap=True, markup=False)


def _columns(inputs: str, outputs: str, disturbances: str) -> dict[str, list[str]]:
    return {"inputs": words(inputs), "outputs": words(outputs), "disturbances": words(disturbances)}
