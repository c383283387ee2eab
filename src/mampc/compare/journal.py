"""What a sweep has finished, one line a task, so that a killed sweep goes on where it stopped."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mampc.base.errors import MampcError, shown
from mampc.base.files import read_text

JOURNAL_LIMIT = 2**30  # bytes


class Journal:
    """An append-only file of finished tasks; the first line says what they are tasks of.

    Args:
        path: of the file; a new one is begun where there is none.
        of: what is swept; tasks of anything else are refused.

    Raises:
        MampcError: a file of another sweep, or one that cannot be written.
    """

    def __init__(self, path: Path, of: str) -> None:
        self._path, self.done = path, dict[str, list[dict[str, Any]]]()
        if path.exists() and self._read(of):
            return
        try:
            path.write_text(json.dumps({"sweep": of}) + "\n", encoding="utf-8")
        except OSError as error:
            raise MampcError(f"--out: expected a folder that can be written, received: {error}") from None

    def _read(self, of: str) -> bool:
        """Take what is finished; whether the file is of this sweep. One of another is no loss where nothing is."""
        first, *lines = list(self._lines()) or [{}]
        if first.get("sweep") != of:
            if not lines and "sweep" in first:
                return False
            raise MampcError(
                f"{shown(str(self._path), 200)}: expected results of this study, its files, seeds and points, received "
                "those of another sweep; give another --out, or remove the file to begin anew"
            )
        for line in lines:
            self.done[line["task"]] = line["rows"]
        return True

    def _lines(self) -> Iterator[dict[str, Any]]:
        """The lines that are whole; one that a killed sweep left half-written is not."""
        for line in read_text(self._path, JOURNAL_LIMIT, "journal of a sweep").splitlines():
            try:
                found = json.loads(line)
            except ValueError:
                continue
            if isinstance(found, dict):
                yield found

    def add(self, task: str, rows: list[dict[str, Any]]) -> None:
        """Write down a finished task at once."""
        self.done[task] = rows
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write("\n" + json.dumps({"task": task, "rows": rows}) + "\n")
        except OSError as error:
            raise MampcError(f"--out: expected a folder that can be written, received: {error}") from None
