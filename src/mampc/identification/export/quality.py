"""Columns that say whether the values beside them are good."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from mampc.base.checks import BoolArray
from mampc.base.errors import shown
from mampc.identification.export.cells import is_number, says_numbers
from mampc.identification.export.findings import Findings
from mampc.identification.export.header import UNIT
from mampc.identification.export.numbers import Column
from mampc.identification.export.sheet import Sheet

WORDS = (
    "quality", "qual", "opcquality", "status", "statuscode", "qualitycode", "validity", "confidence",
    "qualität", "qualitaet", "güte", "qualité", "calidad", "flag", "flags",
)  # fmt: skip
TRUTHS = ("good", "isgood", "valid", "isvalid")  # alone only where true or false stands under them
DENIALS = ("bad", "isbad", "questionable", "substituted")  # what is true under them is not good
BEHIND_A_NAME = (*WORDS, *TRUTHS, *DENIALS, "q", "qc", "st", "state", "conf")
DENIAL = re.compile(rf"^({'|'.join(DENIALS)})([\W_]|$)|[\W_]({'|'.join(DENIALS)})[\W_\d]*$")
VALUE = re.compile(r"[\W_]+(value|val|wert|valeur|valor)$")
TRUE_OR_FALSE = frozenset({"true", "false", "0", "1", "yes", "no", ""})
GOOD = frozenset({"good", "g", "ok", "valid", "normal", "raw", "gut", "bon", "true", "yes"})
# Behind "good", such as "Good, Annotated" or "Good [Non-Specific]", what does not take it back.
STILL_GOOD = re.compile(
    r"(\d+[ :-]+)?(good|gut|bon|ok)\b(?!.*\b(not|bad|questionable|uncertain|suspect|stale|substituted)\b).*"
)
SPOKEN = re.compile(
    r"(good|bad|uncertain|questionable|gut|schlecht|bon|mauvais)\b.*"
)  # cells that nothing but a quality holds
CODE = re.compile(r"\d+(\.0+)?")
OPC_GOOD = range(192, 256)  # the quality byte of OPC DA: its two highest bits are set
OPC_BAD = range(64)  # none of them is


def quality_columns(
    sheet: Sheet, columns: Mapping[str, int], measured: Collection[str] = ()
) -> dict[int, tuple[str, ...]]:
    """Which columns, by position, speak of which of the wanted ones, by name.

    "TI101.Quality" speaks of "TI101" and of "TI101.Value". "Quality", or any other name over words such as Good
    and Bad, speaks of all columns where it stands only once, else of its neighbour: the one on its left, but
    where the first one has no values there, the one on its right. Columns named as `measured` speak of none.
    """
    header, taken = sheet.header, set(columns.values())
    free = [at for at in range(len(header)) if at not in taken and not _measures(sheet, at, measured)]
    late = _spoken_later(sheet, free)
    found: dict[int, tuple[str, ...]] = {}
    general: dict[str, list[int]] = {}
    for at in free:
        names = tuple(name for name, place in columns.items() if _speaks_of(header[at], header[place]))
        if names:
            found[at] = names
        elif (at in late or _is_general(sheet, at)) and not _speaks_of_any(header, at):
            general.setdefault(_plain(header[at]), []).append(at)
    at_position = {position: name for name, position in columns.items()}
    for places in general.values():
        side = 1 if places[0] == 0 or not says_numbers(sheet.first(places[0] - 1)) else -1
        for at in places:
            if len(places) == 1:
                found[at] = tuple(columns)
            elif at + side in at_position:
                found[at] = (at_position[at + side],)
    return found


def is_quality(sheet: Sheet, at: int, measured: Collection[str] = ()) -> bool:
    """Whether a column speaks of others, by its name or its first cells."""
    return not _measures(sheet, at, measured) and (_is_general(sheet, at) or _speaks_of_any(sheet.header, at))


def _measures(sheet: Sheet, at: int, measured: Collection[str]) -> bool:
    """Whether it is named as measured, or numbers with fractions stand there, such as the quality of a product."""
    if sheet.header[at] in measured or UNIT.sub("", sheet.header[at]) in measured:
        return True
    if (
        sheet.header[at] == "status" and "solve_time_us" in sheet.header
    ):  # of decisions, as loops are recorded
        return True
    return any(is_number(cell) and not CODE.fullmatch(cell) for cell in sheet.first(at))


def _spoken_later(sheet: Sheet, free: Sequence[int]) -> set[int]:
    """Those of some columns that are empty at first and hold nothing but remarks on quality."""
    empty = [at for at in free if not any(sheet.first(at))]
    words: dict[int, set[str]] = {at: set() for at in empty}
    for part in sheet.chunks(empty) if empty else ():
        for at, cells in zip(empty, part, strict=True):
            words[at].update(cell.casefold() for cell in cells if cell) if isinstance(cells, list) else None
    return {at for at in empty if words[at] and all(map(SPOKEN.fullmatch, words[at]))}


def _is_remark(sheet: Sheet, at: int) -> bool:
    """Whether it is by a few cells alone that a column speaks of others: where it is empty nothing is said."""
    word = _plain(sheet.header[at])
    named = word in (*WORDS, *TRUTHS, *DENIALS) or _speaks_of_any(sheet.header, at)
    return not named and not any(sheet.first(at))


def _is_general(sheet: Sheet, at: int) -> bool:
    word, cells = _plain(sheet.header[at]), [cell.casefold() for cell in sheet.first(at)]
    if word in WORDS:
        return True
    if word in (*TRUTHS, *DENIALS):
        return TRUE_OR_FALSE.issuperset(cells)
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(SPOKEN.fullmatch(cell) for cell in filled)


def _speaks_of_any(header: Sequence[str], at: int) -> bool:
    return any(_speaks_of(header[at], name) for k, name in enumerate(header) if k != at)


def _speaks_of(word: str, name: str) -> bool:
    bare, word = UNIT.sub("", name).casefold(), word.casefold()
    for stem in {bare, VALUE.sub("", bare)} - {""}:
        for rest in (word.removeprefix(stem), word.removesuffix(stem)):
            if rest != word and re.search(r"^[\W_]|[\W_]$", rest) and _plain(rest) in BEHIND_A_NAME:
                return True
    return False


def drop_bad_quality(
    sheet: Sheet,
    columns: Sequence[Column],
    positions: Mapping[str, int],
    good: Iterable[str],
    measured: Collection[str],
    findings: Findings,
) -> None:
    """Leave no number whose quality is not known to be good.

    Args:
        sheet: the table.
        columns: its wanted columns, changed in place.
        positions: where they stand.
        good: further words that mean a good value.
        measured: columns that are no qualities, whatever they are called.
        findings: receives a doubt where no word is known.
    """
    by_name = {column.name: column for column in columns}
    taken: dict[tuple[str, ...], list[str]] = {}
    for at, names in quality_columns(sheet, positions, measured).items():
        words = [word.casefold() for word in sheet.words(at)]
        denies = DENIAL.search(sheet.header[at].casefold()) is not None
        named = [str(word).strip().casefold() for word in good]
        if _is_remark(sheet, at):
            named.append("")
        named += _in_numbers(sheet.header[at], words)
        is_good = _not_true(words) if denies else _good(words, named)
        if is_good is None:
            kinds = ", ".join(f"{shown(word)} ({count})" for word, count in Counter(words).most_common(5))
            findings.doubt(
                f"column {sheet.header[at]!r} seems to say which values of {', '.join(names)} are good, but not how: "
                f"{kinds}; name what is good in good (--good), or the column as one that says nothing of others "
                "(no_quality, --no-quality)"
            )
            continue
        for name in names:
            column = by_name[name]
            for i in np.flatnonzero(~is_good & ~np.isnan(column.values)):
                column.mark(f"quality {shown(words[i])}", int(sheet.numbers[i]))
            column.values[~is_good] = np.nan
        taken.setdefault(names, []).append(repr(sheet.header[at]))
    for names, said_by in taken.items():
        findings.note(
            f"column{'s' * (len(said_by) > 1)} {', '.join(said_by)} taken as the quality of {', '.join(names)}"
        )


def _in_numbers(name: str, words: Sequence[str]) -> tuple[str, ...]:
    """What means good by the last word of a name: true, certain in percent, or the only word there is."""
    last = ["", *re.findall(r"[^\W\d_]+", name.casefold())][-1]
    if last in TRUTHS or (last == "validity" and set(words) == {"1"}):
        return ("1",)
    return ("100",) if last in ("confidence", "conf") else ()


def _good(words: Sequence[str], named: Collection[str]) -> BoolArray | None:
    """Which words mean a good value; None if that cannot be told."""
    kinds = set(words)
    numbers = {word: int(float(word)) for word in kinds if CODE.fullmatch(word)}
    named = {word for word in named if word in kinds}
    of_opc = {word for word, number in numbers.items() if number in OPC_GOOD}
    if of_opc:  # a number named for another column is no good byte of this one
        named = {word for word in named if numbers.get(word) not in OPC_BAD}
    good = {word for word in kinds if word in GOOD or word in named or STILL_GOOD.fullmatch(word)}
    if not named:
        good |= of_opc
    if not good and len(kinds) == 1 and (kinds == {""} or set(numbers.values()) == {0}):
        good = kinds  # one word for all says nothing
    if not good and "" in kinds and not numbers:
        good = {""}  # a remark only where something is wrong
    if not good:
        return None
    return np.array([word in good for word in words])


def _not_true(words: Sequence[str]) -> BoolArray | None:
    """Where it is denied that the value is bad."""
    if not TRUE_OR_FALSE.issuperset(words):
        return None
    return np.array([word in ("false", "0", "no", "") for word in words])


def _plain(word: str) -> str:
    """Without the marks around it and a number behind it."""
    return re.sub(r"[\W_]+|[\W_]*\d+$", "", word.casefold())
