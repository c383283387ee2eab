"""Words that say something and explain it: the base of statuses, remarks and faults."""

from __future__ import annotations

from enum import StrEnum
from typing import Self


class Sentence(StrEnum):
    """A word with a `sentence` that says it at length; members are written as `NAME = word, sentence`."""

    sentence: str

    def __new__(cls, value: str, sentence: str) -> Self:
        member = str.__new__(cls, value)
        member._value_ = value
        member.sentence = sentence
        return member
