"""Reading CSV files with a header row, and saying where they are wrong."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError, shown
from mampc.base.files import read_bounded

CSV_FILE_LIMIT = 64 * 2**20  # bytes


class CSVTable:
    """The columns of a CSV file.

    The file is kept as it is and parsed anew for every column, so that memory stays near the size of the file.

    Args:
        path: of the file.
        whole: leave out a last row without an end, as a writer leaves it that is stopped.

    Raises:
        MampcError: a file that cannot be read, is beyond `CSV_FILE_LIMIT`, empty, ragged or not separated by commas.
    """

    def __init__(self, path: str | Path, *, whole: bool = False) -> None:
        self.path = Path(path)
        self._content = read_bounded(path, CSV_FILE_LIMIT, "CSV file")
        if whole:
            self._content = self._content[: self._content.rfind(b"\n") + 1]
        count = 0
        try:
            for count, (number, row) in enumerate(self._rows(), 1):
                if count == 1:
                    self.header = [field.strip() for field in row]
                    self._require_commas()
                elif len(row) != len(self.header):
                    raise MampcError(
                        f"{path}: expected {len(self.header)} fields in row {number}, received {len(row)}"
                    )
        except (UnicodeDecodeError, csv.Error) as error:
            raise MampcError(f"{path}: expected a readable CSV file, received: {error}") from None
        if count < 2:
            raise MampcError(
                f"{path}: expected a header and at least one row of numbers, received {count} rows"
            )
        self._length = count - 1

    def __len__(self) -> int:
        return self._length

    def words(self, name: str, hint: str = "") -> list[str]:
        """One column as it stands; raises `MampcError` unless there is exactly one of this name."""
        return [field for _, field in self._column(name, hint)]

    def numbers(self, name: str, hint: str = "", *, finite: bool = True) -> Array:
        """One column as numbers, all of them finite unless that is not asked for; raises `MampcError`."""
        values = np.empty(len(self))
        for i, (number, field) in enumerate(self._column(name, hint)):
            try:
                values[i] = value = float(field)
                wrong = finite and not math.isfinite(value)
            except ValueError:
                wrong = True
            if wrong:
                received = (
                    shown(field) if field else "nothing; fill the gap, or keep the rows on one side of it"
                )
                raise MampcError(
                    f"{self.path}: expected a number in row {number}, column {name!r}, received {received}"
                )
        return values

    def _column(self, name: str, hint: str) -> Iterator[tuple[int, str]]:
        if self.header.count(name) != 1:
            raise MampcError(
                f"{self.path}: expected one column {name!r}, received columns {shown(self.header, 400)}{hint}"
            )
        at, rows = self.header.index(name), self._rows()
        next(rows)
        return ((number, row[at].strip()) for number, row in rows)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """The rows that are not empty, with their numbers in the file."""
        text = io.TextIOWrapper(io.BytesIO(self._content), encoding="utf-8-sig", newline="")
        reader = csv.reader(text)
        return ((reader.line_num, row) for row in reader if row)

    def _require_commas(self) -> None:
        for separator, word in ((";", "semicolons"), ("\t", "tabs")):
            if len(self.header) == 1 and separator in self.header[0]:
                raise MampcError(
                    f"{self.path}: expected fields separated by commas, received {word}; save the file with commas "
                    "between fields and points in numbers"
                )
