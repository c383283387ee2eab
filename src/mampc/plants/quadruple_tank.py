"""The quadruple tank: two pumps, four tanks, each pump feeding one lower and one upper tank.

Equations: Johansson, IEEE Trans. Control Systems Technology 8 (2000), the paper's eqs. 8 and 9. With
gamma1 + gamma2 < 1 most water takes the way through the upper tanks and the plant is non-minimum phase.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mampc.base.checks import Array, as_array, as_number, as_vector
from mampc.base.errors import MampcError
from mampc.base.names import Names
from mampc.plants.plant import parameter

_PAPER = "Theertham, Varanasi, Jampana: Minimum Attention Control, table of physical constants"
_FITTED = "chosen so that inputs of 50 % give the steady levels 16.3, 13.7, 6.0, 8.1 cm stated in the paper"


@dataclass(frozen=True)
class QuadrupleTank:
    """The laboratory quadruple tank of the paper's first case study.

    Inputs are the two control valves in percent, outputs k_c times the levels of tanks 1 and 2, states
    the four levels in cm. All methods take batches: states (..., 4), inputs (..., 2).

    Raises:
        MampcError: parameters that are not positive, or a split outside 0..1.
    """

    areas: tuple[float, ...] = parameter((730.0, 730.0, 730.0, 730.0), "cm2", _PAPER)
    outlets: tuple[float, ...] = parameter((2.05, 2.26, 2.37, 2.07), "cm2", _PAPER)
    gravity: float = parameter(981.0, "cm/s2", _PAPER)
    k_c: float = parameter(2.0, "output unit per cm", _PAPER)
    gamma: tuple[float, ...] = parameter((0.3, 0.3), "share of a pump's flow into tanks 1 and 2", _PAPER)
    k_pump: tuple[float, ...] = parameter((7.45, 7.30), "cm3/s per %", _FITTED)
    u_op: tuple[float, ...] = parameter((50.0, 50.0), "%", _PAPER)

    x_min: ClassVar[float] = 0.0
    names: ClassVar[Names] = Names(
        ("u1", "u2"), ("y1", "y2"), ("h1", "h2", "h3", "h4"), units={"u1": "%", "u2": "%"}
    )
    _inflow: ClassVar[Array]
    _outflow: ClassVar[Array]

    def __post_init__(self) -> None:
        for name, size in (("areas", 4), ("outlets", 4), ("k_pump", 2), ("gamma", 2), ("u_op", 2)):
            above = name not in ("gamma", "u_op")
            given = as_vector(f"QuadrupleTank.{name}", getattr(self, name), size, 0.0, exclusive=above)
            object.__setattr__(self, name, tuple(given.tolist()))
        as_number("QuadrupleTank.gravity", self.gravity, 0.0, exclusive=True)
        as_number("QuadrupleTank.k_c", self.k_c, 0.0, exclusive=True)
        if max(self.gamma) > 1:
            raise MampcError(f"QuadrupleTank.gamma: expected numbers within 0..1, received {self.gamma}")
        # Levels rise by u @ inflow + sqrt(h) @ outflow: each pump feeds a lower and an upper tank, and each upper
        # tank the lower one below it.
        (g1, g2), (k1, k2) = self.gamma, self.k_pump
        fed = np.array([[g1 * k1, 0.0, 0.0, (1 - g1) * k1], [0.0, g2 * k2, (1 - g2) * k2, 0.0]])
        falls = np.diag(np.array(self.outlets) * np.sqrt(2 * self.gravity))
        object.__setattr__(self, "_inflow", fed / self.areas)
        object.__setattr__(self, "_outflow", falls @ (np.eye(4, k=-2) - np.eye(4)) / self.areas)

    def derivative(self, x: Array, u: Array) -> Array:
        """dh/dt in cm/s; an empty tank has no outflow, so that levels stay at or above zero."""
        x, u = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
        rate: Array = np.maximum(u, 0.0) @ self._inflow + np.sqrt(np.maximum(x, 0.0)) @ self._outflow
        return rate

    def output(self, x: Array, u: Array | None = None) -> Array:
        """k_c times the levels of tanks 1 and 2, shape (..., 2)."""
        levels: Array = self.k_c * np.maximum(np.asarray(x, dtype=float)[..., :2], 0.0)
        return levels

    def steady_state(self, u: Any = None) -> Array:
        """Levels in cm at rest, shape (..., 4), for constant inputs u in percent, shape (..., 2).

        Closed form: at rest every tank's outflow equals its inflow.

        Raises:
            MampcError: negative inputs.
        """
        u = as_array("u", self.u_op if u is None else u)
        if u.shape[-1:] != (2,) or not np.isfinite(u).all() or (u < 0).any():
            raise MampcError(f"steady_state: expected inputs (..., 2) at or above zero, received {u}")
        f1, f2 = np.moveaxis(np.array(self.k_pump) * u, -1, 0)
        g1, g2 = self.gamma
        upper = (1 - g2) * f2, (1 - g1) * f1
        flows = np.stack([upper[0] + g1 * f1, upper[1] + g2 * f2, *upper], axis=-1)
        levels: Array = (flows / np.array(self.outlets)) ** 2 / (2 * self.gravity)
        return levels
