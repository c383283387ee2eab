"""Names of a system's signals, which give it its dimensions too."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from mampc.base.errors import MampcError, shown


@dataclass(frozen=True)
class Names:
    """Names of the inputs, outputs and states of a plant or model, each a tuple of distinct words.

    `disturbances` are inputs that are measured and not manipulated, such as a load; where inputs and
    disturbances stand together in one array, the inputs come first. `units` may give the unit of any input, output
    or disturbance, as a mapping or as pairs of name and unit; figures show it and nothing else uses it.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    states: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()
    units: Mapping[str, str] | tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        for kind in ("inputs", "outputs", "states", "disturbances"):
            given = getattr(self, kind)
            if isinstance(given, str) or not isinstance(given, Iterable):
                raise MampcError(f"names.{kind}: expected a tuple of words, received {shown(given)}")
            names = tuple(given)
            if any(not isinstance(name, str) or not name for name in names):
                raise MampcError(f"names.{kind}: expected non-empty words, received {names!r}")
            if len(set(names)) != len(names):
                raise MampcError(f"names.{kind}: expected distinct names, received {names!r}")
            object.__setattr__(self, kind, names)
        together = (*self.inputs, *self.disturbances, *self.outputs)
        if len(set(together)) != len(together):
            raise MampcError(f"names: expected each input, disturbance and output once, received {together}")
        try:
            units = dict(self.units)
        except (TypeError, ValueError):
            raise MampcError(
                f"names.units: expected a mapping of names to units, received {self.units!r}"
            ) from None
        if any(name not in together or not isinstance(unit, str) for name, unit in units.items()):
            raise MampcError(
                f"names.units: expected a text for names among {together}, received {self.units!r}"
            )
        object.__setattr__(self, "units", tuple(units.items()))

    def with_unit(self, name: str) -> str:
        """A name with its unit, where that is known: `u1 (%)`."""
        unit = dict(self.units).get(name)
        return f"{name} ({unit})" if unit else name

    def undisturbed(self) -> Names:
        """The same without measured disturbances."""
        units = tuple(
            (name, unit) for name, unit in dict(self.units).items() if name not in self.disturbances
        )
        return replace(self, disturbances=(), units=units)

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
