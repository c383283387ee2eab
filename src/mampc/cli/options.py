"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Trust = Annotated[
    bool, typer.Option("--trust", help="Allow a study from elsewhere to import its plant (module:Class).")
]
Jobs = Annotated[int, typer.Option(help="Processes; -1 for one a core.")]
SweepFolder = Annotated[
    Path | None, typer.Option("--out", "-o", help="Folder for the results; default results/NAME-sweep.")
]
Seeds = Annotated[int, typer.Option(min=1, max=10_000, help="Of noise and loads, in every scenario.")]
Points = Annotated[int, typer.Option(min=1, max=1000, help="Values of each controller's knob.")]
Scheduler = Annotated[
    str | None, typer.Option(help="A Dask scheduler, such as tcp://host:8786, in place of processes here.")
]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Run a large grid without asking.")]
