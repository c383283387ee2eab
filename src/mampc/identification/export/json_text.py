"""JSON as web interfaces of historians give it: a list of records, lines of them, or a list for every column."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mampc.base.errors import MampcError

OPENS = (b"{", b"[{")
BOM = b"\xef\xbb\xbf"
FORMS = "a list of records, a record a line, or a list for every column, each value a number, a word or null"


def is_json(content: bytes) -> bool:
    return b"".join(content[:100].removeprefix(BOM).split()).startswith(OPENS)


def read_json(path: str | Path, content: bytes) -> Any:
    """A pandas DataFrame of such a text; lists of records may stand in an object, beside what is no list.

    Raises:
        MampcError: it is no JSON, or in another form.
    """
    import pandas as pd

    try:
        text = content.removeprefix(BOM).decode()
        try:
            found = json.loads(text)
        except json.JSONDecodeError:
            found = [json.loads(line) for line in text.splitlines() if line.strip()]
    except (ValueError, RecursionError) as error:
        raise MampcError(f"{path}: expected readable JSON, received: {error}") from None
    if isinstance(found, dict):
        lists = {key: value for key, value in found.items() if isinstance(value, list)}
        inner = [value for value in lists.values() if value and isinstance(value[0], dict)]
        found = inner[0] if len(inner) == 1 else lists
    records = isinstance(found, list) and all(isinstance(record, dict) for record in found)
    columns = found if isinstance(found, dict) else {}
    if not records and len(set(map(len, columns.values()))) != 1:
        raise MampcError(f"{path}: expected JSON with {FORMS}, received another form")
    frame = pd.DataFrame(found)
    if any(isinstance(cell, (dict, list)) for _, column in frame.items() for cell in column):
        raise MampcError(f"{path}: expected JSON with {FORMS}, received lists or objects as values")
    return frame
