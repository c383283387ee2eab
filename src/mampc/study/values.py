"""The values that keys of a study file may have: numbers, times, rates, names, and the table that holds keys."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from mampc.base.checks import LARGEST

LONGEST_RUN = 1_000_000  # samples
LONGEST_EXCITATION = 100_000  # samples
LONGEST_NAME = 80  # bytes, in file names that hold two of them

_SECONDS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}


def time_in_seconds(value: Any) -> Any:
    """A number of seconds, or text with a unit of time."""
    if not isinstance(value, str):
        return value
    match = re.fullmatch(r"\s*([-+.\deE]+)\s*([A-Za-z%/]*)\s*", value)
    if match is None or match[2] not in _SECONDS:
        raise ValueError(f"a time such as 10.0 or '10 s' (units {', '.join(_SECONDS)})")
    try:
        return float(match[1]) * _SECONDS[match[2]]
    except ValueError:
        raise ValueError(f"a time such as 10.0 or '10 s' (units {', '.join(_SECONDS)})") from None


def _rate(value: Any) -> Any:
    """A number per second, or text with a unit of time, such as "0.5/min"."""
    number, slash, unit = str(value).partition("/")
    if not isinstance(value, str) or not slash:
        return value
    try:
        return float(number) / _SECONDS[unit.strip()]
    except (KeyError, ValueError):
        raise ValueError(f"a rate such as 0.01 or '0.5/min' (units {', '.join(_SECONDS)})") from None


def file_word(name: str) -> str:
    """A name as it stands in file names."""
    return re.sub(r"[\W_]+", "-", name.lower()).strip("-")


def _short_as_file(name: str) -> str:
    if len(file_word(name).encode()) > LONGEST_NAME:
        raise ValueError(f"a name of at most {LONGEST_NAME} bytes, since files are named by it")
    return name


Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False)]
Time = Annotated[float, BeforeValidator(time_in_seconds), Field(gt=0, allow_inf_nan=False)]
Lag = Annotated[float, BeforeValidator(time_in_seconds), Field(ge=0, allow_inf_nan=False)]
Rate = Annotated[float, BeforeValidator(_rate), Field(gt=0, allow_inf_nan=False)]
Values = Number | list[Number]
Width = Annotated[float, Field(ge=0)]  # may be infinite
Widths = Width | list[Width]
Weight = Number | list[Number] | list[list[Number]]
Word = Annotated[str, Field(min_length=1, max_length=80)]
Name = Annotated[Word, AfterValidator(_short_as_file)]
Whole = Annotated[int, Field(ge=0, le=LONGEST_RUN)]
Count = Annotated[int, Field(ge=1, le=LONGEST_RUN)]
Seed = Annotated[int, Field(ge=0, lt=2**64)]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
