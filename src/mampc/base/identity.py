"""Tuples that hold arrays: equal only to themselves, since arrays that are compared give no truth."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T", bound=type)


def equal_only_to_itself(kind: T) -> T:
    """The class of tuples, whose instances are compared by identity."""

    def is_same(one: object, other: object) -> bool:
        return one is other

    def is_other(one: object, other: object) -> bool:
        return one is not other

    for name, method in (("__eq__", is_same), ("__ne__", is_other), ("__hash__", object.__hash__)):
        setattr(kind, name, method)
    return kind
