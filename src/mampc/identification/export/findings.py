"""What reading an export noticed, what it did, and what only its owner can decide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from mampc.base.errors import MampcError

MOST_SHOWN = 5  # rows or values in one sentence
MOST_DOUBTS = 25  # in one refusal


class Findings:
    """Sentences: notes are told, doubts are a reason to refuse the file, all at once.

    Args:
        origin: the file, as messages name it.
    """

    def __init__(self, origin: str) -> None:
        self.origin = origin
        self.notes: list[str] = []
        self.changes: list[str] = []
        self.doubts: list[str] = []

    def note(self, sentence: str) -> None:
        """How the file was understood."""
        self.notes.append(sentence)

    def change(self, sentence: str) -> None:
        """A note that the record is not simply what stands in the rows."""
        self.notes.append(sentence)
        self.changes.append(sentence)

    def doubt(self, sentence: str) -> None:
        """Something that cannot be decided here."""
        if sentence not in self.doubts:
            self.doubts.append(sentence)

    def take(self, other: Findings) -> None:
        """All that another list holds."""
        self.notes += other.notes
        self.changes += other.changes
        for sentence in other.doubts:
            self.doubt(sentence)

    def require_none(self) -> None:
        """Raise one `MampcError` with every doubt, if there is any."""
        if not self.doubts:
            return
        if len(self.doubts) == 1:
            raise MampcError(f"{self.origin}: {self.doubts[0]}")
        more = len(self.doubts) - MOST_DOUBTS
        lines = [f"  - {doubt}" for doubt in self.doubts[:MOST_DOUBTS]]
        lines += [f"  - and {more} more like these"] if more > 0 else []
        raise MampcError("\n".join([f"{self.origin}: {len(self.doubts)} things to decide first", *lines]))


def rows_text(numbers: Sequence[int] | npt.NDArray[np.int64]) -> str:
    """ "row 3", "rows 3, 9 and 12" or "rows 3, 9, 12, 14, 15 and 30 more"."""
    first, more = [str(number) for number in numbers[:MOST_SHOWN]], len(numbers) - MOST_SHOWN
    if len(numbers) == 1:
        return f"row {first[0]}"
    last = f"{more} more" if more > 0 else first.pop()
    return f"rows {', '.join(first)} and {last}"
