"""What a cell may be: a number in its many forms, with a unit behind it, a state of a switch, a mark."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

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


POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
FORTRAN = re.compile(r"([+-]?(?:\d+[.,]\d*|[.,]\d+))[dD]([+-]?\d+)", re.ASCII)
INDIAN = r"\d{1,2}(,\d{2})+,\d{3}(\.\d*)?"  # 12,34,567.8
GROUPED = re.compile(rf"[+-]?(\d{{1,3}}(,\d{{3}})+(\.\d*)?|{INDIAN})", re.ASCII)  # 1,234 or 1,234,567.8
GROUPED_FOR_SURE = re.compile(rf"[+-]?(\d{{1,3}}((,\d{{3}})+\.\d*|(,\d{{3}}){{2,}})|{INDIAN})", re.ASCII)
SPACE = re.compile(SPACES)  # a plain space may part two numbers
APART = re.compile(r"[+-]?\d{1,3}( \d{3})+([.,]\d*)?", re.ASCII)
APART_FOR_SURE = re.compile(r"[+-]?\d{1,3}(( \d{3})+[.,]\d*|( \d{3}){2,})", re.ASCII)
SPACED = re.compile(rf"[+-]?\d{{1,3}}({SPACE.pattern}\d{{3}})+(\.\d*)?", re.ASCII)
EITHER = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}", re.ASCII)  # 1,234: grouped thousands, or three decimals
MINUS = str.maketrans("−–", "--")
DIGIT = re.compile(r"\d")
# Words that programs write in the place of a value with digits in them; a word without digits never is a number.
MARK = re.compile(
    r"#|\b(bad|no ?data|no ?good|err(or)?|fail(ed|ure)?|invalid|time ?out|null|nan)\b", re.IGNORECASE
)
SWAPPED = str.maketrans(",.", ".,")


def states(words: frozenset[str]) -> tuple[str, str] | None:
    """The words for off and on, if these are a pair; in lower case. One word alone may have any opposite."""
    return next((pair for pair in PAIRS if words == set(pair)), None)


def without_unit(cell: str) -> tuple[str, str]:
    """The number of a cell such as "12.5 %" and its unit; the whole cell and nothing where it is something else."""
    found = WITH_UNIT.fullmatch(cell)
    return (found.group(1), found.group(2)) if found else (cell, "")


def clean(cell: str) -> str:
    """A cell without spaces around it, with a plain minus sign, and E for Fortran's D."""
    word = cell.strip().translate(MINUS)
    found = FORTRAN.fullmatch(word)
    return f"{found[1]}E{found[2]}" if found else word


def is_number(cell: str) -> bool:
    """Whether a cell may be a number, with either decimal mark."""
    return has_point(cell) or has_point(cell.translate(SWAPPED)) or EITHER.fullmatch(cell) is not None


def ungrouped(word: str) -> str:
    """Without spaces between thousands."""
    return word.replace(" ", "") if APART_FOR_SURE.fullmatch(word) else SPACE.sub("", word)


def has_point(word: str) -> bool:
    return POINT.fullmatch(word) is not None or GROUPED_FOR_SURE.fullmatch(word) is not None


def numeric_share(cells: Iterable[str]) -> float:
    """The share of numbers among the cells that hold anything, with either decimal mark; 0 where there is none."""
    filled = [ungrouped(clean(cell)) for cell in cells if cell]
    numbers = sum(map(is_number, filled))
    return numbers / len(filled) if filled else 0.0


def says_numbers(cells: Sequence[str]) -> bool:
    """Whether most cells that hold anything are numbers, with or without one unit, or two states in words."""
    if numeric_share(cells) > 0.5:
        return True
    filled = [clean(cell) for cell in cells if cell]
    if sum(cell.casefold() in STATES for cell in filled) > len(filled) / 2:
        return True
    bare = [number for number, unit in map(without_unit, filled) if unit]
    return len(bare) > len(filled) / 2 and numeric_share(bare) > 0.5
