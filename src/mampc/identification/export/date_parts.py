"""Moments whose hours, minutes and seconds stand in columns of their own, beside a date or its parts."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from mampc.identification.export.cells import clean
from mampc.identification.export.header import UNIT
from mampc.identification.export.sheet import Sheet, words_of

# What such columns are called, and the whole numbers that stand in them.
PARTS = {
    "year": (range(1900, 2200), ("year", "yyyy", "jahr", "année", "año", "anno", "ano", "jaar")),
    "month": (range(1, 13), ("month", "monat", "mois", "mes", "mês", "mese", "maand")),
    "day": (range(1, 32), ("day", "dd", "tag", "jour", "día", "dia", "giorno", "dag")),
    "day of year": (range(1, 367), ("dayofyear", "doy", "jday", "julianday")),
    "hour": (range(25), ("hour", "hours", "hr", "hh", "stunde", "heure", "hora", "ora", "uur")),
    "minute": (range(60), ("minute", "minutes", "min", "minuto", "minuut")),
    "second": (range(60), ("second", "seconds", "sec", "sekunde", "seconde", "segundo", "secondo")),
}  # fmt: skip
DATES = (("year", "month", "day"), ("year", "day of year"))


def part_columns(sheet: Sheet, free: Collection[int], dates: Sequence[int]) -> tuple[int, ...]:
    """Positions of the date, or of its parts, then of hours, and of minutes and seconds where there are any.

    Nothing where there is not one date, or no hour beside it.
    """
    found: dict[str, int] = {}
    for at in free:
        part = _part(sheet, at)
        if part is not None:
            found.setdefault(part, at)
    if "hour" not in found:
        return ()
    clock = [found[part] for part in ("hour", "minute", "second") if part in found]
    for parts in DATES if not dates else ():
        if all(part in found for part in parts):
            return (*(found[part] for part in parts), *clock)
    return (dates[0], *clock) if len(dates) == 1 else ()


def has_parts(sheet: Sheet, columns: Sequence[int]) -> bool:
    """Whether such columns are among these."""
    return any(_part(sheet, at) == "hour" for at in columns)


def part_words(sheet: Sheet, columns: Sequence[int]) -> Iterator[list[str]]:
    """Stamps made of such columns, some rows at a time."""
    parts = [_part(sheet, at) for at in columns]
    hour = parts.index("hour")
    for cells in sheet.chunks(columns):
        yield [_stamp(row, hour) for row in zip(*map(words_of, cells), strict=True)]


def _stamp(cells: Sequence[str], hour: int) -> str:
    """ISO's stamp, with the day of the year where only that is told; nothing where a cell is empty."""
    if not all(cells):
        return ""
    words = [_whole(cell) for cell in cells]
    date = words[0] if hour == 1 else "-".join([words[0], *(word.zfill(5 - hour) for word in words[1:hour])])
    clock = [word.zfill(2) for word in words[hour:]]
    return f"{date} {':'.join(clock if len(clock) > 1 else [*clock, '00'])}"


def _whole(cell: str) -> str:
    head, _, tail = clean(cell).partition(".")
    return clean(cell) if tail.strip("0") else head


def _part(sheet: Sheet, at: int) -> str | None:
    """What a column tells, by its name and the numbers under it; seconds may have parts."""
    name = "".join(filter(str.isalpha, UNIT.sub("", sheet.header[at]).casefold()))
    part = next((part for part, (_, words) in PARTS.items() if name in words), None)
    if part is None:
        return None
    cells = [_whole(cell) for cell in sheet.first(at) if cell]
    whole = [cell.partition(".")[0] if part == "second" else cell for cell in cells]
    fits = cells and all(cell.isdecimal() and int(cell) in PARTS[part][0] for cell in whole)
    return part if fits else None
