"""Columns that say whether the values beside them are good."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from mampc.base.checks import BoolArray
from mampc.base.errors import shown
from mampc.identification.export.findings import Findings
from mampc.identification.export.header import UNIT
from mampc.identification.export.numbers import Column
from mampc.identification.export.sheet import Cells, Sheet

WORDS = ("quality", "qual", "opcquality", "status", "validity", "qualität", "qualitaet", "qualité", "calidad")
BEHIND_A_NAME = (*WORDS, "q", "qc", "st", "state", "flag", "good", "valid")
GOOD = frozenset({"good", "g", "ok", "valid", "normal", "raw", "gut", "bon", "true", "yes"})
# Behind "good", such as "Good, Annotated" or "Good [Non-Specific]", what does not take it back.
STILL_GOOD = re.compile(
    r"(\d+ )?(good|gut|bon|ok)\b(?!.*\b(not|bad|questionable|uncertain|suspect|stale|substituted)\b).*"
)
OPC_GOOD = range(192, 256)  # the quality byte of OPC DA: its two highest bits are set


def quality_columns(header: Sequence[str], columns: Mapping[str, int]) -> dict[int, tuple[str, ...]]:
    """Which columns, by position, speak of which of the wanted ones, by name.

    "TI101.Quality" speaks of "TI101", "Quality" of the column on its left, or of all where it stands
    only once.
    """
    taken = set(columns.values())
    general = [at for at, word in enumerate(header) if at not in taken and _plain(word) in WORDS]
    found: dict[int, tuple[str, ...]] = {
        at: (name,)
        for at, word in enumerate(header)
        if at not in taken and at not in general
        for name, position in columns.items()
        if _speaks_of(word, header[position])
    }
    if len(general) == 1:
        found[general[0]] = tuple(columns)
    elif general:
        left = {position: name for name, position in columns.items()}
        found |= {at: (left[at - 1],) for at in general if at - 1 in left}
    return found


def is_quality(header: Sequence[str], at: int) -> bool:
    """Whether a column speaks of others, by its name."""
    return _plain(header[at]) in WORDS or any(_speaks_of(header[at], name) for name in header)


def _speaks_of(word: str, name: str) -> bool:
    bare = UNIT.sub("", name).casefold()
    rest = word.casefold().removeprefix(bare)
    return rest != word.casefold() and re.match(r"[\W_]", rest) is not None and _plain(rest) in BEHIND_A_NAME


def drop_bad_quality(
    sheet: Sheet,
    columns: Sequence[Column],
    positions: Mapping[str, int],
    good: Iterable[str],
    findings: Findings,
) -> tuple[int, ...]:
    """Leave no number whose quality is not known to be good; returns the columns that say so.

    Args:
        sheet: the table.
        columns: its wanted columns, changed in place.
        positions: where they stand.
        good: further words that mean a good value.
        findings: receives a doubt where no word is known.
    """
    by_name = {column.name: column for column in columns}
    speaking = quality_columns(sheet.header, positions)
    for at, names in speaking.items():
        words = _words(sheet.column(at))
        is_good = _good(words, [str(word).strip().casefold() for word in good])
        if is_good is None:
            kinds = ", ".join(f"{shown(word)} ({count})" for word, count in Counter(words).most_common(5))
            findings.doubt(
                f"column {sheet.header[at]!r} seems to say which values of {', '.join(names)} are good, but not how: "
                f"{kinds}; name what is good in good (--good)"
            )
            continue
        for name in names:
            column = by_name[name]
            for i in np.flatnonzero(~is_good & ~np.isnan(column.values)):
                column.mark(f"quality {shown(words[i])}", int(sheet.numbers[i]))
            column.values[~is_good] = np.nan
        findings.note(f"column {sheet.header[at]!r} taken as the quality of {', '.join(names)}")
    return tuple(speaking)


def _good(words: Sequence[str], named: Sequence[str]) -> BoolArray | None:
    """Which words mean a good value; None if that cannot be told."""
    kinds = set(words)
    numbers = {word: int(float(word)) for word in kinds if re.fullmatch(r"\d+(\.0+)?", word)}
    good = {word for word in kinds if word in GOOD or word in named or STILL_GOOD.fullmatch(word)}
    if not named:
        good |= {word for word, number in numbers.items() if number in OPC_GOOD}
    if not good and len(kinds) == 1 and (kinds == {""} or set(numbers.values()) == {0}):
        good = kinds  # one word for all says nothing
    if not good and "" in kinds and not numbers:
        good = {""}  # a remark only where something is wrong
    if not good:
        return None
    return np.array([word in good for word in words])


def _plain(word: str) -> str:
    """Without the marks around it and a number behind it."""
    return re.sub(r"[\W_]+|[\W_]*\d+$", "", word.casefold())


def _words(cells: Cells) -> list[str]:
    if isinstance(cells, list):
        return [cell.casefold() for cell in cells]
    return ["" if cell != cell else f"{cell:g}" for cell in cells.tolist()]
