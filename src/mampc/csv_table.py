"""Reading CSV files with a header row, and saying where they are wrong."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from mampc.arrays import Array
from mampc.errors import MampcError

CSV_FILE_LIMIT = 1 << 30  # bytes


class CSVTable:
    """The columns of a CSV file, all fields as text.

    Raises:
        MampcError: a file that cannot be read, is beyond `CSV_FILE_LIMIT`, empty or ragged.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            size = self.path.stat().st_size
            if size > CSV_FILE_LIMIT:
                raise MampcError(f"{path}: expected at most {CSV_FILE_LIMIT} bytes, received {size}")
            with self.path.open(newline="", encoding="utf-8-sig") as file:
                reader = csv.reader(file)
                lines = [(reader.line_num, [field.strip() for field in row]) for row in reader if row]
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise MampcError(f"{path}: expected a readable CSV file, received: {error}") from None
        if len(lines) < 2:
            raise MampcError(
                f"{path}: expected a header and at least one row of numbers, received {len(lines)} rows"
            )
        self.header, self._rows = lines[0][1], lines[1:]
        for number, row in self._rows:
            if len(row) != len(self.header):
                raise MampcError(
                    f"{path}: expected {len(self.header)} fields in row {number}, received {len(row)}"
                )

    def __len__(self) -> int:
        return len(self._rows)

    def words(self, name: str, hint: str = "") -> list[str]:
        """One column as it stands; raises `MampcError` unless there is exactly one of this name."""
        if self.header.count(name) != 1:
            raise MampcError(
                f"{self.path}: expected one column {name!r}, received columns {self.header}{hint}"
            )
        at = self.header.index(name)
        return [row[at] for _, row in self._rows]

    def numbers(self, name: str, hint: str = "", *, finite: bool = True) -> Array:
        """One column as numbers, all of them finite unless that is not asked for; raises `MampcError`."""
        values = np.empty(len(self))
        for i, ((number, _), field) in enumerate(zip(self._rows, self.words(name, hint), strict=True)):
            try:
                values[i] = float(field)
                wrong = finite and not np.isfinite(values[i])
            except ValueError:
                wrong = True
            if wrong:
                raise MampcError(
                    f"{self.path}: expected a number in row {number}, column {name!r}, received {field!r}"
                )
        return values
