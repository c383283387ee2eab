"""JSON as web interfaces of historians give it: records, lines or lists of them by tag, or a list for every column."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mampc.base.errors import MampcError, shown

OPENS = (b"{", b"[{")
BOM = b"\xef\xbb\xbf"
FORMS = (
    "a list of records, a record a line, a list of records for every tag, or a list for every column, each value a "
    "number, a word, a state with a name, or null"
)


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
    if records:
        found = _by_tag(found)
        found = [{key: _word(value) for key, value in record.items() if value != {}} for record in found]
    else:
        found = {key: list(map(_word, column)) for key, column in columns.items()}
    frame = pd.DataFrame(found)
    nested = [str(name) for name, column in frame.items() if any(isinstance(c, (dict, list)) for c in column)]
    if nested:
        raise MampcError(
            f"{path}: expected JSON with {FORMS}, received lists or objects as values of {shown(nested[0])}"
        )
    return frame


def _by_tag(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records that stand in a list within each of others, such as values under their tags, beside what those say."""
    keys = {key for record in records for key, value in record.items() if _lists_records(value)}
    if len(keys) != 1:
        return records
    [key] = keys
    return [merged for record in records for merged in _merged(record, key)]


def _merged(record: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """What is said twice is as the inner record has it, unless that leaves it empty."""
    about = {name: value for name, value in record.items() if name != key}
    return [
        about | {name: value for name, value in inner.items() if value != "" or name not in about}
        for inner in record.get(key) or ()
    ]


def _lists_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(inner, dict) for inner in value)


def _word(value: Any) -> Any:
    """A state of a switch or of a system, an object with a name and a code, by its name."""
    return value["Name"] if isinstance(value, dict) and {"Name", "Value"} <= value.keys() else value
