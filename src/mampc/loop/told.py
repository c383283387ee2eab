"""What samples are told beside measurements and references, in trajectory files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_read, as_shaped
from mampc.base.csv_table import CSVTable
from mampc.base.errors import MampcError, shown
from mampc.base.names import Names
from mampc.program.problem import Limits
from mampc.program.zone import Zone

TEXTS = ("limits", "asked", "state")  # columns that are JSON, or empty


@dataclass(frozen=True, eq=False)
class Live:
    """What one sample of a live loop was told beside measurements, reference, disturbances and variant.

    Attributes:
        told: `u_applied`, `manual` and `limits`, as far as given, as `Regulator.step` takes them.
        reference: given ahead, shape (np + 1, l), or a `Zone`; None where it was one of shape (l,).
        state: from which the step began, as text; empty where that was the state after the sample before.
    """

    told: dict[str, Any]
    reference: Array | Zone | None
    state: str


def told_columns(names: Names) -> list[str]:
    """The columns of `told_cells`, and two more: what was asked for ahead, and the state from which a step began."""
    return [*(f"{u}_applied" for u in names.inputs), *(f"{u}_manual" for u in names.inputs), *TEXTS]


def told_cells(told: Mapping[str, Any], m: int) -> list[Any]:
    """Applied inputs, flags of inputs in manual, and limits as text; empty where nothing was told."""
    cells: list[Any] = []
    for name in ("u_applied", "manual"):
        value = told.get(name)
        cells += [""] * m if value is None else as_shaped(name, value, (m,)).tolist()
    limits = told.get("limits")
    if limits is None:
        return [*cells, ""]
    given = {field.name: getattr(limits, field.name) for field in fields(limits)}
    present = {name: as_read(name, value).tolist() for name, value in given.items() if value is not None}
    return [*cells, json.dumps(present)]


def read_live(table: CSVTable, names: Names) -> tuple[Live, ...]:
    """What the samples of a file were told beside what every trajectory has; none where no `Recorder` wrote it.

    Raises:
        MampcError: cells that are not what a `Recorder` writes.
    """
    if not set(TEXTS) <= set(table.header):
        return ()
    texts = {name: table.words(name) for name in TEXTS}
    cells = {
        kind: list(zip(*(table.words(f"{u}_{of}") for u in names.inputs), strict=True))
        for kind, of in (("u_applied", "applied"), ("manual", "manual"))
    }
    rows = []
    for k in range(len(table)):
        told: dict[str, Any] = {}
        try:
            for kind, words in cells.items():
                if any(words[k]):
                    told[kind] = np.array([float(word) for word in words[k]])
            if texts["limits"][k]:
                told["limits"] = Limits(**json.loads(texts["limits"][k]))
            reference = json.loads(texts["asked"][k]) if texts["asked"][k] else None
            if isinstance(reference, dict):
                reference = Zone(**reference)
            elif reference is not None:
                reference = as_read("asked", reference)
        except (ValueError, TypeError, RecursionError):
            cell = " ".join(
                [texts["limits"][k], texts["asked"][k], *sum((words[k] for words in cells.values()), ())]
            )
            raise MampcError(
                f"{table.path}: expected what a Recorder writes in sample {k}, received {shown(cell)}"
            ) from None
        rows.append(Live(told, reference, texts["state"][k]))
    return tuple(rows)
