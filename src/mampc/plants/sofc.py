"""A solid-oxide fuel-cell stack: voltage from the partial pressures of four gases.

The isothermal, unchoked lumped model of the paper's second case study (its eqs. 12 and 13), with units and
slips put right: the molar masses in kg, the cell losses times the number of cells, limiting and exchange
current density in their right places.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mampc.base.checks import Array, as_array, as_choice, as_number, as_vector
from mampc.base.errors import MampcError
from mampc.base.names import Names
from mampc.plants.plant import parameter

_PAPER = "Theertham, Varanasi, Jampana: Minimum Attention Control, table of SOFC parameters"
_CHOSEN = "not in the paper; an engineering choice"
_PHYSICS = "CODATA, IUPAC"
_SWAPPED = "the paper's table has limiting and exchange current density swapped"
H2_FRACTIONS = {"default": 0.9, "paper-band": 0.705}
_SCARCE = 10.0  # Pa; below it a gas runs out and its reaction fades, so that no pressure turns negative


@dataclass(frozen=True)
class SolidOxideFuelCell:
    """The fuel-cell stack of the paper's second case study.

    Inputs are fuel and air flow in percent of nominal; a third input, the current in A, is a measured
    disturbance and may be left out, which means `current`. The output is the stack voltage in V, the states
    are the partial pressures of H2, H2O, O2 and N2 in Pa. All methods take batches: states (..., 4), inputs
    (..., 2) or (..., 3).

    Args:
        variant: "default", or "paper-band" for fuel so lean in H2 (0.705) that test signals of the paper's
            size swing the voltage over its band of -40 to 20 V.

    Raises:
        MampcError: parameters out of range, or an unknown variant.
    """

    n_cells: float = parameter(384.0, "1", _PAPER)
    anode_orifice: float = parameter(0.0025, "m2", _PAPER)
    cathode_orifice: float = parameter(0.0025, "m2", _PAPER)
    discharge_coefficient: float = parameter(0.75, "1", _PAPER)
    diameter_ratio: float = parameter(0.5, "1, orifice to manifold", _CHOSEN)
    temperature: float = parameter(1273.15, "K", _PAPER)
    fuel_flow: float = parameter(1.2, "mol/s at 100 %", _PAPER)
    air_flow: float = parameter(5.0, "mol/s at 100 %", _PAPER)
    limiting_current: float = parameter(10_000.0, "A/m2", _SWAPPED)
    exchange_current: float = parameter(1500.0, "A/m2", _SWAPPED)
    current: float = parameter(400.0, "A", _PAPER)
    faraday: float = parameter(96485.0, "C/mol", _PAPER)
    gas_constant: float = parameter(8.314462, "J/(mol K)", _PHYSICS)
    atmosphere: float = parameter(101_325.0, "Pa", _PHYSICS)
    molar_masses: tuple[float, ...] = parameter(
        (2.016e-3, 18.015e-3, 31.998e-3, 28.014e-3), "kg/mol of H2, H2O, O2, N2", _PHYSICS
    )
    anode_volume: float = parameter(0.4, "m3", _CHOSEN)
    cathode_volume: float = parameter(0.4, "m3", _CHOSEN)
    cell_area: float = parameter(0.25, "m2", _CHOSEN)
    h2_fraction: float = parameter(
        None, "1, mole fraction in the fuel; None for that of the variant", _CHOSEN
    )
    o2_fraction: float = parameter(0.21, "1, mole fraction in the air", _PHYSICS)
    u_op: tuple[float, ...] = parameter((100.0, 100.0), "% of nominal flow", _PAPER)
    variant: str = "default"

    @property
    def v_op(self) -> tuple[float, ...]:
        """The usual current in A."""
        return (self.current,)

    x_min: ClassVar[float] = 0.0
    names: ClassVar[Names] = Names(
        ("fuel", "air"),
        ("voltage",),
        ("p_H2", "p_H2O", "p_O2", "p_N2"),
        disturbances=("current",),
        units={"fuel": "%", "air": "%", "voltage": "V", "current": "A"},
    )

    def __post_init__(self) -> None:
        as_choice("variant", self.variant, H2_FRACTIONS)
        if self.h2_fraction is None:
            object.__setattr__(self, "h2_fraction", H2_FRACTIONS[self.variant])
        for name in (
            "n_cells", "anode_orifice", "cathode_orifice", "discharge_coefficient", "temperature",
            "fuel_flow", "air_flow", "limiting_current", "exchange_current", "faraday", "gas_constant",
            "atmosphere", "anode_volume", "cathode_volume", "cell_area",
        ):  # fmt: skip
            as_number(f"SolidOxideFuelCell.{name}", getattr(self, name), 0.0, exclusive=True)
        as_number("SolidOxideFuelCell.current", self.current, 0.0)
        for name in ("diameter_ratio", "h2_fraction", "o2_fraction"):
            value = as_number(f"SolidOxideFuelCell.{name}", getattr(self, name), 0.0)
            if value >= 1.0:
                raise MampcError(f"SolidOxideFuelCell.{name}: expected a number below 1, received {value}")
        for name, size in (("molar_masses", 4), ("u_op", 2)):
            given = as_vector(f"SolidOxideFuelCell.{name}", getattr(self, name), size, 0.0, exclusive=True)
            object.__setattr__(self, name, tuple(given.tolist()))

    def derivative(self, x: Array, u: Array) -> Array:
        """Rates of the partial pressures in Pa/s: inflow minus outflow plus reaction; always finite."""
        x, u = np.maximum(np.asarray(x, dtype=float), 0.0), np.asarray(u, dtype=float)
        h2, steam, o2, n2 = x[..., 0], x[..., 1], x[..., 2], x[..., 3]
        fuel, air = self._flows(u)
        # Hydrogen and oxygen that are not there cannot react, and then no steam comes either.
        present = np.minimum(1.0, np.minimum(h2, o2) / _SCARCE)
        reaction = self._reaction_rate(self._current(u)) * present
        anode = self._outflow_per_pressure(h2, steam, 0)
        cathode = self._outflow_per_pressure(o2, n2, 1)
        RT = self.gas_constant * self.temperature
        per_anode, per_cathode = RT / self.anode_volume, RT / self.cathode_volume
        rates = (
            per_anode * (self.h2_fraction * fuel - anode * h2 - 2 * reaction),
            per_anode * ((1 - self.h2_fraction) * fuel - anode * steam + 2 * reaction),
            per_cathode * (self.o2_fraction * air - cathode * o2 - reaction),
            per_cathode * ((1 - self.o2_fraction) * air - cathode * n2),
        )
        return np.stack(np.broadcast_arrays(*rates), axis=-1) if x.ndim > 1 or u.ndim > 1 else np.array(rates)

    def output(self, x: Array, u: Array | None = None) -> Array:
        """Stack voltage in V, shape (..., 1); finite where gases run out or the current is too large."""
        x = np.maximum(np.asarray(x, dtype=float), 1e-3)
        RT_F = self.gas_constant * self.temperature / self.faraday
        h2, steam, o2 = x[..., 0], x[..., 1], x[..., 2]
        gibbs = 188_600.0 - 56.0 * (self.temperature - 1073.15)  # -dg_f, J/mol
        nernst = np.log(h2 / steam) + 0.5 * np.log(o2 / self.atmosphere)
        potential = self.n_cells * (gibbs / (2 * self.faraday) + RT_F / 2 * nernst)
        current = self._current(u)
        resistance = 0.2 * np.exp(-2870.0 * (1 / 1196.15 - 1 / self.temperature))  # ohm, the stack's
        j = current / self.cell_area
        concentration = -RT_F / 4 * np.log(np.maximum(1 - j / self.limiting_current, 1e-6))
        ratio = j / self.exchange_current
        activation = RT_F / 4 * ratio + RT_F / 2 * np.log(np.maximum(ratio, 1.0))
        voltage: Array = potential - resistance * current - self.n_cells * (concentration + activation)
        return voltage[..., None]

    def steady_state(self, u: Any = None) -> Array:
        """Partial pressures in Pa at rest, shape (..., 4), for constant inputs.

        Closed form: at rest outflow is inflow plus reaction, which fixes the mole fractions, and the
        orifice equation is quadratic in each total pressure.

        Raises:
            MampcError: fuel or air starvation, a current density at or above the limit, negative flows.
        """
        u = as_array("u", self.u_op if u is None else u)
        if u.shape[-1:] not in ((2,), (3,)) or not np.isfinite(u).all() or (u < 0).any():
            raise MampcError(
                f"steady_state: expected inputs (..., 2) or (..., 3) at or above zero, received {u}"
            )
        current, (fuel, air) = self._current(u), self._flows(u)
        if (current / self.cell_area >= self.limiting_current).any():
            raise MampcError(
                f"steady_state: expected a current below {self.limiting_current * self.cell_area:g} A "
                f"(limiting current density), received {current.max():g} A"
            )
        reaction = self._reaction_rate(current)
        flow = np.stack(
            [
                self.h2_fraction * fuel - 2 * reaction,
                (1 - self.h2_fraction) * fuel + 2 * reaction,
                self.o2_fraction * air - reaction,
                (1 - self.o2_fraction) * air,
            ],
            axis=-1,
        )
        for gas, supply, place in (("H2", "fuel", 0), ("O2", "air", 2)):
            if (flow[..., place] <= 0).any():
                raise MampcError(
                    f"steady_state: expected more {gas} than the current uses (starvation), received "
                    f"{-flow[..., place].min():.3g} mol/s too little; raise the {supply} flow"
                )
        pressures = []
        for side in (0, 1):
            gases = flow[..., 2 * side : 2 * side + 2]
            total = gases.sum(axis=-1, keepdims=True)
            fractions = gases / total
            mass = (fractions * self.molar_masses[2 * side : 2 * side + 2]).sum(axis=-1, keepdims=True)
            head = (total / self._orifice(side)) ** 2 * self.gas_constant * self.temperature * mass / 2
            pressure = self.atmosphere / 2 + np.sqrt(self.atmosphere**2 / 4 + head)
            pressures.append(fractions * pressure)
        return np.concatenate(pressures, axis=-1)

    def faults(self, x: Array, u: Array | None = None) -> tuple[str, ...]:
        """What takes the model out of its range at a state (..., 4), or at some of a batch, and inputs."""
        x = np.asarray(x, dtype=float)
        found = []
        if float(np.max(self._current(u))) / self.cell_area >= self.limiting_current:
            found.append("limiting current density")
        if x[..., 0].min() < _SCARCE:
            found.append("H2 starvation")
        if x[..., 2].min() < _SCARCE:
            found.append("O2 starvation")
        if min((x[..., 0] + x[..., 1]).min(), (x[..., 2] + x[..., 3]).min()) < self.atmosphere:
            found.append("pressure below atmospheric")
        return tuple(found)

    def _current(self, u: Array | None) -> Array:
        u = np.asarray(self.u_op if u is None else u, dtype=float)
        return u[..., 2] if u.shape[-1] == 3 else np.full(u.shape[:-1], self.current)

    def _flows(self, u: Array) -> tuple[Array, Array]:
        """Molar flows of fuel and air (...,) in mol/s."""
        fuel = self.fuel_flow / 100 * np.maximum(u[..., 0], 0.0)
        return fuel, self.air_flow / 100 * np.maximum(u[..., 1], 0.0)

    def _reaction_rate(self, current: Array) -> Array:
        """O2 used (...,) in mol/s; twice as much H2 is used and becomes steam."""
        rate: Array = self.n_cells / (4 * self.faraday) * current
        return rate

    def _outflow_per_pressure(self, first: Array, second: Array, side: int) -> Array:
        """Molar outflow of a gas per its partial pressure, mol/(s Pa); none below atmospheric pressure."""
        over = np.maximum(first + second - self.atmosphere, 0.0)
        density = first * self.molar_masses[2 * side] + second * self.molar_masses[2 * side + 1]
        RT = self.gas_constant * self.temperature
        flow: Array = self._orifice(side) * np.sqrt(2 * over / (RT * np.maximum(density, 1e-12)))
        return flow

    def _orifice(self, side: int) -> float:
        area = (self.anode_orifice, self.cathode_orifice)[side]
        return self.discharge_coefficient / float((1 - self.diameter_ratio**4) ** 0.5) * area
