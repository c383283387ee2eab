"""Times that are numbers: in which unit, since when, or the digits of a clock."""

from __future__ import annotations

import re

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import shown
from mampc.identification.export.cells import POINT, clean, without_unit
from mampc.identification.export.findings import Findings
from mampc.identification.export.sheet import Sheet
from mampc.identification.export.stamps import SECONDS, TimeReading, unevenness

LATEST = 4.2e9  # seconds: larger numbers are hardly seconds
# What programs count since when: how many a second, and between which numbers the years 1994 to 2100 lie.
COUNTS = (
    ("milliseconds since 1970", 1e3, 0.75e12, LATEST * 1e3),
    ("microseconds since 1970", 1e6, 0.75e15, LATEST * 1e6),
    ("nanoseconds since 1970", 1e9, 0.75e18, LATEST * 1e9),
    ("100 ns since 1601, as Windows counts", 1e7, 1.24e17, 1.58e17),
    ("100 ns since the year 1, as .NET counts", 1e7, 6.29e17, 6.63e17),
    ("millionths of a day since 1900, as WinCC counts", 1e6 / 86400, 3.43e10, 7.31e10),
)
DAYS = ((36526.0, 73051.0), (730486.0, 767011.0))  # 2000 to 2100, counted as spreadsheets and as MATLAB do
# Seconds between samples that people choose; as parts of an hour or a day they are no round numbers.
USUAL = np.array([1, 2, 5, 10, 15, 20, 30, 60, 120, 180, 300, 600, 900, 1200, 1800, 3600, 7200])
WORDS_ONLY_ALONE = ("day", "second")  # "time of day" says nothing of a unit
WORDS_ONLY_LAST = ("us", "ns")  # nor does "US time"


def from_numbers(sheet: Sheet, at: int, how: TimeReading, findings: Findings) -> Array:
    """The times of a column of numbers, in seconds, shape (N,)."""
    name = sheet.header[at]
    values, behind = _values(sheet, at)
    unit = behind or how.time_unit or _unit(sheet, at)
    if unit in SECONDS:
        if SECONDS[unit] != 1.0:
            findings.note(f"times in column {name!r} are in {unit}")
        return values if behind else values * SECONDS[unit]
    known = values[~np.isnan(values)]
    least, most = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    usual = float(np.median(np.abs(np.diff(known)))) if len(known) > 1 else 0.0
    digits = _digits_of_a_clock(known)
    for counted, size, first, last in COUNTS:
        if first < most < last and not digits:
            findings.note(f"times in column {name!r} are taken as {counted}")
            return (values - least) / size + least / size
    if unit and most < COUNTS[0][2] / 1e3:
        findings.doubt(
            f"times in column {name!r} are in {shown(unit)}; expected one of ns, us, ms, s, min, h, d (--time-unit)"
        )
    elif most > LATEST:
        findings.doubt(
            f"times in column {name!r} are numbers as large as {most:.15g}; pass their unit (--time-unit) or their "
            "format (--time-format '%Y%m%d%H%M%S')"
        )
    elif digits:
        findings.doubt(
            f"times in column {name!r} are numbers such as {known[0]:.15g}, whose digits seem to be those of a clock; "
            "pass their format (--time-format '%H%M%S'), or their unit (--time-unit s)"
        )
    elif any(first < least and most < last for first, last in DAYS) and 0 < usual <= 1:
        findings.doubt(
            f"times in column {name!r} are numbers from {least:.10g} to {most:.10g}, seconds or days of a spreadsheet; "
            "pass their unit (--time-unit s, --time-unit d)"
        )
    elif _is_part_of_a_day(usual):
        findings.doubt(
            f"times in column {name!r} are numbers in steps of {usual:.6g}, parts of a second, an hour or a day; "
            "pass their unit (--time-unit s, --time-unit h, --time-unit d)"
        )
    else:
        findings.note(f"times in column {name!r} are numbers, taken as seconds")
    return values


def _values(sheet: Sheet, at: int) -> tuple[Array, str]:
    """The numbers; those with a unit of time behind them in seconds, and what that unit is."""
    values, behind = np.empty(len(sheet)), ""
    start = 0
    for [cells] in sheet.chunks([at]):
        part = values[start : start + len(cells)]
        start += len(cells)
        if not isinstance(cells, list):
            part[:] = cells
            continue
        for i, cell in enumerate(cells):
            number, unit = without_unit(clean(cell).replace(",", "."))
            scale = SECONDS.get(unit, np.nan) if unit else 1.0
            part[i] = scale * float(number) if POINT.fullmatch(number) else np.nan
            behind = behind or unit
    return values, behind


def _unit(sheet: Sheet, at: int) -> str:
    """The unit under or behind a name, or the last word of it that is one, such as in "Elapsed minutes"."""
    unit = sheet.units.get(at, "").casefold().rstrip(".")
    words = re.findall(r"[^\W\d_]+", sheet.header[at].casefold())
    named = [
        word
        for word in words
        if word in SECONDS
        and (word not in WORDS_ONLY_ALONE or len(words) == 1)
        and (word not in WORDS_ONLY_LAST or word == words[-1])
    ]
    return unit or (named[-1] if named else "")


def _digits_of_a_clock(known: Array) -> bool:
    """Whether numbers such as 95959 and 100000, or 9.59 and 10.00, are even steps only if read as hours and minutes."""
    stray = unevenness(known)
    if not stray:
        return False
    for scale in (1, 100):
        whole = np.round(known * scale)
        seconds, minutes = whole % 100, whole // 100 % 100
        if np.abs(whole - known * scale).max() > 1e-4 or max(seconds.max(), minutes.max()) >= 60:
            continue
        if unevenness((whole // 10_000 * 60 + minutes) * 60 + seconds) < stray / 2:
            return True
    return False


def _is_part_of_a_day(usual: float) -> bool:
    """Whether a step is an odd number that is a usual one as a part of an hour or a day."""
    if not 0 < usual < 0.5 or abs(float(f"{usual:.2g}") / usual - 1) < 1e-3:
        return False
    return any(bool((np.abs(usual * span / USUAL - 1) < 1e-3).any()) for span in (3600.0, 86400.0))
