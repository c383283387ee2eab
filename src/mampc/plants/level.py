"""A buffer tank whose level integrates what comes in less what goes out.

area dh/dt = q - demand,    lag dq/dt = capacity u / 100 - q
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mampc.base.checks import Array, as_array, as_number
from mampc.base.errors import MampcError
from mampc.base.names import Names
from mampc.plants.plant import parameter

_CHOSEN = "an engineering choice: a buffer of some minutes between two units"


@dataclass(frozen=True)
class Level:
    """An integrating level behind a lag.

    The input is the valve of the inflow in percent, the output the level in m, the measured disturbance the demand in
    m3/s; it may be left out, which means `demand`. States are the inflow in m3/s and the level. The level stays
    between empty and full, which `faults` reports. All methods take batches.

    Raises:
        MampcError: parameters out of range.
    """

    area: float = parameter(10.0, "m2", _CHOSEN)
    height: float = parameter(4.0, "m", _CHOSEN)
    capacity: float = parameter(0.1, "m3/s at 100 %", _CHOSEN)
    lag: float = parameter(20.0, "s, of valve and pipe", _CHOSEN)
    demand: float = parameter(0.05, "m3/s", _CHOSEN)
    level: float = parameter(2.0, "m, where it usually is", _CHOSEN)

    u_min: ClassVar[tuple[float, ...]] = (0.0,)
    u_max: ClassVar[tuple[float, ...]] = (100.0,)
    dt: ClassVar[float] = 10.0
    names: ClassVar[Names] = Names(
        ("valve",),
        ("level",),
        ("inflow", "level"),
        ("demand",),
        {"valve": "%", "level": "m", "demand": "m3/s"},
    )

    def __post_init__(self) -> None:
        for name in ("area", "height", "capacity", "lag"):
            as_number(f"Level.{name}", getattr(self, name), 0.0, exclusive=True)
        for name, most in (("demand", self.capacity), ("level", self.height)):
            if as_number(f"Level.{name}", getattr(self, name), 0.0) > most:
                raise MampcError(f"Level.{name}: expected at most {most:g}, received {getattr(self, name)}")

    @property
    def u_op(self) -> tuple[float, ...]:
        """The valve at which the usual demand comes in, in percent."""
        return (100 * self.demand / self.capacity,)

    @property
    def v_op(self) -> tuple[float, ...]:
        """The usual demand in m3/s."""
        return (self.demand,)

    def derivative(self, x: Array, u: Array) -> Array:
        """Rates of inflow in m3/s2 and level in m/s, shape (..., 2); none out of an empty tank or beyond a full one."""
        x = np.asarray(x, dtype=float)
        wanted, demand = self._flows(u)
        inflow, level = x[..., 0], x[..., 1]
        rise = (inflow - demand) / self.area
        rise = np.where(
            level <= 0.0, np.maximum(rise, 0.0), np.where(level >= self.height, np.minimum(rise, 0.0), rise)
        )
        return np.stack(np.broadcast_arrays((wanted - inflow) / self.lag, rise), axis=-1)

    def output(self, x: Array, u: Array | None = None) -> Array:
        """The level in m, shape (..., 1)."""
        level: Array = np.clip(np.asarray(x, dtype=float)[..., 1:], 0.0, self.height)
        return level

    def steady_state(self, u: Any = None) -> Array:
        """The usual level at inputs (..., 1) or (..., 2) that balance, shape (..., 2).

        Raises:
            MampcError: inputs at which the level does not rest.
        """
        u = as_array("u", self.u_op if u is None else u)
        if u.shape[-1:] not in ((1,), (2,)) or not np.isfinite(u).all():
            raise MampcError(f"steady_state: expected inputs (..., 1) or (..., 2), received {u}")
        inflow, demand = self._flows(u)
        if (np.abs(inflow - demand) > 1e-9 * self.capacity).any():
            raise MampcError(
                f"steady_state: expected an inflow equal to the demand, received {inflow} and {demand} m3/s: the level "
                "integrates, and rests nowhere else"
            )
        return np.stack([inflow, np.full_like(inflow, self.level)], axis=-1)

    def faults(self, x: Array, u: Array | None = None) -> tuple[str, ...]:
        """Whether the tank is empty or full, or some of a batch are."""
        level = np.asarray(x, dtype=float)[..., 1]
        return ("empty",) * bool(level.min() <= 0.0) + ("overflow",) * bool(level.max() >= self.height)

    def _flows(self, u: Array) -> tuple[Array, Array]:
        """The inflow that the valve is set to and the demand in m3/s, shape (...) each."""
        u = np.asarray(u, dtype=float)
        inflow = self.capacity / 100 * np.maximum(u[..., 0], 0.0)
        return inflow, u[..., 1] if u.shape[-1] == 2 else np.full(u.shape[:-1], self.demand)
