"""The van de Vusse reactor: A becomes B becomes C, and A also D; the product B has a maximum and an inverse response.

Isothermal, of constant volume, with concentrations c and the dilution rate F / V as input:

    dc_A/dt = F/V (c_feed - c_A) - k1 c_A - k3 c_A^2
    dc_B/dt = -F/V c_B + k1 c_A - k2 c_B

At 4/7 per minute (34.3 per hour) it rests at 3 and 1.117 mol/l with the linear model that Bequette gives for it
(Process Control: Modeling, Design, and Simulation, Prentice Hall 2003, chapter 16), which the tests compare with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mampc.base.checks import Array, as_array, as_number, as_vector
from mampc.base.errors import MampcError
from mampc.base.names import Names
from mampc.plants.plant import parameter

_DOYLE = "Doyle, Ogunnaike, Pearson: Nonlinear model-based control by second-order Volterra models, Automatica 31, 1995"
HOUR = 3600.0  # seconds


@dataclass(frozen=True)
class VanDeVusse:
    """The isothermal van de Vusse reactor.

    The input is the dilution rate in 1/h, the output the concentration of B in mol/l, the measured disturbance the
    concentration of A in the feed in mol/l; it may be left out, which means `feed`. States are the concentrations of A
    and B. Below some 77 1/h more flow gives more B, but less at first. All methods take batches.

    Raises:
        MampcError: parameters that are not positive.
    """

    k1: float = parameter(50.0, "1/h", _DOYLE)
    k2: float = parameter(100.0, "1/h", _DOYLE)
    k3: float = parameter(10.0, "l/(mol h)", _DOYLE)
    feed: float = parameter(10.0, "mol/l", _DOYLE)
    u_op: tuple[float, ...] = parameter((34.3,), "1/h", _DOYLE)

    x_min: ClassVar[float] = 0.0
    u_min: ClassVar[tuple[float, ...]] = (0.0,)
    u_max: ClassVar[tuple[float, ...]] = (70.0,)
    dt: ClassVar[float] = 7.2
    names: ClassVar[Names] = Names(
        ("dilution",),
        ("c_B",),
        ("x_A", "x_B"),
        ("c_feed",),
        {"dilution": "1/h", "c_B": "mol/l", "c_feed": "mol/l"},
    )

    def __post_init__(self) -> None:
        for name in ("k1", "k2", "k3", "feed"):
            as_number(f"VanDeVusse.{name}", getattr(self, name), 0.0, exclusive=True)
        object.__setattr__(self, "u_op", tuple(as_vector("VanDeVusse.u_op", self.u_op, 1, 0.0).tolist()))

    @property
    def v_op(self) -> tuple[float, ...]:
        """The usual concentration of the feed in mol/l."""
        return (self.feed,)

    def derivative(self, x: Array, u: Array) -> Array:
        """dc/dt in mol/(l s), shape (..., 2)."""
        x = np.asarray(x, dtype=float)
        rate, feed = self._inputs(u)
        a, b = x[..., 0], x[..., 1]
        rates = np.broadcast_arrays(
            rate * (feed - a) - self.k1 * a - self.k3 * a * np.maximum(a, 0.0),
            self.k1 * a - (rate + self.k2) * b,
        )
        return np.stack(rates, axis=-1) / HOUR

    def output(self, x: Array, u: Array | None = None) -> Array:
        """The concentration of B, shape (..., 1)."""
        return np.asarray(x, dtype=float)[..., 1:]

    def steady_state(self, u: Any = None) -> Array:
        """Concentrations at rest, shape (..., 2), for constant inputs (..., 1) or (..., 2).

        Raises:
            MampcError: negative inputs.
        """
        u = as_array("u", self.u_op if u is None else u)
        if u.shape[-1:] not in ((1,), (2,)) or not np.isfinite(u).all() or (u < 0).any():
            raise MampcError(
                f"steady_state: expected inputs (..., 1) or (..., 2) at or above zero, received {u}"
            )
        rate, feed = self._inputs(u)
        half = (rate + self.k1) / (2 * self.k3)
        a = rate * feed / self.k3 / (half + np.sqrt(half**2 + rate * feed / self.k3))
        return np.stack([a, self.k1 * a / (rate + self.k2)], axis=-1)

    def _inputs(self, u: Array) -> tuple[Array, Array]:
        """Dilution rate in 1/h and the feed's concentration, shape (...) each."""
        u = np.maximum(np.asarray(u, dtype=float), 0.0)
        return u[..., 0], u[..., 1] if u.shape[-1] == 2 else np.full(u.shape[:-1], self.feed)
