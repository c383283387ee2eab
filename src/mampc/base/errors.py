"""What mampc raises: every message states what was expected and what came."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any


class MampcError(ValueError):
    """An argument, file or model that mampc cannot work with."""


class MampcWarning(UserWarning):
    """What works, but not as well as it should."""


class StudyError(MampcError):
    """A study file with a wrong key, type, value or unit; the message names each place."""


@contextmanager
def said_at(place: str, kind: type[ValueError] = StudyError) -> Iterator[None]:
    """What is refused inside is a mistake in a study: the message begins with its place."""
    try:
        yield
    except MampcError as error:
        raise kind(f"{place}{error}") from None


def shown(value: Any, length: int = 60) -> str:
    """A value as messages show it: cut where it is long, and never a reason to fail."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of too many digits, a list too deep in lists
        text = f"{type(value).__name__} too long to be shown"
    return text if len(text) <= length else text[: length - 3] + "..."


def listed(words: Sequence[str], most: int = 6, separator: str = ", ") -> str:
    """The first words, and how many there are beside them: "u1, u2 and 3 more"."""
    more = f" and {len(words) - most} more" if len(words) > most else ""
    return separator.join(words[:most]) + more


def counted(count: int, noun: str) -> str:
    """ "1 row" or "7 rows"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
