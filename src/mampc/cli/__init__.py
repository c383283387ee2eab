"""The command line: one file for each group of commands."""

from mampc.cli import comparing, data, studies, tuning
from mampc.cli.app import app, main

__all__ = ["app", "comparing", "data", "main", "studies", "tuning"]
