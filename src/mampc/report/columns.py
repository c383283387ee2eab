"""The columns of tables on the terminal."""

from __future__ import annotations

from rich.table import Column


def numbers(*headers: str, no_wrap: bool = False) -> list[Column]:
    """Columns of numbers, which stand to the right."""
    return [Column(header, justify="right", no_wrap=no_wrap) for header in headers]
