"""What a plant is."""

from __future__ import annotations

from dataclasses import field
from typing import Any, Protocol, runtime_checkable

from mampc.base.checks import Array
from mampc.base.errors import MampcError, shown
from mampc.base.names import Names

MEMBERS = ("names", "derivative", "output", "steady_state")


@runtime_checkable
class Plant(Protocol):
    """A nonlinear plant dx/dt = derivative(x, u), y = output(x, u), in engineering units.

    `x` has shape (..., n) and `u` (..., m): the last axis holds the signals. Its dimensions are those of
    `names`. A plant may have `u_op`, the inputs (m,) of its usual operating point; with measured
    disturbances among its names, its methods take (..., m + d) inputs too and it has `v_op`, shape (d,).
    `x_min` may bound the states from below, and a method `faults(x, u)` may name what takes it out of its
    range.
    """

    @property
    def names(self) -> Names:
        """Names, and so numbers, of inputs, outputs, states and measured disturbances."""
        ...

    def derivative(self, x: Array, u: Array) -> Array:
        """dx/dt per second, shape (..., n)."""
        ...

    def output(self, x: Array, u: Array) -> Array:
        """y, shape (..., l)."""
        ...

    def steady_state(self, u: Any = None) -> Array:
        """The state at rest under constant inputs, shape (..., n); `MampcError` where there is none."""
        ...


def missing_of(plant: Any) -> str:
    """What a plant lacks, in words; nothing where it is one."""
    missing = [member for member in MEMBERS if not hasattr(plant, member)]
    if isinstance(plant, type):
        return "an object made of it"
    return ", ".join(missing) or ("" if isinstance(plant.names, Names) else "names that are a mampc.Names")


def require_plant(plant: Any) -> None:
    """Raise `MampcError` for anything but a nonlinear plant."""
    if missing := missing_of(plant):
        raise MampcError(
            f"plant: expected a plant or a mampc.StateSpace, received {shown(plant)} without {missing}"
        )


def parameter(default: Any, unit: str, source: str) -> Any:
    """A dataclass field that documents its unit and where its value comes from."""
    return field(default=default, metadata={"unit": unit, "source": source})
