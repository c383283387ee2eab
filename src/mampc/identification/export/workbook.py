"""Spreadsheets and Parquet files, by the libraries that know them."""

from __future__ import annotations

import io
import zipfile
from datetime import date, datetime, time
from functools import partial
from pathlib import Path
from typing import Any

from mampc.base.errors import MampcError, shown
from mampc.identification.export.findings import Findings
from mampc.identification.export.header import HIDDEN
from mampc.identification.export.text import Rows

UNPACKED_LIMIT = 2**30  # bytes
CELL_LIMIT = 50_000_000
INSTALL = "pip install 'mampc[data]'"


def read_workbook(path: Any, content: bytes, findings: Findings) -> list[tuple[str, Rows]]:
    """The worksheets of an .xlsx file that are not hidden: title, and a function that yields all rows in one block.

    Raises:
        MampcError: openpyxl is missing, the file is damaged, or unpacks to more than `UNPACKED_LIMIT`.
    """
    try:
        import openpyxl
    except ImportError:
        raise MampcError(f"{path}: expected openpyxl to read Excel files: {INSTALL}") from None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > UNPACKED_LIMIT:
                raise MampcError(
                    f"{path}: expected an Excel file that unpacks to {UNPACKED_LIMIT / 2**30:g} GiB at most"
                )
        book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
        visible = [sheet for sheet in book.worksheets if sheet.sheet_state == "visible"]
        if len(visible) < len(book.worksheets):
            hidden = [sheet.title for sheet in book.worksheets if sheet.sheet_state != "visible"]
            findings.note(f"{HIDDEN}: {shown(hidden)}")
        found: list[tuple[str, Rows]] = []
        for sheet in visible:
            cells = enumerate(sheet.iter_rows(values_only=True), 1)
            found.append((sheet.title, partial(iter, [[(n, list(map(_word, row))) for n, row in cells]])))
        return found
    except MampcError:
        raise
    except Exception as error:  # whatever a damaged file makes of the libraries that unpack it
        raise MampcError(f"{path}: expected a readable Excel file, received: {error}") from None


def read_parquet(path: str | Path, content: bytes) -> Any:
    """A pandas DataFrame of a Parquet file.

    Raises:
        MampcError: pyarrow is missing, the file is damaged, or holds more than `CELL_LIMIT` cells.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MampcError(f"{path}: expected pyarrow to read Parquet files: {INSTALL}") from None
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        cells = file.metadata.num_rows * file.metadata.num_columns
        if cells > CELL_LIMIT:
            raise MampcError(f"{path}: expected at most {CELL_LIMIT} cells, received {cells}")
        return file.read().to_pandas()
    except (pa.ArrowException, OSError, ValueError, NotImplementedError) as error:
        if isinstance(error, MampcError):
            raise
        raise MampcError(f"{path}: expected a readable Parquet file, received: {error}") from None


def _word(cell: Any) -> str:
    if cell is None:
        return ""
    if isinstance(cell, datetime):
        at_midnight = cell.time() == time(0)
        return cell.date().isoformat() if at_midnight else cell.isoformat(sep=" ")
    if isinstance(cell, (date, time)):
        return cell.isoformat()
    return str(cell).strip()
