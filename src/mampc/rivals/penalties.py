"""Penalties that make a vector sparse, and what majorises them.

Each is `weight` times a function of a = |z| / size, with one size per input: a change of units changes nothing. One
that is separable lies below c a + q a^2 / 2 + constant about a point and touches it there; minimising that again and
again never raises the objective (majorise-minimise; local linear approximation where the penalty is concave). The
others are sums of norms, each of some of the entries.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mampc.base.checks import Array, as_number


class Majoriser(NamedTuple):
    """c and q of a = |z| / size, each shape (nc, m)."""

    c: Array
    q: Array


@dataclass(frozen=True, kw_only=True)
class Penalty(ABC):
    """What all penalties share.

    Args:
        weight: >= 0, in units of the tracking cost.
        size: of z, in input units, a scalar or one value per input: by what z is divided.
    """

    weight: float = 1.0
    size: Any = 1.0

    def __post_init__(self) -> None:
        as_number("weight", self.weight, 0.0)

    @abstractmethod
    def value(self, a: Array) -> float:
        """The penalty of a, shape (nc, m)."""


class Separable(Penalty):
    """A sum over the entries."""

    repeated = True  # whether one majoriser is not enough

    @abstractmethod
    def majoriser(self, a: Array) -> Majoriser:
        """What lies above it and touches it at a, shape (nc, m)."""


class Norms(Penalty):
    """A sum of weighted norms."""

    @abstractmethod
    def norms(self, n_c: int, m: int) -> list[tuple[float, list[int]]]:
        """Weight and entries of each, numbered sample by sample."""

    def value(self, a: Array) -> float:
        entries = a.ravel()
        return float(sum(w * np.linalg.norm(entries[chosen]) for w, chosen in self.norms(*a.shape)))


@dataclass(frozen=True, kw_only=True)
class L1(Separable):
    """weight * sum a: minimum attention by l1 on moves (Nagahara and Nesic 2020), maximum hands-off and lasso-MPC on
    inputs (Nagahara et al. 2016; Gallieri and Maciejowski 2012)."""

    repeated = False

    def value(self, a: Array) -> float:
        return float(self.weight * a.sum())

    def majoriser(self, a: Array) -> Majoriser:
        return Majoriser(np.full_like(a, self.weight), np.zeros_like(a))


@dataclass(frozen=True, kw_only=True)
class ElasticNet(Separable):
    """weight * sum (a + curvature a^2)."""

    curvature: float = 1.0
    repeated = False

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("curvature", self.curvature, 0.0)

    def value(self, a: Array) -> float:
        return float(self.weight * (a + self.curvature * a * a).sum())

    def majoriser(self, a: Array) -> Majoriser:
        return Majoriser(np.full_like(a, self.weight), np.full_like(a, 2 * self.weight * self.curvature))


@dataclass(frozen=True, kw_only=True)
class GroupL2(Norms):
    """weight * sum over samples of |a_j|_2: all inputs move together or none."""

    def norms(self, n_c: int, m: int) -> list[tuple[float, list[int]]]:
        return [(self.weight, [*range(j * m, (j + 1) * m)]) for j in range(n_c)]


@dataclass(frozen=True, kw_only=True)
class CLOT(Norms):
    """weight * (sum a + ratio |a|_2), the norm over the whole horizon (Nagahara et al. 2020)."""

    ratio: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("ratio", self.ratio, 0.0)

    def norms(self, n_c: int, m: int) -> list[tuple[float, list[int]]]:
        entries = [*range(n_c * m)]
        return [*((self.weight, [i]) for i in entries), (self.weight * self.ratio, entries)]


@dataclass(frozen=True, kw_only=True)
class SCAD(Separable):
    """weight * sum: a up to 1, then a parabola, constant from `shape` on (Fan and Li 2001; Ikeda 2024)."""

    shape: float = 3.7

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("shape", self.shape, 2.0, exclusive=True)

    def value(self, a: Array) -> float:
        g = self.shape
        middle = (2 * g * a - a * a - 1) / (2 * (g - 1))
        return float(self.weight * np.where(a <= 1, a, np.where(a <= g, middle, (g + 1) / 2)).sum())

    def majoriser(self, a: Array) -> Majoriser:
        slope = np.clip((self.shape - a) / (self.shape - 1), 0.0, 1.0)
        return Majoriser(self.weight * slope, np.zeros_like(a))


@dataclass(frozen=True, kw_only=True)
class MCP(Separable):
    """weight * sum: a - a^2 / (2 shape) up to shape, constant from there on (Zhang 2010; Ikeda 2024)."""

    shape: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("shape", self.shape, 0.0, exclusive=True)

    def value(self, a: Array) -> float:
        g = self.shape
        return float(self.weight * np.where(a <= g, a - a * a / (2 * g), g / 2).sum())

    def majoriser(self, a: Array) -> Majoriser:
        return Majoriser(self.weight * np.maximum(1 - a / self.shape, 0.0), np.zeros_like(a))


@dataclass(frozen=True, kw_only=True)
class LogSum(Separable):
    """weight * sum log(1 + a / knee) (Candes, Wakin and Boyd 2008; Ikeda 2024)."""

    knee: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        as_number("knee", self.knee, 0.0, exclusive=True)

    def value(self, a: Array) -> float:
        return float(self.weight * np.log1p(a / self.knee).sum())

    def majoriser(self, a: Array) -> Majoriser:
        return Majoriser(self.weight / (self.knee + a), np.zeros_like(a))
