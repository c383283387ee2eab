"""What words beside or in place of numbers mean: two states of a switch, units behind each number."""

from __future__ import annotations

import re

# Off before on, in the languages of control rooms.
PAIRS = (
    ("off", "on"), ("closed", "open"), ("close", "open"), ("shut", "open"), ("false", "true"), ("no", "yes"),
    ("stopped", "running"), ("stop", "run"), ("stop", "start"), ("inactive", "active"), ("disabled", "enabled"),
    ("aus", "ein"), ("zu", "auf"), ("falsch", "wahr"), ("nein", "ja"), ("steht", "läuft"),
    ("arrêt", "marche"), ("fermé", "ouvert"), ("fermée", "ouverte"), ("faux", "vrai"), ("non", "oui"),
    ("apagado", "encendido"), ("cerrado", "abierto"), ("spento", "acceso"), ("chiuso", "aperto"),
    ("uit", "aan"), ("dicht", "open"),
)  # fmt: skip
STATES = frozenset(word for pair in PAIRS for word in pair)
SPACES = "[\u00a0\u2007\u2009\u202f'’´`]"  # between groups of thousands
WITH_UNIT = re.compile(
    r"([+-]?[0-9.,]*[0-9](?:[eE][+-]?[0-9]+)?)\s*((?:[^\W\d_]|[%‰°µ])(?:[^\W\d_]|[%°µ/²³*·^.-]|(?<=[^\W\d])[23](?!\d)){0,11})"
)


def states(words: frozenset[str]) -> tuple[str, str] | None:
    """The words for off and on, if these are a pair; in lower case. One word alone may have any opposite."""
    return next((pair for pair in PAIRS if words == set(pair)), None)


def without_unit(cell: str) -> tuple[str, str]:
    """The number of a cell such as "12.5 %" and its unit; the whole cell and nothing where it is something else."""
    found = WITH_UNIT.fullmatch(cell)
    return (found.group(1), found.group(2)) if found else (cell, "")
