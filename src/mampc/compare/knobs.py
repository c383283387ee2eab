"""The one number that trades moves for error in each method, and controllers with other values of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.errors import MampcError, shown
from mampc.methods.registry import METHODS
from mampc.study.schema import ControllerTable

KNOBS = {
    "dead_band": "size",
    "rounded": "step",
    "periodic": "every",
    "event_triggered": "threshold",
    "self_triggered": "overshoot",
    "quiet_zone": "band",
    "penalised": "weight",
}
SPAN = 16.0  # factor by which a knob goes up and down from what the study says


def knob_of(table: ControllerTable) -> str | None:
    """Where the knob of a controller stands, such as "rules.price" or "settings.size"; None if it has none."""
    if table.method in KNOBS:
        return f"settings.{KNOBS[table.method]}"
    if table.method in METHODS and table.rules is not None:
        if np.any(np.asarray(table.rules.price) > 0):
            return "rules.price"
        if table.rules.max_moves is not None:
            return "rules.max_moves"
    return None


def variants(table: ControllerTable, points: int) -> list[tuple[float, ControllerTable]]:
    """A controller with values of its knob from a sixteenth of the study's own to sixteen times it.

    Whole numbers are rounded and come once; what has no knob comes as it is, with the value 1.

    Raises:
        MampcError: a knob that is no number.
    """
    place = knob_of(table)
    if place is None or points < 2:
        return [(1.0, table)]
    part, name = place.split(".")
    own = getattr(table, part)
    usual: Any = getattr(own, name) if part == "rules" else own.get(name, 1.0)
    factors = np.geomspace(1 / SPAN, SPAN, points)
    found: dict[Any, tuple[float, ControllerTable]] = {}
    for factor in factors.tolist():
        if name in ("max_moves", "every"):
            value: Any = max(1, round(usual * factor))
        elif name == "overshoot":
            value = 1.0 + (usual - 1.0 if usual > 1 else 0.5) * factor
        else:
            value = _scaled(f"controllers, {table.name!r}: {name}", usual, factor)
        key = tuple(value) if isinstance(value, list) else value
        if part == "rules":
            changed = {"rules": own.model_copy(update={name: value})}
        else:
            changed = {"settings": own | {name: value}}
        number = factor if isinstance(value, list) else float(value)
        found[key] = (number, table.model_copy(update=changed))
    return list(found.values())


def _scaled(place: str, value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_scaled(place, entry, factor) for entry in value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MampcError(f"{place}: expected a number or one per signal, received {shown(value)}")
    return float(value) * factor
