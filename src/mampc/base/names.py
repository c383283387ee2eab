"""Names of a system's signals, which give it its dimensions too."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from mampc.base.errors import MampcError


@dataclass(frozen=True)
class Names:
    """Names of the inputs, outputs and states of a plant or model, each a tuple of distinct words.

    `disturbances` are inputs that are measured and not manipulated, such as a load; where inputs and
    disturbances stand together in one array, the inputs come first.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    states: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for kind in ("inputs", "outputs", "states", "disturbances"):
            names = tuple(getattr(self, kind))
            if any(not isinstance(name, str) or not name for name in names):
                raise MampcError(f"names.{kind}: expected non-empty words, received {names!r}")
            if len(set(names)) != len(names):
                raise MampcError(f"names.{kind}: expected distinct names, received {names!r}")
            object.__setattr__(self, kind, names)
        together = (*self.inputs, *self.disturbances, *self.outputs)
        if len(set(together)) != len(together):
            raise MampcError(f"names: expected each input, disturbance and output once, received {together}")

    @classmethod
    def numbered(cls, inputs: int, outputs: int, states: int = 0) -> Names:
        """u1.., y1.., x1..: the names used where a user gives none."""
        return cls(_numbered("u", inputs), _numbered("y", outputs), _numbered("x", states))


def _numbered(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i + 1}" for i in range(count))


def require_count(kind: str, names: Iterable[str], expected: int) -> None:
    """Raise `MampcError` unless there are as many names as signals."""
    received = tuple(names)
    if len(received) != expected:
        raise MampcError(f"{kind}: expected {expected} names, received {len(received)}: {received!r}")
