"""Rows of cells under a header, whether they come from text, a spreadsheet, a Parquet or JSON file or a data frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from mampc.base.errors import MampcError, shown
from mampc.base.files import read_bounded
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.header import (
    Row,
    find_column,
    fitted_header,
    header_units,
    header_with,
    joined_names,
    likeliest_header,
    likelihood,
    remarks_last,
    require_columns,
    without_empty_end,
)
from mampc.identification.export.json_text import is_json, read_json
from mampc.identification.export.survey import Survey, stripped
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

    def words(self, at: int) -> list[str]:
        """All cells of one column as words, empty ones where there is nothing."""
        return words_of(self.column(at))

    def first(self, at: int) -> list[str]:
        """The first cells of one column as words."""
        return [row[at] for row in self.sample]


def words_of(cells: Cells) -> list[str]:
    if isinstance(cells, list):
        return cells
    return ["" if cell != cell else str(cell).removesuffix(".0") for cell in cells.tolist()]


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
    if is_json(content):
        return frame_sheet(read_json(source, content), names, findings)
    if content.startswith(ZIP):
        worksheets = read_workbook(source, content, findings)
        return _row_sheet([(rows, None, title) for title, rows in worksheets], names, findings)
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
        [(text_rows(content, encoding, separator, source), separator, "") for separator in SEPARATORS],
        names,
        findings,
    )


class _Reading(NamedTuple):
    """One way to read the rows of a file: with a separator between fields, or one worksheet of several."""

    rows: Rows
    head: list[Row]  # in which the header is looked for
    separator: str | None = None
    title: str = ""


def _row_sheet(
    ways: Sequence[tuple[Rows, str | None, str]], names: Sequence[str], findings: Findings
) -> Sheet:
    """The table in rows, read in the one of several ways that has the wanted columns."""
    readings = []
    for rows, separator, title in ways:
        head = [(number, stripped(row)) for number, row in next(rows(), [])[:HEAD]]
        readings.append(
            _Reading(rows, remarks_last([(n, row) for n, row in head if any(row)]), separator, title)
        )
    if not any(reading.head for reading in readings):
        raise MampcError(
            f"{findings.origin}: expected a header and at least one row of numbers, received 0 rows"
        )
    fits = [reading for reading in readings if names and header_with(reading.head, names) is not None]
    if len(fits) > 1 and fits[0].separator is None:
        findings.doubt(
            f"expected one worksheet with these columns, received {len(fits)} of them; save the wanted ones as "
            "files of their own"
        )
    reading = fits[0] if fits else max(readings, key=lambda r: likelihood(r.separator, r.head))
    if reading.title and len(readings) > 1:
        findings.note(f"worksheet {reading.title!r} read, one of {len(readings)}")
    at = header_with(reading.head, names) if fits else None
    number, header = _header(reading, likeliest_header(reading.head) if at is None else at, names, findings)
    return _measured(reading, number, header, names, findings)


def _header(
    reading: _Reading, at: int, names: Sequence[str], findings: Findings
) -> tuple[int, tuple[str, ...]]:
    """The names of the columns, and the number of the last row in which they stand."""
    head = reading.head
    first, header = head[at][0], without_empty_end(head[at][1])
    last = first
    if not all(find_column(header, name) is not None for name in names or header):
        for k in (at - 1, at):
            joined = joined_names(head[k : k + 2]) if k >= 0 else None
            if joined and all(
                find_column(joined, name) is not None for name in names or filter(None, joined)
            ):
                first, last, header = head[k][0], head[k + 1][0], joined
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
    under = [line for line in head if line[0] > last]
    return last, fitted_header(header, under, reading.separator, names, findings)


def _measured(
    reading: _Reading,
    number: int,
    header: tuple[str, ...],
    names: Sequence[str],
    findings: Findings,
) -> Sheet:
    """The table under a header, whose rows are gone through once."""
    width = len(header)
    positions = [at for name in names if (at := find_column(header, name)) is not None] or range(width)
    survey = Survey(header, number, positions)
    for line in chain.from_iterable(_under(reading.rows, number)):
        survey.take(*line)
    survey.tell(reading.separator, findings)

    def chunks(columns: Sequence[int]) -> Iterator[list[Cells]]:
        for block in _under(reading.rows, number):
            part = [
                row if line not in survey.hollow else [*row, *[""] * width]
                for line, row in block
                if line not in survey.skipped and (len(row) == width or any(stripped(row)))
            ]
            yield [[row[at].strip() for row in part] for at in columns]

    numbers = np.frombuffer(survey.numbers, dtype=np.int64)
    units = survey.units() | header_units(header)
    return Sheet(header, units, numbers, chunks, reading.separator, survey.sample)


def _under(rows: Rows, number: int) -> Iterator[list[Row]]:
    """The rows under the header that are not blank."""
    for block in rows():
        yield [line for line in block if line[1] and line[0] > number]
