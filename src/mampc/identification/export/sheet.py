"""Rows of cells under a header, whether they come from text, a spreadsheet, a Parquet file or a data frame."""

from __future__ import annotations

import re
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from mampc.base.errors import MampcError, shown
from mampc.base.files import read_bounded
from mampc.identification.export.cell_words import without_unit
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.header import (
    REMARK,
    RULE,
    Row,
    find_column,
    fitted_header,
    header_units,
    header_with,
    is_number_like,
    joined_names,
    likeliest_header,
    likelihood,
    remarks_last,
    require_columns,
    without_empty_end,
)
from mampc.identification.export.text import FILE_LIMIT, KIND, ZIP, Rows, encoding_of, text_rows, unpacked
from mampc.identification.export.workbook import read_parquet, read_workbook

if TYPE_CHECKING:
    import pandas as pd

SEPARATORS = ",;\t| "
HEAD = 200  # rows among which the header is looked for

# Words as they stand, numbers, or a pandas Series of times.
Cells: TypeAlias = "list[str] | npt.NDArray[Any] | pd.Series"


@dataclass(frozen=True, eq=False)
class Sheet:
    """Named columns of cells.

    Attributes:
        header: of every column; a name may stand there twice.
        units: of columns, where the file has a row of units or the name ends in one, such as "level [m]".
        numbers: of the rows in the file, for messages; shape (N,).
        chunks: yields the cells of the columns at some positions, a list of `Cells` for consecutive rows.
        separator: of fields, where they are text.
    """

    header: tuple[str, ...]
    units: dict[int, str]
    numbers: npt.NDArray[np.int64]
    chunks: Callable[[Sequence[int]], Iterator[list[Cells]]]
    separator: str | None = None
    sample: list[list[str]] = field(default_factory=list)  # the first rows, as words

    def __len__(self) -> int:
        return len(self.numbers)

    def column(self, at: int) -> Cells:
        """All cells of one column."""
        parts = [part for [part] in self.chunks([at])]
        if len(parts) == 1:
            return parts[0]
        return [cell for part in parts for cell in part]


def open_sheet(source: Any, names: Sequence[str], findings: Findings, encoding: str | None = None) -> Sheet:
    """The table in a file, or in a pandas DataFrame.

    Args:
        source: a path, or the frame.
        names: columns that must be there, by which the header is known; none, to take the likeliest row.
        findings: receives notes and doubts.
        encoding: of a text; None to see it from its bytes.

    Raises:
        MampcError: no such file, or nothing in it that could be such a table.
    """
    from mampc.identification.export.frame import frame_sheet

    if not isinstance(source, (str, Path)):
        return frame_sheet(source, names, findings)
    content = unpacked(source, read_bounded(source, FILE_LIMIT, KIND), findings)
    if content.startswith(b"PAR1"):
        return frame_sheet(read_parquet(source, content), names, findings)
    if content.startswith(ZIP):
        worksheets = read_workbook(source, content)
        return _row_sheet([(None, rows) for rows in worksheets], names, findings)
    if content.startswith(b"\xd0\xcf\x11\xe0"):
        raise MampcError(
            f"{source}: expected a readable {KIND}, received an old Excel file; save it as .xlsx"
        )
    if content.startswith(b"7z\xbc\xaf"):
        raise MampcError(f"{source}: expected a readable {KIND}, received an archive; unpack it first")
    if content[:100].lstrip(b"\xef\xbb\xbf \r\n\t").startswith(b"<"):
        raise MampcError(
            f"{source}: expected a readable {KIND}, received HTML or XML; save it as .xlsx or CSV"
        )
    whole, content = len(content), content.rstrip(b"\0") if content.endswith(bytes(8)) else content
    if len(content) < whole:
        findings.note(f"{whole - len(content)} bytes of nothing at the end of the file left out")
    encoding = encoding_of(source, content, encoding, findings)
    return _row_sheet(
        [(separator, text_rows(content, encoding, separator, source)) for separator in SEPARATORS],
        names,
        findings,
    )


def _row_sheet(
    readings: Sequence[tuple[str | None, Rows]],
    names: Sequence[str],
    findings: Findings,
) -> Sheet:
    """The table in rows, read in the one of several ways that has the wanted columns."""
    heads = []
    for separator, rows in readings:
        head = [(number, _stripped(row)) for number, row in next(rows(), [])[:HEAD]]
        head = remarks_last([(number, row) for number, row in head if any(row)])
        heads.append((separator, rows, head))
    if not any(head for _, _, head in heads):
        raise MampcError(
            f"{findings.origin}: expected a header and at least one row of numbers, received 0 rows"
        )
    found = None
    if names:
        fits = [
            (s, rows, head, at) for s, rows, head in heads if (at := header_with(head, names)) is not None
        ]
        found = fits[0] if fits else None
        if len(fits) > 1 and readings[0][0] is None:
            findings.doubt(
                f"expected one worksheet with these columns, received {len(fits)} of them; save the wanted ones as "
                "files of their own"
            )
    if found is None:
        separator, rows, head = max(heads, key=likelihood)
        found = separator, rows, head, likeliest_header(head)
    separator, rows, head, at = found
    header_number, header_row = head[at]
    first, header = header_number, without_empty_end(header_row)
    if not all(find_column(header, name) is not None for name in names or header):
        for k in (at - 1, at):
            joined = joined_names(head[k : k + 2]) if k >= 0 else None
            if joined and all(
                find_column(joined, name) is not None for name in names or filter(None, joined)
            ):
                first, header_number, header = head[k][0], head[k + 1][0], joined
                findings.note(f"names of columns stand in two rows: joined, such as {shown(joined[-1])}")
                break
    above = sorted({number: row for number, row in head if number < first}.items())
    if above:
        findings.note(
            f"{rows_text([number for number, _ in above])} before the header left out: "
            f"{shown(' '.join(cell for cell in above[0][1] if cell))}"
        )
    if names:
        require_columns(header, names, findings, {cell for _, row in head[at:] for cell in row})
    header = fitted_header(
        header, [line for line in head if line[0] > header_number], separator, names, findings
    )
    return _measured(rows, separator, header_number, header, names, findings)


def _measured(
    rows: Rows,
    separator: str | None,
    header_number: int,
    header: tuple[str, ...],
    names: Sequence[str],
    findings: Findings,
) -> Sheet:
    """Go through all rows once: which are data, which are the header's, which have cells missing or too many."""
    width = len(header)
    positions = [at for name in names if (at := find_column(header, name)) is not None] or list(range(width))
    numbers = array("q")
    descriptions: list[tuple[int, list[str]]] = []
    ragged: list[tuple[int, list[str]]] = []
    lines: list[int] = []
    remarks: list[int] = []
    hollow: dict[int, str] = {}  # rows with fewer fields and no number: all their values are missing
    broken: list[int] = []
    repeated: list[int] = []
    sample: list[list[str]] = []
    previous = header_number
    for number, row in chain.from_iterable(_from(rows, header_number)):
        before, previous = previous, number
        tall = number - before > 1 and any("\n" in cell or "\r" in cell for cell in row)
        if len(row) != width:
            cells = _stripped(row)
            if not any(cells):
                continue
            if RULE.fullmatch("".join(cells)):
                lines.append(number)
                continue
            if REMARK.match(cells[0]):
                remarks.append(number)
                continue
            if len(cells) < width and numbers and not any(map(is_number_like, cells)):
                hollow[number] = " ".join(cells).strip()
                numbers.append(number)
                continue
            if len(cells) < width or any(cells[width:]):
                ragged.append((number, cells))
                continue
        if tall:
            broken.append(number)
        if len(sample) < 50:
            cells = _stripped(row)
            if not numbers and not any(is_number_like(without_unit(cells[at])[0]) for at in positions):
                descriptions.append((number, cells))
                continue
            sample.append(cells[:width])
        if row[0] == header[0] and tuple(_stripped(row))[:width] == header:
            repeated.append(number)
            continue
        if repeated and before == repeated[-1] and _stripped(row) in [cells for _, cells in descriptions]:
            repeated.append(number)  # what stands under the header
            continue
        numbers.append(number)
    footer: list[int] = []
    while numbers and numbers[-1] in hollow:
        footer.insert(0, numbers.pop())
    if footer:
        findings.note(f"{rows_text(footer)} after the table left out: {shown(hollow[footer[-1]])}")
    if remarks:
        findings.note(f"remarks behind a # in {rows_text(remarks)} left out")
    skipped = frozenset(
        [*repeated, *lines, *remarks, *footer, *(number for number, _ in [*descriptions, *ragged])]
    )
    names_in = f"the names stand in row {header_number}"
    if len(ragged) == 1:
        findings.doubt(
            f"expected {width} fields in row {ragged[0][0]}, received {len(ragged[0][1])}; {names_in}"
        )
    elif ragged:
        places = rows_text([number for number, _ in ragged])
        findings.doubt(
            f"expected {width} fields in every row, received {len(ragged[0][1])} in {places}; {names_in}"
        )
    if (
        ragged
        and separator == ","
        and all(len(cells) > width and is_number_like(cells[-1]) for _, cells in ragged)
    ):
        findings.doubt(
            "commas may both separate fields and mark decimals: save with semicolons between fields"
        )
    if broken:
        findings.doubt(
            f"expected one line a row, received a quoted field of several lines in {rows_text(broken)}"
        )
    if repeated:
        findings.note(f"the header stands again in {rows_text(repeated)}; left out")
    if not numbers and ragged:
        findings.require_none()
    if not numbers:
        raise MampcError(
            f"{findings.origin}: expected a header and at least one row of numbers, received 1 row"
            if not descriptions
            else f"{findings.origin}: expected rows of numbers under the header, received "
            f"{shown(descriptions[0][1], 200)} in row {descriptions[0][0]}"
        )
    units = header_units(header)
    if descriptions:
        findings.note(
            f"no numbers in {rows_text([number for number, _ in descriptions])} under the header: "
            f"{shown(' | '.join(descriptions[-1][1]), 100)}"
        )
        rows_of_units = [
            cells for _, cells in descriptions if all(re.fullmatch(r"\S{0,12}", cell) for cell in cells)
        ]
        if rows_of_units:
            units = {at: unit for at, unit in enumerate(rows_of_units[-1][:width]) if unit} | units

    def chunks(columns: Sequence[int]) -> Iterator[list[Cells]]:
        for block in _from(rows, header_number):
            part = [
                row if number not in hollow else [*row, *[""] * width]
                for number, row in block
                if number not in skipped and (len(row) == width or any(_stripped(row)))
            ]
            yield [[row[at].strip() for row in part] for at in columns]

    return Sheet(header, units, np.frombuffer(numbers, dtype=np.int64), chunks, separator, sample)


def _from(rows: Rows, header_number: int) -> Iterator[list[Row]]:
    """The rows under the header that are not blank."""
    for block in rows():
        yield [line for line in block if line[1] and line[0] > header_number]


def _stripped(row: Sequence[str]) -> list[str]:
    return [cell.strip() for cell in row]
