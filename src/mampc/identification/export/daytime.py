"""Times of the day that begin again: after midnight without a date, after noon without AM and PM, at 24:00."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.sheet import Sheet

DAY = 86400.0
CLOCK_ONLY = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[AaPp][Mm])?")
MIDNIGHT = re.compile(r"(?<![\d:])24:00(?=(:00([.,]0+)?)?(?![\d:]))")


def has_midnight(cells: Sequence[str]) -> bool:
    """Whether a day ends at 24:00 in any of the cells."""
    return any("24:00" in cell and MIDNIGHT.search(cell) for cell in cells)


def from_midnight(words: list[str]) -> tuple[list[str], Any]:
    """Words with 00:00 for 24:00, and which of them are a day later than they say; None where none is."""
    if not has_midnight(words):
        return words, None
    late = np.array([MIDNIGHT.search(word) is not None for word in words])
    return [MIDNIGHT.sub("00:00", word) for word in words], late


def on_next_days(seconds: Array, example: str, name: str, sheet: Sheet, findings: Findings) -> Array:
    """Times without a date, each time they begin again a day later, in the order of rows."""
    known = np.flatnonzero(~np.isnan(seconds))
    steps = np.diff(seconds[known])
    way = -1.0 if (steps < 0).sum() > (steps > 0).sum() else 1.0  # -1 where the newest comes first
    again = way * steps < 0
    if not again.any():
        return seconds
    rows = sheet.numbers[known[1:][again]].tolist()
    if (way * steps[again] > -DAY / 2).any():
        findings.doubt(
            f"times such as {example!r} in column {name!r} have no date and go back in {rows_text(rows)}; add a date"
        )
        return seconds
    dated = seconds.copy()
    dated[known[1:]] += way * DAY * np.cumsum(again)
    findings.change(
        f"times such as {example!r} in column {name!r} have no date: taken as the {'next' if way > 0 else 'previous'} "
        f"day from {rows_text(rows)} on; if whole days are missing, add a date"
    )
    return dated


def doubt_half_days(seconds: Array, name: str, sheet: Sheet, findings: Findings) -> None:
    """Doubt times that go back twelve hours, as clocks do at noon."""
    known = np.flatnonzero(~np.isnan(seconds))
    steps = np.diff(seconds[known])
    if not (steps > 0).any():
        return
    usual = float(np.median(steps[steps > 0]))
    noon = np.flatnonzero((steps < 0) & (np.abs(steps - usual + DAY / 2) <= 0.3 * usual))
    if len(noon):
        rows = rows_text(sheet.numbers[known[noon + 1]].tolist())
        findings.doubt(
            f"times in column {name!r} go back twelve hours before {rows}; "
            "save them with 24 hours a day, or with AM and PM"
        )
