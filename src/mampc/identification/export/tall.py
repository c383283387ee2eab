"""Tall tables, which have a row for every value: tag, time, value, quality. They become one column a tag."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np

from mampc.base.errors import MampcError, shown
from mampc.identification.export.clock import time_columns
from mampc.identification.export.findings import Findings
from mampc.identification.export.quality import is_quality
from mampc.identification.export.sheet import Cells, Sheet, open_sheet
from mampc.identification.export.stamps import TimeReading

TAGS = (
    "tag", "tagname", "name", "varname", "variable", "point", "pointname", "signal", "item", "itemname", "sensor",
    "field",
)  # fmt: skip
VALUES = ("value", "val", "varvalue", "wert", "valeur", "valor", "valore", "waarde")
UNITS = ("unit", "units", "unitsabbreviation", "eu", "engunits", "einheit", "unité", "unidad")
MOST_TAGS = 2000


def open_table(
    source: Any,
    names: Sequence[str],
    how: TimeReading,
    findings: Findings,
    encoding: str | None = None,
    measured: Collection[str] = (),
) -> Sheet:
    """The table in a file, as `open_sheet` has it, tall ones with one column a tag.

    Args:
        source: a path, or a pandas DataFrame.
        names: columns that must be there; none, to take all.
        how: the time column is read.
        findings: receives notes and doubts.
        encoding: of a text; None to see it from its bytes.
        measured: columns that are no qualities, whatever they are called.

    Raises:
        MampcError: no such file, or nothing in it that could be such a table.
    """
    trial = Findings(findings.origin)
    try:
        sheet = open_sheet(source, names, trial, encoding)
    except MampcError as error:
        tall = _tall(source, names, how, findings, encoding, measured) if trial.doubts else None
        if tall is None:
            raise error from None
        return tall
    if not names and _named(sheet.header, TAGS) is not None:
        tall = _tall(source, names, how, findings, encoding, measured)
        if tall is not None:
            return tall
    findings.take(trial)
    return sheet


def _tall(
    source: Any,
    names: Sequence[str],
    how: TimeReading,
    findings: Findings,
    encoding: str | None,
    measured: Collection[str],
) -> Sheet | None:
    """A tall table as one with a column a tag; None where it is none."""
    trial = Findings(findings.origin)
    try:
        sheet = open_sheet(source, (), trial, encoding)
    except MampcError:
        return None
    tags = _tag_column(sheet, names)
    if tags is None:
        return None
    others = [at for at in range(len(sheet.header)) if at != tags]
    quality = [at for at in others if is_quality(sheet, at, measured)]
    value = _named(sheet.header, VALUES)
    times = time_columns(
        sheet, [tags, *quality, *([] if value is None else [value])], how, Findings(findings.origin)
    )
    if value is None:
        left = [at for at in others if at not in (*quality, *times) and sheet.header[at]]
        value = left[0] if len(left) == 1 else None
    if value is None or not times:
        return None
    findings.take(trial)
    findings.note(
        f"a row for every value: names stand in column {shown(sheet.header[tags])}, values in column "
        f"{shown(sheet.header[value])}; put side by side, one row a time, which has the number of its first row"
    )
    return _pivoted(sheet, names, tags, value, times, quality)


def _tag_column(sheet: Sheet, names: Sequence[str]) -> int | None:
    """The one column in which all names stand as cells; without names, the one that is called so."""
    if not names:
        at = _named(sheet.header, TAGS)
        if at is None or _named(sheet.header, VALUES) is None:
            return None
        return at if 1 < len(set(sheet.words(at))) <= MOST_TAGS else None
    found = [at for at in range(len(sheet.header)) if set(names) <= set(sheet.words(at))]
    return found[0] if len(found) == 1 else None


def _pivoted(
    sheet: Sheet, names: Sequence[str], tags: int, value: int, times: Sequence[int], quality: Sequence[int]
) -> Sheet:
    """One row for each time, in the order in which times come up; a second value of a tag then has a row of its own."""
    tag_cells, columns = sheet.words(tags), [sheet.words(at) for at in (*times, value, *quality)]
    stamps = list(zip(*columns[: len(times)], strict=True))
    wanted = list(dict.fromkeys(names)) or sorted(set(tag_cells) - {""})
    place = {tag: k for k, tag in enumerate(wanted)}
    rows: dict[tuple[tuple[str, ...], int], int] = {}
    seen: dict[tuple[str, tuple[str, ...]], int] = {}
    numbers: list[int] = []
    cells: list[tuple[int, int, int]] = []  # row, tag, where it comes from
    for i, (tag, stamp) in enumerate(zip(tag_cells, stamps, strict=True)):
        if tag not in place:
            continue
        again = seen.get((tag, stamp), 0)
        seen[tag, stamp] = again + 1
        row = rows.setdefault((stamp, again), len(rows))
        if row == len(numbers):
            numbers.append(int(sheet.numbers[i]))
        cells.append((row, place[tag], i))
    values = columns[len(times) :]
    header = [sheet.header[at] for at in times]
    table = [[stamp[k] for stamp, _ in rows] for k in range(len(times))]
    for kind, source in enumerate(values):
        filled = [[""] * len(rows) for _ in wanted]
        for row, tag_at, i in cells:
            filled[tag_at][row] = source[i]
        table += filled
        header += [tag if kind == 0 else f"{tag}.{sheet.header[quality[kind - 1]]}" for tag in wanted]

    def chunks(at: Sequence[int]) -> Iterator[list[Cells]]:
        yield [table[column] for column in at]

    sample = [list(row) for row in zip(*(column[:50] for column in table), strict=True)]
    units = _units(sheet, tag_cells, wanted, len(times))
    return Sheet(tuple(header), units, np.array(numbers, dtype=np.int64), chunks, sheet.separator, sample)


def _units(sheet: Sheet, tags: Sequence[str], wanted: Sequence[str], first: int) -> dict[int, str]:
    at = _named(sheet.header, UNITS)
    if at is None:
        return {}
    known = dict(zip(tags, sheet.words(at), strict=True))
    return {first + k: known[tag] for k, tag in enumerate(wanted) if known.get(tag)}


def _named(header: Sequence[str], words: Sequence[str]) -> int | None:
    """The position of the first of these words that stands in a header."""
    plain = ["".join(filter(str.isalpha, name.casefold())) for name in header]
    return next((plain.index(word) for word in words if word in plain), None)
