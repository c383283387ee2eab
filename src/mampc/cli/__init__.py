"""The command line: one file for each group of commands."""

from mampc.cli import comparing, data, planning, studies, tuning
from mampc.cli.app import app, main

__all__ = ["app", "comparing", "data", "main", "planning", "studies", "tuning"]
