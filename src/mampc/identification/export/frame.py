"""Data frames as sheets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError, shown
from mampc.identification.export.findings import Findings
from mampc.identification.export.header import header_units, require_columns
from mampc.identification.export.sheet import Cells, Sheet, words_of


def frame_sheet(frame: Any, names: Sequence[str], findings: Findings) -> Sheet:
    """The columns of a pandas DataFrame, and its index where that has a name or is one of times."""
    import pandas as pd

    if not isinstance(frame, pd.DataFrame):
        raise MampcError(f"expected a pandas DataFrame, received {shown(type(frame).__name__)}")
    if frame.columns.nlevels != 1 or frame.index.nlevels != 1:
        raise MampcError("DataFrame: expected columns and an index of one level each")
    if frame.index.name is not None or isinstance(frame.index, pd.DatetimeIndex):
        index = frame.index.to_series(index=range(len(frame)))
        frame = frame.reset_index(drop=True)
        frame.insert(0, "index" if index.name is None else index.name, index, allow_duplicates=True)
    if frame.empty:
        raise MampcError(
            f"{findings.origin}: expected a header and rows of numbers, received {len(frame)} rows"
        )
    header = tuple(str(name).strip() for name in frame.columns)
    require_columns(header, names, findings)

    def chunks(columns: Sequence[int]) -> Iterator[list[Cells]]:
        yield [_frame_cells(frame.iloc[:, at]) for at in columns]

    head = frame.iloc[:50]
    sample = [
        list(row)
        for row in zip(*(words_of(_frame_cells(head.iloc[:, at])) for at in range(len(header))), strict=True)
    ]
    return Sheet(header, header_units(header), np.arange(len(frame)), chunks, None, sample)


def _frame_cells(column: Any) -> Cells:
    import pandas as pd

    if pd.api.types.is_bool_dtype(column.dtype):
        return _texts(column)
    if pd.api.types.is_numeric_dtype(column.dtype) and not pd.api.types.is_complex_dtype(column.dtype):
        numbers: Array = column.to_numpy(dtype=np.float64, na_value=np.nan)
        return numbers
    if pd.api.types.is_datetime64_any_dtype(column.dtype):
        times: Any = column.reset_index(drop=True)
        return times
    return _texts(column)


def _texts(column: Any) -> list[str]:
    return [
        "" if missing else str(cell).strip()
        for cell, missing in zip(column.tolist(), column.isna().tolist(), strict=True)
    ]
