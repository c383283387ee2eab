"""Several exports of one plant, one after the other: alike, and every time once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mampc.base.errors import MampcError, counted
from mampc.identification.data import IOData
from mampc.identification.export.reading import Export, read_export


class Span(NamedTuple):
    """When a record was taken: its zone, and its first and last sample in seconds."""

    zone: str
    first: float
    last: float


def read_together(paths: Sequence[Path], **reading: Any) -> tuple[list[IOData], list[str]]:
    """The records of all exports, and what reading them noticed.

    Samples at times that an export before has told are left out, so that none counts twice.

    Args:
        paths: files of one plant.
        reading: arguments of `read_export`.

    Raises:
        MampcError: as `read_export`, or exports of several sample times or units, or one that tells nothing new.
    """
    records: list[IOData] = []
    notes: list[str] = []
    told: list[Span] = []
    for path in paths:
        export = read_export(path, **reading)
        found = like_the_others(path, export.records, records)
        spans = [_span(export, k) for k in range(len(found))]
        fresh = [
            part for record, span in zip(found, spans, strict=True) for part in _untold(record, span, told)
        ]
        lost = sum(map(len, found)) - sum(map(len, fresh))
        if not fresh:
            raise MampcError(
                f"{path}: expected other times than in the files before, received none; leave it out"
            )
        notes += [f"{path}: {note}" if len(paths) > 1 else note for note in export.notes]
        if lost:
            notes.append(f"{path}: {counted(lost, 'sample')} at times that the files before tell left out")
        records += fresh
        told += [span for span in spans if span is not None]
    return records, notes


def like_the_others(path: Path, found: Sequence[IOData], others: Sequence[IOData]) -> list[IOData]:
    """The records of one more export of a plant, with the names and units of the first.

    Raises:
        MampcError: another sample time, or another unit.
    """
    if not others:
        return list(found)
    first, own = others[0], found[0]
    units = dict(first.names.units)
    for name, unit in dict(own.names.units).items():
        if units.get(name, unit) != unit:
            raise MampcError(
                f"{path}: expected {name} in {units[name]} as before, received {unit}; export all alike"
            )
    if abs(own.dt - first.dt) > 1e-6 * first.dt:
        raise MampcError(
            f"{path}: expected samples every {first.dt:g} s as before, received {own.dt:g} s; export all alike"
        )
    return [replace(record, names=first.names) for record in found]


def _span(export: Export, k: int) -> Span | None:
    """When a record was taken; None where no date tells."""
    start = export.starts[k]
    moment = start.removesuffix(" UTC")
    try:
        first = datetime.fromisoformat(moment)
    except ValueError:
        return None
    if first.year <= 1900:  # times of the day alone
        return None
    seconds = (first - datetime(1970, 1, 1)).total_seconds()
    record = export.records[k]
    return Span(start.removeprefix(moment), seconds, seconds + (len(record) - 1) * record.dt)


def _untold(record: IOData, span: Span | None, told: Sequence[Span]) -> list[IOData]:
    """The pieces of a record outside all spans that are told."""
    if span is None:
        return [record]
    times = span.first + np.arange(len(record)) * record.dt
    new = np.ones(len(record), dtype=bool)
    for other in told:
        if other.zone == span.zone:
            new &= (times < other.first - record.dt / 2) | (times > other.last + record.dt / 2)
    if new.all():
        return [record]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], new, [False]]))).reshape(-1, 2)
    return [record[start:end] for start, end in edges.tolist() if end - start > 1]
