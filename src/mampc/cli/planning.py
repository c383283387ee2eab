"""The command `plan-test`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from mampc.base.errors import MampcError
from mampc.cli.app import app
from mampc.cli.console import console_for_tables, print_list
from mampc.cli.numbers import matrix, number, row, words


@app.command(name="plan-test")
def plan_test(
    signal: Annotated[Path, typer.Argument(help="CSV file to write: times and inputs.")],
    gain: Annotated[
        str | None,
        typer.Option(
            help="First guess, a row an output: '2.5', or '12.8,-18.9; 6.6,-19.4'; 0 for no effect."
        ),
    ] = None,
    settling_time: Annotated[
        str | None, typer.Option(help="Until outputs have settled, such as '40 min'; one, or as the gains.")
    ] = None,
    noise: Annotated[
        str | None, typer.Option(help="Standard deviation of each output's noise: 0.1 or 0.1,0.2.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", "-m", help="A model file that says all this, from a poor record."),
    ] = None,
    inputs: Annotated[str, typer.Option(help="Names of the inputs, separated by commas.")] = "",
    outputs: Annotated[str, typer.Option(help="Names of the outputs.")] = "",
    dead_time: Annotated[str | None, typer.Option(help="Such as '90 s'; one, or as the gains.")] = None,
    integrating: Annotated[
        bool, typer.Option(help="All gains are per second, of outputs that integrate.")
    ] = False,
    around: Annotated[str | None, typer.Option(help="Levels about which inputs move: 50 or 50,40.")] = None,
    max_amplitude: Annotated[
        str | None,
        typer.Option(help="Largest amplitude of each input; the test becomes longer where it must."),
    ] = None,
    accuracy: Annotated[
        str, typer.Option(help="Two standard deviations of the gains asked for, as a share of them.")
    ] = "5%",
    dt: Annotated[
        str | None, typer.Option(help="Sample time, such as '10 s'; default from the settling time.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal signals.")] = 0,
) -> None:
    """Plan a test of a plant: how far to move each input, how often, and for how long.

    From a first guess of gains, settling time and noise, off by a factor of two at worst. Writes the inputs to a file
    to play to the plant, and says how certain the gains will be and how far outputs will move.

    Examples:

        mampc plan-test test.csv --gain 2.5 --settling-time "40 min" --noise 0.1 --around 50

        mampc plan-test test.csv --gain "12.8,-18.9; 6.6,-19.4" --settling-time "1.5 h" --noise 0.1 --max-amplitude 0.05

        mampc plan-test test.csv --model tank.json
    """
    from mampc.base.names import Names
    from mampc.identification.plant_test import first_guess, hold_in_words
    from mampc.identification.plant_test import plan_test as plan
    from mampc.report.planning import plan_tables
    from mampc.systems.state_space import StateSpace

    if signal.suffix != ".csv":
        raise MampcError(f"expected a name that ends in .csv, received {signal}")
    given: dict[str, Any] = {} if model is None else first_guess(StateSpace.load(model))
    told = {
        "gain": matrix("--gain", gain), "settling_time": matrix("--settling-time", settling_time),
        "noise": row("--noise", noise), "dead_time": matrix("--dead-time", dead_time),
        "around": row("--around", around), "max_amplitude": row("--max-amplitude", max_amplitude),
        "dt": None if dt is None else number("--dt", dt), "integrating": integrating or None,
        "accuracy": number("--accuracy", accuracy),
    }  # fmt: skip
    if "dt" in given and dt is not None:
        given["wandering"] = given["wandering"] * (told["dt"] / given["dt"]) ** 0.5
    given |= {name: value for name, value in told.items() if value is not None}
    missing = [name for name in ("gain", "settling_time", "noise") if name not in given]
    if missing:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in missing)
        raise MampcError(f"plan-test: expected {options}, or a model that says so (--model)")
    if inputs or outputs:
        given["names"] = Names(tuple(words(inputs)), tuple(words(outputs)))
    planned = plan(**given, seed=seed)
    planned.to_csv(signal)
    console = console_for_tables()
    for table in plan_tables(planned):
        console.print(table)
    console.print(hold_in_words(planned), soft_wrap=True, markup=False)
    print_list(console, "Note", planned.notes)
    console.print(f"Wrote {signal}", soft_wrap=True, markup=False)
