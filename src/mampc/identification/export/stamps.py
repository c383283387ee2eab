"""Time stamps as seconds, by what pandas reads: orders of day and month, offsets, zones, clocks put back."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import product
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError, shown
from mampc.identification.export.date_words import plain_date
from mampc.identification.export.daytime import DAY, MIDNIGHT, from_midnight, has_midnight
from mampc.identification.export.findings import Findings
from mampc.identification.export.sheet import Cells, Sheet

SECONDS = {
    "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3,
    "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0,
    "min": 60.0, "minute": 60.0, "minutes": 60.0,
    "h": 3600.0, "hr": 3600.0, "hour": 3600.0, "hours": 3600.0,
    "d": 86400.0, "day": 86400.0, "days": 86400.0,
    "sekunden": 1.0, "secondes": 1.0, "segundos": 1.0, "secondi": 1.0, "minuten": 60.0, "minutos": 60.0,
    "minuti": 60.0, "stunden": 3600.0, "heures": 3600.0, "horas": 3600.0, "ore": 3600.0, "tage": 86400.0,
}  # fmt: skip
DATE_ONLY = re.compile(r"\d+[-/.]\w+[-/.]\d+|\w+ \w+,? \d+")
OFFSET = re.compile(r".*\d(Z|[+-]\d\d(:?\d\d)?)")
TIMES = (
    "", " %H:%M:%S", " %H:%M", " %H:%M:%S.%f", " %I:%M:%S %p", " %I:%M %p", " %I:%M:%S.%f %p", " %H.%M.%S",
)  # fmt: skip
DAY_FIRST = (
    "%d.%m.%Y", "%d/%m/%Y", "%d-%m-%Y", "%d.%m.%y", "%d/%m/%y", "%d-%m-%y",
    "%d-%b-%Y", "%d-%b-%y", "%d %b %Y", "%d %b %y", "%d/%b/%Y", "%d %B %Y",
)  # fmt: skip
MONTH_FIRST = (
    "%m/%d/%Y", "%m-%d-%Y", "%m/%d/%y", "%m-%d-%y", "%b %d, %Y", "%b %d %Y", "%B %d, %Y",
)  # fmt: skip
YEAR_FIRST = ("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d")
PLAIN = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d{1,6})?)?", re.ASCII)
SPAN = re.compile(r"\d+ days?,? \d+:\d\d:\d\d(\.\d+)?|(2[4-9]|[3-9]\d|\d{3,}):\d\d:\d\d(\.\d+)?", re.ASCII)
UTC = re.compile(r" ?(UTC|GMT)$")
DIGIT, LETTER = re.compile(r"\d"), re.compile(r"[^\W\d_]")
HOUR = 3600.0


@dataclass(frozen=True)
class TimeReading:
    """How the time column is read, where that is not plain.

    Args:
        time: its name; None to find it.
        time_unit: of numbers, "ms", "s", "min", "h" or "d"; None to see it from the header, else seconds.
        time_format: of stamps, as in `strptime`, such as "%d/%m/%Y %H:%M"; None to see it from the cells.
        time_zone: of stamps in local time, such as "Europe/Berlin"; None where the clock is never changed.
    """

    time: str | None = None
    time_unit: str | None = None
    time_format: str | None = None
    time_zone: str | None = None

    def __post_init__(self) -> None:
        if self.time_unit is not None and self.time_unit not in SECONDS:
            raise MampcError(f"time_unit: expected one of ms, s, min, h, d, received {shown(self.time_unit)}")
        if self.time_zone is not None:
            from zoneinfo import ZoneInfo

            try:
                ZoneInfo(self.time_zone)
            except (KeyError, ValueError, TypeError, OSError):
                raise MampcError(
                    f"time_zone: expected a name such as 'Europe/Berlin', received {shown(self.time_zone)}"
                ) from None


def plain_stamps(blocks: Iterable[Sequence[Cells]]) -> tuple[Array, datetime] | None:
    """Seconds after the first of local stamps in ISO's form, all complete, and that stamp; numpy reads these alone.

    Block by block: the words of a long file are never all there. None where any cell is something else.
    """
    parts: list[Any] = []
    for [cells] in blocks:
        if not isinstance(cells, list) or not all(map(PLAIN.fullmatch, cells)):
            return None
        try:
            parts.append(np.array(cells, dtype="datetime64[us]").view(np.int64))
        except ValueError:  # such as a 30th of February
            return None
    ticks = np.concatenate(parts)
    first = int(ticks.min())
    ticks -= first
    seconds: Array = ticks / 1e6
    return seconds, datetime(1970, 1, 1) + timedelta(microseconds=first)


def iso_stamps(blocks: Iterable[Sequence[Cells]]) -> Any:
    """Stamps in ISO's form as pandas has them, block by block: the words of a long file are never all there.

    None where the cells are no words, or mostly in another form, or some have an offset from UTC and others none.
    """
    import pandas as pd

    parts: list[Any] = []
    offsets = None
    for [cells] in blocks:
        if not isinstance(cells, list) or has_midnight(cells):
            return None
        kinds = {_has_offset(cell) for cell in cells if cell} | ({offsets} - {None})
        if len(kinds) != 1:
            return None
        offsets = kinds.pop()
        stamps = pd.to_datetime(
            pd.Series(cells, dtype=object), format="ISO8601", errors="coerce", utc=bool(offsets)
        )
        if stamps.notna().mean() < 0.9:
            return None
        parts.append(stamps)
    return pd.concat(parts, ignore_index=True)


def _has_offset(cell: str) -> bool:
    signed = cell[-1:] == "Z" or "+" in cell or "-" in cell[-6:]
    return signed and OFFSET.fullmatch(cell) is not None and DATE_ONLY.fullmatch(cell) is None


def from_stamps(
    cells: Cells, how: TimeReading, sheet: Sheet, name: str, findings: Findings
) -> tuple[Array, Any]:
    """Seconds after the first stamp, and that stamp."""
    words = [UTC.sub("+00:00", " ".join(cell.split())) for cell in cells]
    if how.time_format is None:
        words = [plain_date(word) for word in words]
    offsets = [cell for cell in words if _has_offset(cell)]
    if offsets and len(offsets) < 0.9 * sum(map(bool, words)):
        findings.doubt(
            f"some times in column {name!r} have an offset from UTC such as {offsets[0]!r}, others have none"
        )
    words, late = from_midnight(words)
    readings = list(_readings(words, how, bool(offsets)))
    if late is not None:
        readings = [stamps.where(~late, stamps + timedelta(seconds=DAY)) for stamps in readings]
    best = max(int(stamps.notna().sum()) for stamps in readings)
    readings = [stamps for stamps in readings if best and stamps.notna().sum() >= 0.99 * best]
    if not readings:
        return np.full(len(words), np.nan), None
    if len(readings) == 1:
        return since_first(readings[0], how, sheet, findings)
    found = [since_first(stamps, how, sheet, Findings(findings.origin)) for stamps in readings]
    choice = 0
    if not np.array_equal(found[0][0], found[1][0], equal_nan=True):
        strays = [unevenness(seconds) for seconds, _ in found]
        choice = int(np.argmin(strays))
        if max(strays) < 1.05 * min(strays) + 0.01:
            findings.doubt(
                f"times such as {words[0]!r} in column {name!r} may have the day or the month first; pass their format "
                "(--time-format '%d/%m/%Y %H:%M:%S')"
            )
        else:
            order = ("day", "month")[choice]
            findings.note(f"times such as {words[0]!r} have the {order} first: only so are they even")
    else:
        findings.note(
            f"times such as {words[0]!r} may have the day or the month first; the steps are the same"
        )
    return since_first(readings[choice], how, sheet, findings)


def _readings(words: list[str], how: TimeReading, offsets: bool) -> Iterator[Any]:
    """The stamps as pandas reads them, in each order of day and month that they may have."""
    import pandas as pd

    series = pd.Series(words, dtype=object)
    if how.time_format is not None:
        try:
            yield pd.to_datetime(series, format=how.time_format, errors="coerce", utc=offsets)
        except ValueError as error:
            raise MampcError(f"time_format: expected a format as strptime has it, received {error}") from None
        return
    points = series
    if any("," in word for word in words):
        points = series.str.replace(r"(\d),(\d+)", r"\1.\2", regex=True)
    iso = pd.to_datetime(points, format="ISO8601", errors="coerce", utc=offsets)
    if iso.notna().mean() > 0.5:
        yield iso
        return
    zone = (" %z", "%z") if offsets else ("",)
    for family in (DAY_FIRST, MONTH_FIRST, YEAR_FIRST, ("",)):
        formats = [
            (day + time + end).strip() for day, time, end in product(family, TIMES, zone) if day or time
        ]
        yield _in_formats(points, formats, offsets)


def _in_formats(series: Any, formats: Sequence[str], offsets: bool) -> Any:
    """Every cell in the first of the formats that reads it."""
    import pandas as pd

    stamps = pd.to_datetime(pd.Series([None] * len(series), dtype=object), utc=offsets)
    left = series[series != ""]
    for _ in range(4):  # such as with and without fractions of seconds, and without a time at midnight
        fitting = None
        for cell in _kinds(left.iloc[:50]):
            fitting = next(
                (
                    form
                    for form in formats
                    if pd.notna(pd.to_datetime(cell, format=form, errors="coerce", utc=offsets))
                ),
                None,
            )
            if fitting:
                break
        if fitting is None:
            break
        read = pd.to_datetime(left, format=fitting, errors="coerce", utc=offsets)
        stamps = (
            read.reindex(series.index).combine_first(stamps)
            if stamps.notna().any()
            else read.reindex(series.index)
        )
        left = left[read.isna()]
        if not len(left):
            break
    return stamps


def _kinds(cells: Iterable[str]) -> list[str]:
    """Two cells of each pattern of digits and letters: others are read as they are."""
    found: dict[str, list[str]] = {}
    for cell in cells:
        found.setdefault(LETTER.sub("a", DIGIT.sub("0", cell)), []).append(cell)
    return [cell for alike in list(found.values())[:10] for cell in dict.fromkeys((alike[0], alike[-1]))]


def since_first(stamps: Any, how: TimeReading, sheet: Sheet, findings: Findings) -> tuple[Array, Any]:
    """Seconds after the earliest stamp, and that stamp, in UTC where it has a zone."""
    stamps = stamps.reset_index(drop=True)
    if how.time_zone is not None and getattr(stamps.dtype, "tz", None) is None:
        stamps = _localised(stamps, how.time_zone, findings)
    if not stamps.notna().any():
        return np.full(len(stamps), np.nan), None
    origin = stamps.min()
    seconds = (stamps - origin).dt.total_seconds().to_numpy(dtype=np.float64)
    if origin.tzinfo is None:
        return clock_put_back(seconds, origin, sheet, findings), origin
    return seconds, origin.tz_convert("UTC")


def _localised(stamps: Any, zone: str, findings: Findings) -> Any:
    """Local stamps in their zone; of a doubled hour, the order of rows tells which is which."""
    known = stamps[stamps.notna()]
    steps = known.diff().dt.total_seconds().to_numpy()[1:]
    backwards = bool((steps < 0).sum() > (steps > 0).sum())
    known = known.iloc[::-1] if backwards else known
    try:
        read = known.dt.tz_localize(zone, ambiguous="infer", nonexistent="NaT")
    except ValueError as error:
        findings.doubt(f"the doubled hour at the end of summer time in {zone} cannot be told apart: {error}")
        read = known.dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
    return read.reindex(stamps.index)


def elapsed(cells: Sequence[str]) -> tuple[str, Array] | None:
    """A span such as "30:00:00" or "1 days 06:00:00", and all of them in seconds; None where they are times of days."""
    longest = next((cell for cell in cells if SPAN.fullmatch(cell) and not MIDNIGHT.match(cell)), None)
    if longest is None:
        return None
    import pandas as pd

    spans = pd.to_timedelta(pd.Series(cells, dtype=object), errors="coerce").dt.total_seconds().to_numpy()
    return (longest, spans.astype(np.float64)) if np.isfinite(spans).mean() > 0.9 else None


def clock_put_back(seconds: Array, origin: Any, sheet: Sheet, findings: Findings) -> Array:
    """Local time in the order of rows, with an hour added where the clock was put back an hour."""
    known = np.flatnonzero(~np.isnan(seconds))
    steps = np.diff(seconds[known])
    if (steps < 0).sum() > (steps > 0).sum():  # the newest first
        known, steps = known[::-1], -steps[::-1]
    if len(steps) < 3 or not (steps > 0).any():
        return seconds
    usual = float(np.median(steps[steps > 0]))
    back = np.flatnonzero((np.abs(steps - (usual - HOUR)) <= 0.3 * usual) & (steps <= 0))
    if not 0 < len(back) <= 3 or (steps[np.setdiff1d(np.arange(len(steps)), back)] <= 0).mean() > 0.001:
        return seconds
    corrected = seconds.copy()
    for i in back:
        moment = origin + timedelta(seconds=float(seconds[known[i]]))
        if usual >= HOUR and not (moment.weekday() == 6 and moment.hour <= 3):
            continue
        if usual >= HOUR and _same_cells(sheet, int(known[i]), int(known[i + 1])):
            continue  # one row that stands twice
        corrected[known[i + 1 :]] += HOUR
        findings.change(
            f"the clock goes back an hour after {moment} (row {sheet.numbers[known[i + 1]]}): taken as the end of "
            "summer time, rows kept in their order"
        )
    return corrected


def _same_cells(sheet: Sheet, one: int, other: int) -> bool:
    """Whether two rows hold the same cells, that of the time included."""
    columns = range(len(sheet.header))
    return all(cells[one] == cells[other] for cells in (list(sheet.column(at)) for at in columns))


def unevenness(seconds: Array) -> float:
    """By how much the steps differ from the usual one, in all, as a multiple of it."""
    steps = np.abs(np.diff(seconds[~np.isnan(seconds)]))
    usual = float(np.median(steps)) if len(steps) else 0.0
    return float(np.abs(steps - usual).sum()) / usual if usual else 0.0
