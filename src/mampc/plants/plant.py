"""What a plant is, and how it moves from one sample to the next."""

from __future__ import annotations

from dataclasses import field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.base.names import Names


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


def parameter(default: Any, unit: str, source: str) -> Any:
    """A dataclass field that documents its unit and where its value comes from."""
    return field(default=default, metadata={"unit": unit, "source": source})


def advance(plant: Plant, x: Array, u: Array, dt: float) -> Array:
    """The state dt seconds later under constant inputs, shape (n,); integrated with LSODA.

    Raises:
        MampcError: the integration failed.
    """
    from scipy.integrate import solve_ivp

    def rate(_: float, state: Array) -> Array:
        change = plant.derivative(state, u)
        if not np.isfinite(change).all():  # LSODA would never return
            raise MampcError(f"{type(plant).__name__}: the integration failed at inputs {u}: rates {change}")
        return change

    # Tight enough that the simulation error stays far below any measurement noise.
    atol = 1e-8 * np.maximum(np.abs(x), 1.0)
    result = solve_ivp(rate, (0.0, dt), x, method="LSODA", rtol=1e-7, atol=atol)
    if not result.success or not np.isfinite(result.y[:, -1]).all():
        raise MampcError(f"{type(plant).__name__}: the integration failed at inputs {u}: {result.message}")
    # Rounding must not make a level or a pressure negative.
    end: Array = np.maximum(result.y[:, -1], getattr(plant, "x_min", -np.inf))
    return end
