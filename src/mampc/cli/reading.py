"""Options of all commands that read exports: how the files are read."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Annotated, Any

import typer

from mampc.base.errors import MampcError
from mampc.cli.numbers import words

PANEL = "How files are read"


def reading_options(
    dt: Annotated[
        float | None, typer.Option("--dt", help="Sample time in seconds, where no column tells it.")
    ] = None,
    time: Annotated[str | None, typer.Option("--time", help="Column of times; default found.")] = None,
    time_unit: Annotated[
        str | None, typer.Option(help="Of times that are numbers: ns, us, ms, s, min, h or d.")
    ] = None,
    time_format: Annotated[
        str | None, typer.Option(help="Of time stamps, as strptime has it, such as '%d/%m/%Y %H:%M'.")
    ] = None,
    time_zone: Annotated[
        str | None, typer.Option(help="Of local time stamps, such as Europe/Berlin.")
    ] = None,
    decimal: Annotated[str | None, typer.Option(help="Decimal mark, . or , where it is in doubt.")] = None,
    encoding: Annotated[
        str | None, typer.Option(help="Of a text that is not UTF-8, such as cp932; default Windows-1252.")
    ] = None,
    bad: Annotated[
        list[str] | None,
        typer.Option(help="A further word or number in place of a missing value; repeat it."),
    ] = None,
    good: Annotated[
        list[str] | None, typer.Option(help="A word of quality columns for a good value; repeat it.")
    ] = None,
    no_quality: Annotated[
        list[str] | None,
        typer.Option(help="Columns that say nothing of others though they are called so."),
    ] = None,
    ranges: Annotated[
        list[str] | None,
        typer.Option("--range", help="Lowest and highest believable value, COLUMN=LOW:HIGH; repeat it."),
    ] = None,
    fill: Annotated[
        int,
        typer.Option(
            help="Make up as many samples in a row where they are missing: inputs held, outputs on lines."
        ),
    ] = 0,
    on_change: Annotated[
        list[str] | None,
        typer.Option(help="Columns that are stored only when they change: their last value holds."),
    ] = None,
) -> dict[str, Any]:
    """These options as arguments of `read_export`."""
    return {
        "dt": dt, "time": time, "time_unit": time_unit, "time_format": time_format, "time_zone": time_zone,
        "decimal": decimal, "encoding": encoding, "bad": bad or (), "good": good or (),
        "no_quality": _names(no_quality), "ranges": dict(map(_range, ranges or ())), "fill": fill,
        "on_change": _names(on_change),
    }  # fmt: skip


def reads_exports(command: Callable[..., None]) -> Callable[..., None]:
    """A command with the options above, which it receives as `reading`."""
    options = signature(reading_options, eval_str=True).parameters
    own = signature(command, eval_str=True)
    for option in options.values():
        option.annotation.__metadata__[0].rich_help_panel = PANEL

    @wraps(command)
    def called(**given: Any) -> None:
        reading = reading_options(**{name: given.pop(name) for name in options})
        command(**given, reading=reading)

    shown = [one for one in (*own.parameters.values(), *options.values()) if one.name != "reading"]
    keywords = [one.replace(kind=Parameter.KEYWORD_ONLY) for one in shown]
    called.__signature__ = own.replace(parameters=keywords)  # type: ignore[attr-defined]
    called.__annotations__ = {one.name: one.annotation for one in shown}
    return called


def _names(texts: list[str] | None) -> tuple[str, ...]:
    return tuple(name for text in texts or () for name in words(text))


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, _, values = text.rpartition("=")
    low, _, high = values.partition(":")
    try:
        return name.strip(), (float(low), float(high))
    except ValueError:
        raise MampcError(f"--range: expected COLUMN=LOW:HIGH, received {text!r}") from None
