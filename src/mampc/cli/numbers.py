"""Numbers on the command line: shares, times with a unit, rows between commas, matrices; and words."""

from __future__ import annotations

import csv

from mampc.base.errors import MampcError, shown


def number(name: str, text: str, expected: str = "numbers such as 2.5") -> float:
    """A number, a share such as 5%, or a time with its unit in seconds; `name` is the option."""
    from mampc.study.values import time_in_seconds

    try:
        if text.strip().endswith("%"):
            return float(text.strip().removesuffix("%")) / 100
        try:
            return float(text)
        except ValueError:
            return float(time_in_seconds(text))
    except ValueError:
        raise MampcError(f"{name}: expected {expected}, received {shown(text)}") from None


def row(name: str, text: str | None) -> float | list[float] | None:
    """One number, or several between commas."""
    if text is None:
        return None
    numbers = [_quantity(name, cell) for cell in text.split(",")]
    return numbers[0] if len(numbers) == 1 else numbers


def matrix(name: str, text: str | None) -> float | list[list[float]] | None:
    """One number, or rows between semicolons."""
    if text is None:
        return None
    rows = [[_quantity(name, cell) for cell in line.split(",")] for line in text.split(";")]
    if len({len(line) for line in rows}) > 1:
        raise MampcError(f"{name}: expected rows of one length, received {shown(text)}")
    return rows[0][0] if len(rows) == len(rows[0]) == 1 else rows


def _quantity(name: str, text: str) -> float:
    """A number in engineering units: 50% of a valve is 50 there, and no half."""
    if "%" in text:
        raise MampcError(
            f"{name}: expected numbers in the signal's own unit, such as 2.5, received {shown(text)}"
        )
    return number(name, text)


def words(text: str) -> list[str]:
    """Words between commas; one that holds a comma stands in quotation marks."""
    return [word.strip() for row in csv.reader([text], skipinitialspace=True) for word in row if word.strip()]
