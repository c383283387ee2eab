"""All rows of a file gone through once: which are data, which belong to the header, which say nothing of the plant."""

from __future__ import annotations

import re
from array import array
from collections.abc import Collection, Sequence

from mampc.base.errors import MampcError, shown
from mampc.identification.export.cells import without_unit
from mampc.identification.export.findings import Findings, rows_text
from mampc.identification.export.header import REMARK, RULE, Row, is_number_like

SAMPLE = 50  # rows kept as words
UNIT_WORD = re.compile(r"\S{0,12}")


class Survey:
    """What the rows under a header are.

    Args:
        header: names of the columns.
        number: of its row.
        wanted: positions of the columns in which numbers are looked for.

    Attributes:
        numbers: of the rows of data.
        hollow: rows of data with fewer fields and no number, all of whose values are missing.
        skipped: numbers of all other rows that are not blank.
        sample: the first rows of data.
        descriptions: rows between the header and the first number.
    """

    def __init__(self, header: tuple[str, ...], number: int, wanted: Collection[int]) -> None:
        self.header, self.wanted, self._number = header, wanted, number
        self.numbers = array("q")
        self.hollow: dict[int, str] = {}
        self.skipped: set[int] = set()
        self.sample: list[list[str]] = []
        self.descriptions: list[Row] = []
        self._ragged: list[Row] = []
        self._remarks: list[int] = []
        self._broken: list[int] = []
        self._repeated: list[int] = []
        self._previous = number

    def take(self, number: int, row: Sequence[str]) -> None:
        """Look at the next row."""
        before, self._previous = self._previous, number
        if len(row) != len(self.header) and not self._is_whole(number, stripped(row)):
            return
        if number - before > 1 and any("\n" in cell or "\r" in cell for cell in row):
            self._broken.append(number)
        if len(self.sample) < SAMPLE:
            cells = stripped(row)
            if not self.numbers and not any(is_number_like(without_unit(cells[at])[0]) for at in self.wanted):
                self.descriptions.append((number, cells))
                self.skipped.add(number)
                return
            self.sample.append(cells[: len(self.header)])
        if self._stands_again(before, row):
            self._repeated.append(number)
            self.skipped.add(number)
            return
        self.numbers.append(number)

    def _is_whole(self, number: int, cells: list[str]) -> bool:
        """Whether a row with another number of fields than the header is data: nothing stands in those beyond."""
        width = len(self.header)
        if not any(cells):
            return False
        if RULE.fullmatch("".join(cells)):
            self.skipped.add(number)
        elif REMARK.match(cells[0]):
            self._remarks.append(number)
            self.skipped.add(number)
        elif len(cells) < width and self.numbers and not any(map(is_number_like, cells)):
            self.hollow[number] = " ".join(cells).strip()
            self.numbers.append(number)
        elif len(cells) < width or any(cells[width:]):
            self._ragged.append((number, cells))
            self.skipped.add(number)
        else:
            return True
        return False

    def _stands_again(self, before: int, row: Sequence[str]) -> bool:
        """Whether a row is the header, or stands under a repeated header as it did under the first."""
        if row[0].strip() == self.header[0] and tuple(stripped(row))[: len(self.header)] == self.header:
            return True
        described = [cells for _, cells in self.descriptions] if self._repeated[-1:] == [before] else []
        return stripped(row) in described

    def tell(self, separator: str | None, findings: Findings) -> None:
        """Say what was left out, and what cannot be read; raises `MampcError` where no row of data is left."""
        footer: list[int] = []
        while self.numbers and self.numbers[-1] in self.hollow:
            footer.insert(0, self.numbers.pop())
        self.skipped.update(footer)
        if footer:
            findings.note(f"{rows_text(footer)} after the table left out: {shown(self.hollow[footer[-1]])}")
        if self._remarks:
            findings.note(f"remarks behind a # in {rows_text(self._remarks)} left out")
        if self._ragged:
            self._doubt_ragged(separator, findings)
        if self._broken:
            findings.doubt(
                f"expected one line a row, received a quoted field of several lines in {rows_text(self._broken)}"
            )
        if self._repeated:
            findings.note(f"the header stands again in {rows_text(self._repeated)}; left out")
        if not self.numbers:
            if self._ragged:
                findings.require_none()
            expected = f"{findings.origin}: expected a header and at least one row of numbers, received"
            if self.descriptions:
                number, cells = self.descriptions[0]
                raise MampcError(f"{expected} under it {shown(cells, 200)} in row {number}")
            raise MampcError(f"{expected} 1 row")
        if self.descriptions:
            findings.note(
                f"no numbers in {rows_text([number for number, _ in self.descriptions])} under the header: "
                f"{shown(' | '.join(self.descriptions[-1][1]), 100)}"
            )

    def _doubt_ragged(self, separator: str | None, findings: Findings) -> None:
        width, rows = len(self.header), [number for number, _ in self._ragged]
        findings.doubt(
            f"expected {width} fields in {'every row' if len(rows) > 1 else rows_text(rows)}, received "
            f"{len(self._ragged[0][1])}{f' in {rows_text(rows)}' if len(rows) > 1 else ''}; the names stand in row "
            f"{self._number}"
        )
        wide = all(len(cells) > width and is_number_like(cells[-1]) for _, cells in self._ragged)
        if separator == "," and wide:
            findings.doubt(
                "commas may both separate fields and mark decimals: save with semicolons between fields"
            )

    def units(self) -> dict[int, str]:
        """Units of columns, of the last description all of whose cells are short words."""
        found = [cells for _, cells in self.descriptions if all(map(UNIT_WORD.fullmatch, cells))]
        return {at: unit for at, unit in enumerate(found[-1][: len(self.header)]) if unit} if found else {}


def stripped(row: Sequence[str]) -> list[str]:
    return [cell.strip() for cell in row]
