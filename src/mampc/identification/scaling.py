"""Records in units of their own spread, so that no unit decides anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.data import IOData

LONG = 1000  # samples of a record that say enough of its plant


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
        """No more than about so many samples, the first ones of each record; see `lengths`."""
        if samples >= self.samples:
            return self
        return self.stretches([slice(0, length) for length in self.lengths(samples)])

    def lengths(self, samples: int) -> list[int]:
        """Of how many samples of each record about so many in all consist.

        The same share of each, or, where these would be short, the longest records and none of the others.
        """
        share = min(1.0, samples / self.samples)
        own = [max(1, round(share * len(u))) for u in self.u]
        if max(own) >= min(LONG, max(map(len, self.u))):
            return own
        taken, lengths = 0, [0] * len(self.u)
        for k in sorted(range(len(self.u)), key=lambda k: -len(self.u[k])):
            if taken < samples:
                lengths[k] = len(self.u[k])
                taken += lengths[k]
        return lengths

    def stretches(self, where: Sequence[slice]) -> Scaled:
        """One stretch of each record; records of which nothing is taken are left out."""
        kept = [
            (u[rows], y[rows], mean)
            for u, y, mean, rows in zip(self.u, self.y, self.y_mean, where, strict=True)
            if rows.stop > rows.start
        ]
        u, y, means = (tuple(signals) for signals in zip(*kept, strict=True))
        return replace(self, u=u, y=y, y_mean=means)

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
