"""The command `mampc`: its options, and how it ends."""

from __future__ import annotations

import io
import signal
import sys
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


class Interrupted(BaseException):
    """Ctrl-C, under a name that no library on the way takes for its own."""


def _interrupt(*_: Any) -> None:
    raise Interrupted


def main() -> None:
    """Run the command line; complaints go to standard error and exit with 2, an interruption with 130."""
    signal.signal(signal.SIGINT, _interrupt)
    if isinstance(sys.stdout, io.TextIOWrapper):  # of pipes and old consoles, which may not know every sign
        sys.stdout.reconfigure(errors="replace")
    try:
        app()
    except (MampcError, OSError) as error:  # OSError: such as a name longer than any file's
        expected = (
            "" if isinstance(error, MampcError) else "expected a file or folder that can be used, received: "
        )
        Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(f"mampc: {expected}{error}")
        sys.exit(2)
    except Interrupted:
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
