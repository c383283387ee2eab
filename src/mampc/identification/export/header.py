"""Which row of a file is its header, and what the columns are called."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Sequence
from typing import TypeAlias

from mampc.base.errors import shown
from mampc.identification.export.cells import SPACES
from mampc.identification.export.findings import Findings

UNIT = re.compile(r"\s*[\[(]\s*([^\[\]()]*?)\s*[\])]\s*$")

NOT_UTF_8 = "text is not UTF-8: read as Windows-1252 (Western European)"
HIDDEN = "hidden worksheets left out"
NUMBER_LIKE = re.compile(
    rf"[+\-−]?[\d.,]*\d[\d.,]*((?:{SPACES}| )\d{{3}}[.,\d]*)*([eEdD][+\-]?\d+)?", re.ASCII
)
RULE = re.compile(r"[-=+|_─]{2,}")
DATE = re.compile(r"\d+[-/.]\w+[-/.]\d+$")
REMARK = re.compile(r"%|#(?!N/A|REF!|VALUE!|DIV/0!|NAME\?|NUM!|NULL!)")  # spreadsheets' errors are cells

Row: TypeAlias = tuple[int, list[str]]  # its number in the file, its cells


def find_column(header: Sequence[str], name: str) -> int | None:
    """The position of a name in a header, exactly or without the unit behind it; None unless there is one."""
    for known in (list(header), [UNIT.sub("", word) for word in header]):
        if known.count(name) == 1:
            return known.index(name)
        if name in known:
            return None
    return None


def header_units(header: Sequence[str]) -> dict[int, str]:
    found = {at: UNIT.search(name) for at, name in enumerate(header)}
    return {at: match.group(1) for at, match in found.items() if match}


def require_columns(
    header: Sequence[str], names: Sequence[str], findings: Findings, cells: Collection[str] = ()
) -> None:
    """Raise `MampcError` unless each name stands once in the header; `cells` are some of those under it."""
    missing = [name for name in names if find_column(header, name) is None]
    if not missing:
        return
    alike = {word.casefold(): word for word in header}
    guesses = {
        name: alike.get(name.casefold())
        or next(iter(difflib.get_close_matches(name, header, n=1)), None)
        or next((word for word in header if len(name) > 1 and word.startswith(name)), None)
        for name in missing
        if name not in header
    }
    hints = [f"did you mean {guess!r} for {name!r}?" for name, guess in guesses.items() if guess]
    hints += [
        f"{NOT_UTF_8}, unless its encoding is passed (--encoding)"
        for note in findings.notes
        if note == NOT_UTF_8
    ]
    hints += [note for note in findings.notes if note.startswith(HIDDEN)]
    if any(name in header for name in missing):
        hints.append("a name that stands twice says nothing: rename columns")
    elif all(name in cells for name in missing):
        hints.append("they stand in its rows: save one column a signal, as a pivot table does")
    wanted = " and one ".join(repr(name) for name in missing)
    findings.doubt(
        "; ".join([f"expected one column {wanted}, received columns {shown(list(header), 400)}", *hints])
    )
    findings.require_none()


def remarks_last(head: Sequence[Row]) -> list[Row]:
    """Rows among which a header is looked for: those behind a # or % come last, without it and then with it."""
    marked = [(number, row) for number, row in head if REMARK.match(row[0])]
    bare = [(number, [row[0].lstrip("#% "), *row[1:]]) for number, row in marked]
    return [
        *(line for line in head if line not in marked),
        *((number, row if row[0] else row[1:]) for number, row in bare if any(row)),
        *marked,
    ]


def fitted_header(
    header: tuple[str, ...],
    under: Sequence[Row],
    separator: str | None,
    names: Sequence[str],
    findings: Findings,
) -> tuple[str, ...]:
    """The header as wide as the rows under it.

    R leaves out the name above the numbers of rows; LabVIEW names a last column that no row has; between spaces,
    dates and times have one name. Not between commas, which may stand in names and numbers too.
    """
    rows = [row for _, row in under if any(map(is_number_like, row[1:]))]
    widths = {len(row) for row in rows}
    if len(widths) != 1 or separator == ",":
        return header
    [width] = widths
    counts = [str(k) for k in range(1, len(rows) + 1)]
    if width == len(header) + 1 and [row[0] for row in rows] == counts:
        findings.note("the first column has no name: taken as numbers of rows")
        return ("", *header)
    if (
        separator == " "
        and width == len(header) + 1
        and all(DATE.match(row[0]) and ":" in row[1] for row in rows)
    ):
        findings.note(f"a date and a time stand under the name {header[0]!r}")
        return (header[0], f"{header[0]} of day", *header[1:])
    left = header[:width]
    known = all(find_column(left, name) is not None for name in names)
    if separator not in (None, " ") and len(left) < len(header) and known:
        findings.note(
            f"the header has more names than rows have fields; left out: {', '.join(header[width:])}"
        )
        return left
    return header


def header_with(head: Sequence[Row], names: Sequence[str]) -> int | None:
    """The row in which all names stand: the last one before numbers stand under them."""
    found: int | None = None
    at: list[int] = []
    for i, (number, row) in enumerate(head):
        if found is not None and number <= head[found][0]:
            continue  # the same one with the # before it
        if any(is_number_like(row[k]) for k in at if k < len(row)):
            break
        plain = [UNIT.sub("", cell) for cell in row]
        if len(row) > 1 and all(name in plain or name in row for name in names):
            found, at = i, [(row if name in row else plain).index(name) for name in names]
    return found


def joined_names(pair: Sequence[Row]) -> tuple[str, ...] | None:
    """Names out of two rows, such as "TI-1.PV"; an empty cell of the upper one goes on with what stands left of it."""
    if len(pair) < 2 or any(is_number_like(cell) for _, row in pair for cell in row):
        return None
    lower = without_empty_end(pair[1][1])
    upper = [*pair[0][1], *([""] * len(lower))][: len(lower)]
    if sum(map(bool, upper)) < 2:
        return None
    names, last = [], ""
    for one, other in zip(upper, lower, strict=True):
        last = one or last
        names.append(f"{last}.{other}" if last and other else last or other)
    return tuple(names)


def likelihood(separator: str | None, head: Sequence[Row]) -> tuple[bool, bool, int]:
    """How likely fields are parted right: not by spaces, which stamps and words have too, unless nothing else parts
    them; with a header for most rows; and in how many cells.
    """
    even = _evenness(head)
    headed = even > 0 and len(without_empty_end(head[likeliest_header(head)][1])) > 1
    return separator != " " and even > 0, headed, even


def likeliest_header(head: Sequence[Row]) -> int:
    """The first row of words that is as wide as most rows, or one that says the same again; else the first row."""
    widths = [len(without_empty_end(row)) for _, row in head]
    usual = max(set(widths), key=lambda width: (widths.count(width) * width, width))
    found = None
    for i, (_, row) in enumerate(head):
        if any(is_number_like(cell) for cell in row):
            if found is not None and widths[i] >= usual:
                break
        elif widths[i] >= usual > 1 and (found is None or _same_names(head[found][1], row)):
            found = i
    return 0 if found is None else found


def _same_names(one: Sequence[str], other: Sequence[str]) -> bool:
    """Whether all cells but the first are the same."""
    return len(set(one[1:])) > 1 and list(one[1:]) == list(other[1:])


def _evenness(head: Sequence[Row]) -> int:
    """How many cells stand in rows of the most frequent width above one."""
    widths = [len(row) for _, row in head if len(row) > 1]
    return max((widths.count(width) * width for width in set(widths)), default=0)


def without_empty_end(row: Sequence[str]) -> tuple[str, ...]:
    width = max(i + 1 for i, cell in enumerate(row) if cell)
    return tuple(row[:width])


def is_number_like(cell: str) -> bool:
    return NUMBER_LIKE.fullmatch(cell) is not None
