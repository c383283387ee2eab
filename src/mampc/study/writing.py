"""A study as the text of a TOML file, of which `parse_study` makes the same study again."""

from __future__ import annotations

import json
import re
from typing import Any

from mampc.study.schema import Study


def study_text(study: Study, comment: str = "") -> str:
    """The text of a study, with what is not the default; a comment of a few lines goes first."""
    content = study.model_dump(exclude_defaults=True, exclude_none=True, exclude={"place"})
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    lists = {
        key: value
        for key, value in content.items()
        if isinstance(value, list) and value and isinstance(value[0], dict)
    }
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += [""] if lines else []
    lines += _entries({key: value for key, value in content.items() if key not in {*tables, *lists}})
    for key, table in tables.items():
        lines += ["", f"[{key}]", *_entries(table)]
    for key, entries in lists.items():
        for entry in entries:
            lines += ["", f"[[{key}]]", *_entries(entry)]
    return "\n".join(lines) + "\n"


def _entries(table: dict[str, Any]) -> list[str]:
    return [f"{_key(key)} = {_value(value)}" for key, value in table.items()]


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items()) + " }"
    if len(value) > 1 and any(isinstance(entry, dict) for entry in value):
        return "[\n" + "".join(f"  {_value(entry)},\n" for entry in value) + "]"
    return "[" + ", ".join(_value(entry) for entry in value) + "]"
