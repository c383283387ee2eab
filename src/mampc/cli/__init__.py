"""The command line: one file for each group of commands."""

from mampc.cli import comparing, data, planning, studies, tuning
from mampc.cli.app import app, main

__all__ = ["app", "comparing", "data", "main", "planning", "studies", "tuning"]

# In the order of work, from an export to a controller and what it did.
_ORDER = (
    "inspect", "identify", "show", "plan-test", "new", "run", "sweep", "front", "tune", "replay", "reproduce",
)  # fmt: skip
app.registered_commands.sort(key=lambda known: _ORDER.index(known.name or known.callback.__name__))  # type: ignore[union-attr]
