"""The time of every row: which column tells it, and what it says, in seconds."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import shown
from mampc.identification.export.cells import clean, is_number, numeric_share, says_numbers
from mampc.identification.export.date_parts import has_parts, part_columns, part_words
from mampc.identification.export.date_words import plain_date
from mampc.identification.export.daytime import (
    DAY,
    FIELDS,
    HOUR,
    MINUTES_FIRST,
    UNDATED,
    doubt_half_days,
    on_next_days,
    times_of_day,
)
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.header import find_column
from mampc.identification.export.numeric_times import from_numbers
from mampc.identification.export.sheet import Sheet
from mampc.identification.export.stamps import (
    DATE_ONLY,
    TimeReading,
    clock_put_back,
    from_stamps,
    plain_stamps,
    since_first,
    ticks_of,
)

NAMES = re.compile(
    r"(time|t|timestamp|date|datetime|elapsed|seconds|zeit|zeitstempel|temps|tiempo|tempo|tijd|tid)([\W_].*)?"
)
STAMP = re.compile(r"[^\d]{0,5}\d+[-/.:, T]+\w+[-/.:, T]+\d+.*|\d{8}[T ]\d{4,6}.*")
EXACT = ("time", "timestamp")


@dataclass(frozen=True, eq=False)
class Clock:
    """When the rows were recorded.

    Attributes:
        name: of the column, or of both.
        columns: their positions.
        seconds: after `origin`, not-a-number where it cannot be read; shape (N,).
        origin: the moment that counts as zero; None where the column holds numbers.
        zone: behind moments as messages show them.
        doubtful: whether they may be other times than they seem.
    """

    name: str
    columns: tuple[int, ...]
    seconds: Array
    origin: datetime | None = None
    zone: str = ""
    doubtful: bool = False

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
    doubts = len(findings.doubts)
    seconds, origin = _seconds(sheet, columns, name, how, findings)
    doubt_half_days(seconds, name, sheet, findings)
    unreadable = np.flatnonzero(np.isnan(seconds))
    if len(unreadable):
        parts = [sheet.words(at) for at in columns]
        words = [" ".join(part[i] for part in parts) for i in unreadable.tolist()]
        cell, row = shown(words[0]), f"row {sheet.numbers[unreadable[0]]}"
        if len(unreadable) == len(seconds):
            findings.doubt(
                f"expected times in column {name!r}, received {cell} in {row}; "
                "pass their format (--time-format '%d/%m/%Y %H:%M'), or another column (--time)"
            )
            return None
        findings.change(
            f"no time can be read in {rows_text(sheet.numbers[unreadable])} (the first says {cell}); left out"
        )
        strange = sum(any(map(str.isdigit, word)) for word in words)  # no time is without a digit
        if strange > 0.1 * len(seconds) or len(unreadable) > 0.5 * len(seconds):
            findings.doubt(
                f"expected times in column {name!r}, received others such as {cell} in {len(unreadable)} of "
                f"{len(seconds)} rows, first in {row}; pass their format (--time-format)"
            )
    zone = ""
    if origin is not None and origin.tzinfo is not None:
        origin, zone = origin.replace(tzinfo=None), " UTC"
    return Clock(name, columns, seconds, origin, zone, len(findings.doubts) > doubts)


def _seconds(
    sheet: Sheet, columns: Sequence[int], name: str, how: TimeReading, findings: Findings
) -> tuple[Array, datetime | None]:
    """Times after the first stamp, and that stamp; None where they are numbers or spans."""
    alone = len(columns) == 1 and how.time_format is None
    first = [" ".join(row[at] for at in columns) for row in sheet.sample]
    if alone and says_numbers(first):
        return from_numbers(sheet, columns[0], how, findings), None
    if alone and how.time_zone is None and (plain := plain_stamps(sheet.chunks(columns))) is not None:
        return clock_put_back(*plain, sheet, findings), plain[1]
    if alone and _share(first, FIELDS.fullmatch) > 0.5:
        told = MINUTES_FIRST.search(f"{name} {sheet.units.get(columns[0], '')}") is not None
        return times_of_day(_words(sheet, columns, findings), name, told, sheet, findings)
    if any(not isinstance(cells, list) for cells in next(sheet.chunks(columns))):
        stamps: Any = sheet.column(columns[0])
        return since_first(ticks_of(stamps), stamps.dt.tz is not None, how, sheet, findings)
    seconds, origin = from_stamps(_words(sheet, columns, findings), how, sheet, name, findings)
    if origin is not None and origin.year == UNDATED.year:
        period = DAY if re.search("%[HI]", how.time_format or "%H") else HOUR
        seconds = on_next_days(seconds, first[0], name, sheet, findings, period)
    return seconds, origin


def _words(sheet: Sheet, columns: Sequence[int], findings: Findings) -> Iterator[list[str]]:
    """The cells of the column, or of those of dates and times put together, the last date in empty cells."""
    if has_parts(sheet, columns):
        yield from part_words(sheet, columns)
        return
    date, held = "", 0
    for cells in sheet.chunks(columns):
        if len(cells) == 1:
            yield [str(cell) for cell in cells[0]]
            continue
        words = []
        for own, time in zip(*(map(str, column) for column in cells), strict=True):
            held += not own and bool(date)
            date = own or date
            words.append(f"{date} {time}".strip())
        yield words
    if held:
        findings.change(f"dates in column {sheet.header[columns[0]]!r} held in {held} rows without one")


def time_columns(sheet: Sheet, taken: Sequence[int], how: TimeReading, findings: Findings) -> tuple[int, ...]:
    """The column of times, or those of dates and of times of the day, or of their parts."""
    if how.time is not None:
        at = find_column(sheet.header, how.time)
        if at is None:
            findings.doubt(
                f"time: expected a column of the file, received {how.time!r}; it has {shown(list(sheet.header), 400)}"
            )
        return () if at is None else (at,)
    free = [at for at in range(len(sheet.header)) if at not in taken]
    shares = {
        kind: [at for at in free if _share(sheet.first(at), test) > 0.5]
        for kind, test in (
            (
                "stamps",
                lambda cell: STAMP.fullmatch(cell) and not (FIELDS.fullmatch(cell) or is_number(cell)),
            ),
            ("dates", DATE_ONLY.fullmatch),
            ("hours", FIELDS.fullmatch),
        )
    }
    dates, hours = shares["dates"], shares["hours"]
    stamps = [at for at in shares["stamps"] if at not in dates]
    parts = () if stamps or hours else part_columns(sheet, free, dates)
    if parts:
        return parts
    if not stamps and len(dates) == len(hours) == 1:
        return (dates[0], hours[0])
    numeric = [
        at
        for at in free
        if says_numbers(sheet.first(at))
        and (
            sheet.header[at].casefold() in EXACT
            or (NAMES.fullmatch(sheet.header[at].casefold()) and _runs_on(sheet, at, 0.8))
        )
    ]
    found = stamps or [*dates, *hours] or numeric
    found = [
        at for at in found if len(set(sheet.first(at))) > 1
    ] or found  # others hold the export's own span
    columns = [list(sheet.column(at)) for at in found] if len(found) > 1 else []
    if columns and all(column == columns[0] for column in columns):
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


def _share(cells: Sequence[str], test: Callable[[str], Any]) -> float:
    plain = [plain_date(clean(cell)) for cell in cells if cell]
    return sum(bool(test(cell)) for cell in plain) / len(plain) if plain else 0.0


def _runs_on(sheet: Sheet, at: int, share: float, *, evenly: bool = False) -> bool:
    """Whether most numbers of a sample are larger than the one before, or smaller; evenly, and no count of rows."""
    cells = [clean(cell).replace(",", ".") for cell in sheet.first(at)]
    steps = np.diff([float(cell) for cell in cells if numeric_share([cell]) == 1])
    if not len(steps):
        return False
    usual = float(np.median(steps))
    if not evenly:
        return usual != 0 and bool(np.mean(steps * usual > 0) >= share)
    return usual not in (0.0, 1.0) and bool(np.mean(np.abs(steps - usual) <= 0.3 * abs(usual)) > share)
