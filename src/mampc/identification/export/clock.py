"""The time of every row: which column tells it, and what it says, in seconds."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import shown
from mampc.identification.export.date_words import plain_date
from mampc.identification.export.daytime import CLOCK_ONLY, doubt_half_days, on_next_days
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.header import find_column
from mampc.identification.export.numbers import clean, is_number, numeric_share
from mampc.identification.export.numeric_times import from_numbers
from mampc.identification.export.sheet import Cells, Sheet
from mampc.identification.export.stamps import (
    DATE_ONLY,
    TimeReading,
    clock_put_back,
    elapsed,
    from_stamps,
    iso_stamps,
    plain_stamps,
    since_first,
)

NAMES = re.compile(
    r"(time|t|timestamp|date|datetime|elapsed|seconds|zeit|zeitstempel|temps|tiempo|tempo|tijd|tid)([\W_].*)?"
)
STAMP = re.compile(r"[^\d]{0,5}\d+[-/.:, T]+\w+[-/.:, T]+\d+.*|\d{8}[T ]\d{4,6}.*")
UNDATED = datetime(1900, 1, 1)  # the day of times without a date
EXACT = ("time", "timestamp")


@dataclass(frozen=True, eq=False)
class Clock:
    """When the rows were recorded.

    Attributes:
        name: of the column, or of both.
        columns: their positions.
        seconds: after `origin`, not-a-number where it cannot be read; shape (N,).
        origin: the moment that counts as zero, a `datetime`; None where the column holds numbers.
        zone: behind moments as messages show them.
    """

    name: str
    columns: tuple[int, ...]
    seconds: Array
    origin: Any = None
    zone: str = ""

    def __call__(self, second: float) -> str:
        """A moment as messages show it."""
        if self.origin is None:
            return f"{second:.10g} s"
        moment = self.origin + timedelta(seconds=round(second, 6))
        if self.origin.year <= UNDATED.year:
            day = (moment - UNDATED).days
            return f"{moment.time().isoformat()}{f' on day {day + 1}' if day else ''}"
        return f"{moment.isoformat(sep=' ')}{self.zone}"


def read_clock(sheet: Sheet, taken: Sequence[int], how: TimeReading, findings: Findings) -> Clock | None:
    """Find the time column and read it; None where there is none.

    Args:
        sheet: the table.
        taken: positions of columns that are something else.
        how: what the user says about it.
        findings: receives notes and doubts.
    """
    columns = time_columns(sheet, taken, how, findings)
    if not columns:
        return None
    name = " and ".join(sheet.header[at] for at in columns)
    seconds: Array
    origin: Any
    told = how.time_format is not None or how.time_zone is not None
    if len(columns) == 1 and how.time_format is None and numeric_share(_sampled(sheet, columns[0])) > 0.5:
        seconds, origin = from_numbers(sheet, columns[0], how, findings), None
    elif len(columns) == 1 and not told and (plain := plain_stamps(sheet.chunks(columns))) is not None:
        seconds = clock_put_back(*plain, sheet, findings)
        origin = plain[1]
    elif (
        len(columns) == 1
        and how.time_format is None
        and (stamps := iso_stamps(sheet.chunks(columns))) is not None
    ):
        seconds, origin = since_first(stamps, how, sheet, findings)
    else:
        cells = sheet.column(columns[0])
        if len(columns) == 2:
            days = _held(cells, sheet.header[columns[0]], findings)
            hours = sheet.column(columns[1])
            cells = [f"{day} {hour}".strip() for day, hour in zip(days, hours, strict=True)]
        if isinstance(cells, list) and how.time_format is None and (spans := elapsed(cells)) is not None:
            findings.note(f"times in column {name!r} are spans such as {spans[0]!r}")
            seconds, origin = spans[1], None
        elif not isinstance(cells, list):
            seconds, origin = since_first(cells, how, sheet, findings)
        else:
            seconds, origin = from_stamps(cells, how, sheet, name, findings)
            example = next((cell for cell in cells if CLOCK_ONLY.fullmatch(plain_date(cell))), None)
            if example is not None and CLOCK_ONLY.fullmatch(plain_date(cells[-1])):
                seconds = on_next_days(seconds, example, name, sheet, findings)
                if example.count(":") == 1:
                    findings.note(f"times such as {example!r} in column {name!r} are hours and minutes")
        doubt_half_days(seconds, name, sheet, findings)
    unreadable = np.flatnonzero(np.isnan(seconds))
    if len(unreadable) == len(seconds):
        findings.doubt(
            f"expected times in column {name!r}, received {_cell(sheet, columns, 0)} in row {sheet.numbers[0]}; "
            "pass their format (--time-format '%d/%m/%Y %H:%M'), or another column (--time)"
        )
        return None
    if len(unreadable):
        examples = _cell(sheet, columns, int(unreadable[0]))
        findings.change(
            f"no time can be read in {rows_text(sheet.numbers[unreadable].tolist())} "
            f"(the first says {examples}); left out"
        )
        if len(unreadable) > 0.1 * len(seconds):
            findings.doubt(
                f"expected times in column {name!r}, received others such as {examples} in {len(unreadable)} of "
                f"{len(seconds)} rows, first in row {sheet.numbers[unreadable[0]]}; pass their format (--time-format)"
            )
    if origin is not None and origin.tzinfo is not None:
        return Clock(name, columns, seconds, origin.replace(tzinfo=None), " UTC")
    return Clock(name, columns, seconds, origin)


def _held(days: Cells, name: str, findings: Findings) -> list[str]:
    """Dates, the last one in empty cells."""
    held, last, put = [], "", 0
    for day in map(str, days):
        put += not day and bool(last)
        last = day or last
        held.append(last)
    if put:
        findings.change(f"dates in column {name!r} held in {put} rows without one")
    return held


def _cell(sheet: Sheet, columns: Sequence[int], at: int) -> str:
    return shown(" ".join(str(sheet.column(column)[at]) for column in columns))


def time_columns(sheet: Sheet, taken: Sequence[int], how: TimeReading, findings: Findings) -> tuple[int, ...]:
    """The column of times, or those of dates and of times of the day."""
    if how.time is not None:
        at = find_column(sheet.header, how.time)
        if at is None:
            findings.doubt(
                f"time: expected a column of the file, received {how.time!r}; it has {shown(list(sheet.header), 400)}"
            )
        return () if at is None else (at,)
    free = [at for at in range(len(sheet.header)) if at not in taken]
    shares = {
        kind: [at for at in free if _share(sheet, at, test) > 0.5]
        for kind, test in (
            (
                "stamps",
                lambda cell: STAMP.fullmatch(cell) and not (CLOCK_ONLY.fullmatch(cell) or is_number(cell)),
            ),
            ("dates", DATE_ONLY.fullmatch),
            ("hours", CLOCK_ONLY.fullmatch),
        )
    }
    dates, hours = shares["dates"], shares["hours"]
    stamps = [at for at in shares["stamps"] if at not in dates]
    if not stamps and len(dates) == len(hours) == 1:
        return (dates[0], hours[0])
    numeric = [
        at
        for at in free
        if numeric_share(_sampled(sheet, at)) > 0.5
        and (
            sheet.header[at].casefold() in EXACT
            or (NAMES.fullmatch(sheet.header[at].casefold()) and _runs_on(sheet, at, 0.8))
        )
    ]
    found = stamps or [*dates, *hours] or numeric
    found = [
        at for at in found if len(set(_sampled(sheet, at))) > 1
    ] or found  # others hold the export's own span
    if len(found) > 1 and _all_alike([sheet.column(at) for at in found]):
        findings.note(f"{len(found)} columns of times are the same, as {sheet.header[found[0]]!r}")
    elif len(found) > 1 and len({sheet.header[at] for at in found}) == 1:
        findings.doubt(
            f"expected one column of times, received {len(found)} called {sheet.header[found[0]]!r} with different "
            "times; export all columns at the same times"
        )
    elif len(found) > 1:
        listed = ", ".join(repr(sheet.header[at]) for at in found)
        findings.doubt(
            f"expected one column of times, received {listed}; say which one counts (time, --time)"
        )
    if not found and free[:1] == [0] and _runs_on(sheet, 0, 0.9, evenly=True):
        return (0,)
    return tuple(found[:1])


def _all_alike(columns: Sequence[Cells]) -> bool:
    return all(list(column) == list(columns[0]) for column in columns[1:])


def _sampled(sheet: Sheet, at: int) -> list[str]:
    return [row[at] for row in sheet.sample]


def _share(sheet: Sheet, at: int, test: Callable[[str], Any]) -> float:
    cells = [plain_date(clean(cell)) for cell in _sampled(sheet, at) if cell]
    return sum(bool(test(cell)) for cell in cells) / len(cells) if cells else 0.0


def _runs_on(sheet: Sheet, at: int, share: float, *, evenly: bool = False) -> bool:
    """Whether most numbers of a sample are larger than the one before, or smaller; evenly, and no count of rows."""
    cells = [clean(cell).replace(",", ".") for cell in _sampled(sheet, at)]
    steps = np.diff([float(cell) for cell in cells if numeric_share([cell]) == 1])
    if not len(steps):
        return False
    usual = float(np.median(steps))
    if not evenly:
        return usual != 0 and bool(np.mean(steps * usual > 0) >= share)
    return usual not in (0.0, 1.0) and bool(np.mean(np.abs(steps - usual) <= 0.3 * abs(usual)) > share)
