"""Times without a date, of the day or since a start; and what begins again: after midnight, after noon, at 24:00."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from datetime import datetime
from itertools import chain
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.identification.export.date_words import plain_date
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.sheet import Sheet

DAY, HOUR = 86400.0, 3600.0  # seconds
UNDATED = datetime(1900, 1, 1)  # the day of times without a date
FIELDS = re.compile(
    r"(?:(?P<days>\d+) days?,? )?(?P<hours>\d+):(?P<minutes>[0-5]\d)"
    r"(?::(?P<seconds>[0-5]\d(?:[.,]\d+)?)|(?P<part>[.,]\d+))?(?: ?(?P<half>[AaPp])[Mm])?",
    re.ASCII,
)
MINUTES_FIRST = re.compile(r"\bm{1,2}(in)?:s", re.IGNORECASE)  # in a name or a row of units
MIDNIGHT = re.compile(r"(?<![\d:])24:00(?=(:00([.,]0+)?)?(?![\d:]))")


def times_of_day(
    blocks: Iterable[list[str]], name: str, minutes_first: bool, sheet: Sheet, findings: Findings
) -> tuple[Array, Any]:
    """Seconds of times without a date, and the day that stands for theirs; none where they count from a start.

    Two fields are hours and minutes. They are minutes and seconds where the first of them goes beyond 24, where parts
    of the second follow, or where `minutes_first` says so.
    """
    seconds, short, example, since_start = array("d"), array("b"), "", False
    for cell in chain.from_iterable(blocks):
        found = FIELDS.fullmatch(plain_date(cell))
        seconds.append(_seconds(found) if found else np.nan)
        short.append(found is not None and not (found["seconds"] or found["half"]))
        if found:
            example, since_start = example or cell, since_start or found["days"] is not None
            minutes_first = minutes_first or found["part"] is not None
    read, two = np.array(seconds), np.array(short, dtype=bool)
    too_large = bool((read[two] > DAY).any()) and not minutes_first
    minutes_first = minutes_first or too_large
    if minutes_first:
        read[two] /= 60.0
    if two.any():
        fields = "minutes and seconds" if minutes_first else "hours and minutes"
        why = ", as no day has so many hours; if spans of hours, save them with seconds" if too_large else ""
        findings.note(f"times such as {example!r} in column {name!r} are {fields}{why}")
    if since_start or (read > DAY).any():
        findings.note(f"times in column {name!r} are spans such as {example!r}")
        return read, None
    return on_next_days(read, example, name, sheet, findings, HOUR if minutes_first else DAY), UNDATED


def _seconds(found: re.Match[str]) -> float:
    """Since midnight, of two fields as hours and minutes."""
    hours = float(found["hours"])
    if found["half"]:
        hours = hours % 12 + 12 * (found["half"] in "Pp")
    rest = float((found["seconds"] or "0").replace(",", ".")) + 60 * float(
        (found["part"] or "0").replace(",", ".")
    )
    return ((float(found["days"] or 0) * 24 + hours) * 60 + float(found["minutes"])) * 60 + rest


def on_next_days(
    seconds: Array, example: str, name: str, sheet: Sheet, findings: Findings, period: float = DAY
) -> Array:
    """Times without a date, each time they begin again a day later, in the order of rows."""
    known = np.flatnonzero(~np.isnan(seconds))
    steps = np.diff(seconds[known])
    way = -1.0 if (steps < 0).sum() > (steps > 0).sum() else 1.0  # -1 where the newest comes first
    again = way * steps < 0
    if not again.any():
        return seconds
    rows = rows_text(sheet.numbers[known[1:][again]])
    if period == HOUR:
        findings.doubt(
            f"times such as {example!r} in column {name!r} have no hour and no date, and begin again in {rows}; save "
            "them with both"
        )
        return seconds
    if (way * steps[again] > -DAY / 2).any():
        findings.doubt(
            f"times such as {example!r} in column {name!r} have no date and go back in {rows}; add a date"
        )
        return seconds
    dated = seconds.copy()
    dated[known[1:]] += way * DAY * np.cumsum(again)
    findings.change(
        f"times such as {example!r} in column {name!r} have no date: taken as the {'next' if way > 0 else 'previous'} "
        f"day from {rows} on; if whole days are missing, add a date"
    )
    return dated


def from_midnight(words: list[str]) -> tuple[list[str], Any]:
    """Words with 00:00 for 24:00, and which of them are a day later than they say; None where none is."""
    if not any("24:00" in word and MIDNIGHT.search(word) for word in words):
        return words, None
    late = np.array([MIDNIGHT.search(word) is not None for word in words])
    return [MIDNIGHT.sub("00:00", word) for word in words], late


def doubt_half_days(seconds: Array, name: str, sheet: Sheet, findings: Findings) -> None:
    """Doubt times that go back twelve hours, as clocks do at noon."""
    known = np.flatnonzero(~np.isnan(seconds))
    steps = np.diff(seconds[known])
    if not (steps > 0).any():
        return
    usual = float(np.median(steps[steps > 0]))
    noon = np.flatnonzero((steps < 0) & (np.abs(steps - usual + DAY / 2) <= 0.3 * usual))
    if len(noon):
        rows = rows_text(sheet.numbers[known[noon + 1]])
        findings.doubt(
            f"times in column {name!r} go back twelve hours before {rows}; "
            "save them with 24 hours a day, or with AM and PM"
        )
