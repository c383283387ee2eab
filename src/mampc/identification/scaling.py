"""Records in units of their own spread, so that no unit decides anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.data import IOData


@dataclass(frozen=True, eq=False)
class Scaled:
    """Records as differences from their means, in units of each signal's spread over all records.

    Attributes:
        u, y: one array per record, shapes (N, m) and (N, l).
        u_mean: common to all records, shape (m,): a record's own would hide what a constant means.
        y_mean: one per record, each of shape (l,).
        u_spread, y_spread: standard deviations about the records' own means, shapes (m,) and (l,).
    """

    u: tuple[Array, ...]
    y: tuple[Array, ...]
    u_mean: Array
    y_mean: tuple[Array, ...]
    u_spread: Array
    y_spread: Array

    @property
    def samples(self) -> int:
        """Of all records together."""
        return sum(map(len, self.u))

    def shortened(self, samples: int) -> Scaled:
        """No more than about so many samples: the same share of every record, from its beginning."""
        share = samples / self.samples
        if share >= 1:
            return self
        cuts = [max(1, round(share * len(u))) for u in self.u]
        return self.replaced(
            [u[:cut] for u, cut in zip(self.u, cuts, strict=True)],
            [y[:cut] for y, cut in zip(self.y, cuts, strict=True)],
        )

    def replaced(self, u: Sequence[Array], y: Sequence[Array]) -> Scaled:
        """The same units and means for other samples."""
        return Scaled(tuple(u), tuple(y), self.u_mean, self.y_mean, self.u_spread, self.y_spread)


def scaled(records: Sequence[IOData], *, centred: bool = True) -> Scaled:
    """The records in units of their spread, less their means if `centred`.

    Raises:
        MampcError: a signal that is constant in every record.
    """
    first = records[0]
    names = (*first.names.inputs, *first.names.disturbances, *first.names.outputs)
    ranges = [np.concatenate([np.ptp(record.u, axis=0), np.ptp(record.y, axis=0)]) for record in records]
    still = [name for name, moved in zip(names, np.max(ranges, axis=0), strict=True) if moved == 0]
    if still:
        raise MampcError(f"n4sid: expected signals that vary, received constant {', '.join(still)}")
    u_spread = _spread([record.u for record in records])
    y_spread = _spread([record.y for record in records])
    m, l = len(u_spread), len(y_spread)
    count = sum(map(len, records))
    u_mean = sum(record.u.sum(axis=0) for record in records) / count if centred else np.zeros(m)
    y_mean = tuple(record.y.mean(axis=0) if centred else np.zeros(l) for record in records)
    return Scaled(
        tuple((record.u - u_mean) / u_spread for record in records),
        tuple((record.y - mean) / y_spread for record, mean in zip(records, y_mean, strict=True)),
        u_mean, y_mean, u_spread, y_spread,
    )  # fmt: skip


def _spread(signals: Sequence[Array]) -> Array:
    """Standard deviation of each column about the means of its pieces; of the whole where they stand still."""
    count = sum(map(len, signals))
    about_own = np.sqrt(sum(len(piece) * piece.var(axis=0) for piece in signals) / count)
    whole = np.concatenate(signals).std(axis=0) if len(signals) > 1 else about_own
    spread: Array = np.where(about_own > 1e-9 * whole, about_own, whole)
    return spread
