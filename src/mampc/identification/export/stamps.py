"""Time stamps as seconds, by what pandas reads: orders of day and month, offsets, zones, clocks put back."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from mampc.base.checks import Array
from mampc.base.errors import MampcError, shown
from mampc.identification.export.date_words import plain_date
from mampc.identification.export.daytime import DAY, HOUR, UNDATED, from_midnight
from mampc.identification.export.findings import Findings
from mampc.identification.export.sheet import Cells, Sheet

SECONDS = {
    "ns": 1e-9, "nanoseconds": 1e-9,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "usec": 1e-6, "microseconds": 1e-6,
    "ms": 1e-3, "msec": 1e-3, "milliseconds": 1e-3,
    "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0,
    "min": 60.0, "minute": 60.0, "minutes": 60.0,
    "h": 3600.0, "hr": 3600.0, "hour": 3600.0, "hours": 3600.0,
    "d": 86400.0, "day": 86400.0, "days": 86400.0,
    "sekunden": 1.0, "secondes": 1.0, "segundos": 1.0, "secondi": 1.0, "minuten": 60.0, "minutos": 60.0,
    "minuti": 60.0, "stunden": 3600.0, "heures": 3600.0, "horas": 3600.0, "ore": 3600.0, "tage": 86400.0,
}  # fmt: skip
DATE_ONLY = re.compile(r"\d+[-/.]\w+[-/.]\d+|\w+ \w+,? \d+")
OFFSET = re.compile(r".*(?:\d|[AaPp][Mm])(Z|[+-]\d\d(:?\d\d)?)")
TIMES = (
    "",
    " %H:%M:%S",
    " %H:%M",
    " %H:%M:%S.%f",
    " %H:%M:%S:%f",
    " %I:%M:%S %p",
    " %I:%M %p",
    " %I:%M:%S.%f %p",
)
# Dates, in each order of day and month that they may have.
ORDERS = {
    "day": (
        "%d.%m.%Y", "%d/%m/%Y", "%d-%m-%Y", "%d.%m.%y", "%d/%m/%y", "%d-%m-%y",
        "%d-%b-%Y", "%d-%b-%y", "%d %b %Y", "%d %b %y", "%d/%b/%Y", "%d %B %Y",
    ),
    "month": ("%m/%d/%Y", "%m-%d-%Y", "%m/%d/%y", "%m-%d-%y", "%b %d %Y", "%B %d %Y"),
    "year": ("ISO8601", "%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%y/%m/%d", "%y-%m-%d", "%y.%m.%d", "%G-W%V-%u"),
}  # fmt: skip
MOST_FORMATS = 4  # in one column, such as with and without fractions of seconds
PLAIN = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d{1,6})?)?", re.ASCII)
DECIMAL = re.compile(r"(\d),(\d)")
DIGIT, LETTER = re.compile(r"\d"), re.compile(r"[^\W\d_]")
FIELD = re.compile(r"%.|\w|\s")
NEVER = np.iinfo(np.int64).min  # among ticks, as numpy has it
# Ticks of years that dates have, a day from their ends, which offsets and clocks put back may take.
EARLIEST, LATEST = (np.datetime64(day, "us").astype(np.int64).item() for day in ("0001-01-02", "9999-12-30"))

Ticks = npt.NDArray[np.int64]  # microseconds since 1970, in UTC or in local time


@dataclass(frozen=True)
class TimeReading:
    """How the time column is read, where that is not plain.

    Args:
        time: its name; None to find it.
        time_unit: of numbers, "ns", "us", "ms", "s", "min", "h" or "d"; None to see it from the header, else seconds.
        time_format: of stamps, as in `strptime`, such as "%d/%m/%Y %H:%M"; None to see it from the cells.
        time_zone: of stamps in local time, such as "Europe/Berlin"; None where the clock is never changed.
    """

    time: str | None = None
    time_unit: str | None = None
    time_format: str | None = None
    time_zone: str | None = None

    def __post_init__(self) -> None:
        if self.time_unit is not None and self.time_unit not in SECONDS:
            raise MampcError(
                f"time_unit: expected one of ns, us, ms, s, min, h, d, received {shown(self.time_unit)}"
            )
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
    if not EARLIEST <= first <= ticks.max() <= LATEST:
        return None
    ticks -= first
    seconds: Array = ticks / 1e6
    return seconds, _moment(first)


def from_stamps(
    blocks: Iterable[list[str]], how: TimeReading, sheet: Sheet, name: str, findings: Findings
) -> tuple[Array, Any]:
    """Seconds after the first stamp, and that stamp.

    Args:
        blocks: all cells, some rows at a time: the words of a long file are never all there.
    """
    orders, example, in_utc = _read_orders(blocks, how, name, findings)
    best = max(order.count for order in orders.values())
    likely = {key: order.ticks() for key, order in orders.items() if best and order.count >= 0.99 * best}
    trial = Findings(findings.origin)
    found = {key: since_first(ticks, in_utc, how, sheet, trial)[0] for key, ticks in likely.items()}
    strays = {key: unevenness(seconds) for key, seconds in found.items()}
    choice = min(strays, key=lambda key: strays[key], default="")
    words = f"times such as {example!r} in column {name!r}"
    if len(likely) == 1:
        for other in [key for key in orders if key not in likely]:
            ticks = orders[other].ticks()
            ticks = np.where(ticks == NEVER, likely[choice], ticks)
            if unevenness(since_first(ticks, in_utc, how, sheet, trial)[0]) < strays[choice] / 2:
                findings.doubt(
                    f"{words} have the {choice} first, and are even only if some have the {other} first, as "
                    "spreadsheets make them of dates of another country; export them again, with the year first"
                )
    elif likely:
        others = [k for k in found if not np.array_equal(found[k], found[choice], equal_nan=True)]
        either = " or ".join(f"the {key}" for key in likely)
        if not others:
            findings.note(f"{words} may have {either} first; the steps are the same")
        elif min(strays[key] for key in others) < 1.05 * strays[choice] + 0.01:
            findings.doubt(
                f"{words} may have {either} first; pass their format (--time-format '%d/%m/%Y %H:%M:%S')"
            )
        else:
            findings.note(f"{words} have the {choice} first: only so are they even")
    ticks = likely[choice] if likely else np.full(len(sheet), NEVER)
    return since_first(ticks, in_utc, how, sheet, findings)


def _read_orders(
    blocks: Iterable[list[str]], how: TimeReading, name: str, findings: Findings
) -> tuple[dict[str, _Order], str, bool]:
    """The stamps in each order of day and month in which any can be read, the first one, and if they have offsets."""
    orders = {
        order: _Order([f"{day}{time}" for day, time in product(days, TIMES)])
        for order, days in ORDERS.items()
    }
    if how.time_format is not None:
        orders = {"asked for": _Order([how.time_format])}
    filled = with_offset = 0
    example, offset = "", ""
    for cells in blocks:
        words = [" ".join(cell.split()) for cell in cells]
        if how.time_format is None:
            words = [plain_date(word) for word in words]
            words = [DECIMAL.sub(r"\1.\2", word) if "," in word else word for word in words]
        offsets = [word for word in words if _has_offset(word)]
        filled, with_offset = filled + sum(map(bool, words)), with_offset + len(offsets)
        example, offset = example or words[0], offset or "".join(offsets[:1])
        words, late = from_midnight(words)
        for order in orders.values():
            order.read(words, bool(offsets), late)
        orders = {key: order for key, order in orders.items() if order.count} or orders
    if offset and with_offset < 0.9 * filled:
        findings.doubt(
            f"some times in column {name!r} have an offset from UTC such as {offset!r}, others have none"
        )
    return orders, example, bool(offset)


class _Order:
    """Reads stamps with one order of day and month, each in the first of its formats that fits."""

    def __init__(self, formats: Sequence[str]) -> None:
        self.formats = formats
        self.fitting: list[str] = []
        self.strange: set[str] = set()  # patterns of cells that none of the formats fits
        self.parts: list[Ticks] = []
        self.count = 0  # of stamps read

    def ticks(self) -> Ticks:
        """All that was read."""
        return np.concatenate(self.parts)

    def read(self, words: list[str], utc: bool, late: Any) -> None:
        """Read some rows; those that are `late` a day later than they say."""
        import pandas as pd

        ticks = np.full(len(words), NEVER)
        left = pd.Series(words, dtype=object)
        left = left[left != ""]
        tried = 0
        while len(left) and (tried < len(self.fitting) or self._find(left, utc)):
            stamps = _parsed(left, self.fitting[tried], utc)
            stamps = stamps[stamps.notna()]
            ticks[stamps.index] = ticks_of(stamps)
            left = left.drop(stamps.index)
            tried += 1
        self.count += int(np.count_nonzero(ticks != NEVER))
        if late is not None:
            ticks[late & (ticks != NEVER)] += int(DAY * 1e6)
        self.parts.append(ticks)

    def _find(self, left: Any, utc: bool) -> bool:
        """Add a format that fits one of the cells; two of each pattern of digits and letters stand for the others."""
        import pandas as pd

        if len(self.fitting) == MOST_FORMATS:
            return False
        kinds: dict[str, list[str]] = {}
        for cell in left.iloc[:50]:
            kinds.setdefault(LETTER.sub("a", DIGIT.sub("0", cell)), []).append(cell)
        ends = (" %z", "%z", "") if utc else ("",)
        for kind in [kind for kind in kinds if kind not in self.strange]:
            formats = self.formats
            if (
                len(formats) > 1
            ):  # those with the marks of the cell: pandas takes long to refuse each of the others
                formats = [form for form in formats if _marks(kind).startswith(_marks(form))]
            for cell, form, end in product((kinds[kind][0], kinds[kind][-1]), formats, ends):
                if form + end not in self.fitting and _parsed(cell, form + end, utc) is not pd.NaT:
                    self.fitting.append(form + end)
                    return True
            self.strange.add(kind)
        return False


def _marks(text: str) -> str:
    """What stands between the digits and words of a stamp or the fields of a format, without spaces."""
    return FIELD.sub("", text)


def _parsed(words: Any, form: str, utc: bool) -> Any:
    import pandas as pd

    try:
        return pd.to_datetime(words, format=form, errors="coerce", utc=utc)
    except (ValueError, re.error) as error:  # the latter of a field that stands twice
        raise MampcError(f"time_format: expected a format as strptime has it, received {error}") from None


def _has_offset(cell: str) -> bool:
    signed = cell[-1:] == "Z" or "+" in cell or "-" in cell[-6:]
    return signed and OFFSET.fullmatch(cell) is not None and DATE_ONLY.fullmatch(cell) is None


def ticks_of(stamps: Any) -> Ticks:
    """A pandas Series of stamps, those with a zone in UTC."""
    if stamps.dt.tz is not None:
        stamps = stamps.dt.tz_convert("UTC").dt.tz_localize(None)
    ticks: Ticks = stamps.to_numpy("datetime64[us]").view(np.int64)
    return ticks


def since_first(
    ticks: Ticks, in_utc: bool, how: TimeReading, sheet: Sheet, findings: Findings
) -> tuple[Array, Any]:
    """Seconds after the earliest stamp, and that stamp, in UTC where it has a zone."""
    if how.time_zone is not None and not in_utc:
        ticks, in_utc = _localised(ticks, how.time_zone, findings), True
    known = (ticks >= EARLIEST) & (ticks <= LATEST)
    if not known.any():
        return np.full(len(ticks), np.nan), None
    first = int(ticks[known].min())
    seconds = np.where(known, (ticks - first) / 1e6, np.nan)
    if in_utc:
        return seconds, _moment(first).replace(tzinfo=UTC)
    return clock_put_back(seconds, _moment(first), sheet, findings), _moment(first)


def _moment(ticks: int) -> datetime:
    return datetime(1970, 1, 1) + timedelta(microseconds=ticks)


def _localised(ticks: Ticks, zone: str, findings: Findings) -> Ticks:
    """Local stamps in their zone; of a doubled hour, the order of rows tells which is which."""
    import pandas as pd

    known = pd.Series(ticks[ticks != NEVER].view("datetime64[us]"))
    steps = known.diff().dt.total_seconds().to_numpy()[1:]
    backwards = bool((steps < 0).sum() > (steps > 0).sum())
    known = known.iloc[::-1] if backwards else known
    try:
        read = known.dt.tz_localize(zone, ambiguous="infer", nonexistent="NaT")
    except Exception as error:  # of pytz, and no ValueError, before pandas 3
        findings.doubt(f"the doubled hour at the end of summer time in {zone} cannot be told apart: {error}")
        read = known.dt.tz_localize(zone, ambiguous="NaT", nonexistent="NaT")
    localised = ticks.copy()
    localised[ticks != NEVER] = ticks_of(read.sort_index())
    return localised


def clock_put_back(seconds: Array, origin: datetime, sheet: Sheet, findings: Findings) -> Array:
    """Local time in the order of rows, with an hour added where the clock was put back an hour.

    It goes back by less where samples are missing just then: by half an hour at least, on a Sunday before four.
    """
    known = np.flatnonzero(~np.isnan(seconds))
    steps = np.diff(seconds[known])
    if (steps < 0).sum() > (steps > 0).sum():  # the newest first
        known, steps = known[::-1], -steps[::-1]
    if len(steps) < 3 or not (steps > 0).any() or origin.year == UNDATED.year:
        return seconds
    usual = float(np.median(steps[steps > 0]))
    straight = np.abs(steps - (usual - HOUR)) <= 0.3 * usual
    behind_gap = (steps > usual - HOUR) & (steps < -HOUR / 2)
    back = np.flatnonzero((straight | behind_gap) & (steps <= 0))
    if not 0 < len(back) <= 3 or (steps[np.setdiff1d(np.arange(len(steps)), back)] <= 0).mean() > 0.001:
        return seconds
    corrected = seconds.copy()
    for i in back:
        moment = origin + timedelta(seconds=float(seconds[known[i]]))
        if usual < HOUR and straight[i]:
            pass
        elif not (moment.weekday() == 6 and moment.hour <= 3):
            continue
        elif any(
            _same_cells(sheet, int(known[k]), int(known[i + 1]))
            for k in np.flatnonzero(seconds[known[: i + 1]] == seconds[known[i + 1]])
        ):
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
