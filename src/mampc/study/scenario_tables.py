"""What happens in a scenario of a study: references, loads, valves, mismatch, switches."""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from mampc.base.errors import said_at
from mampc.loop import loads
from mampc.loop.loads import Load
from mampc.loop.valves import Valves
from mampc.study.values import Lag, Name, Number, Seed, Table, Time, Values, Whole, Widths, Word


class ChangeTable(Table):
    at: Whole
    value: Values


class ZoneTable(Table):
    """From a sample on, other widths of the zones about the reference."""

    at: Whole
    below: Widths
    above: Widths


class ReferenceTable(Table):
    relative: bool = True
    preview: bool = False
    initial: list[Number]
    changes: list[ChangeTable] = []
    zones: list[ZoneTable] = []


LOADS = {
    "steps": loads.Steps, "random_steps": loads.RandomSteps, "random_walk": loads.RandomWalk,
    "coloured": loads.Coloured, "sinusoid": loads.Sinusoid,
}  # fmt: skip


class LoadTable(Table):
    """A load of `mampc.loads`, with the same settings; times in seconds or with a unit."""

    kind: Literal["steps", "random_steps", "random_walk", "coloured", "sinusoid", "residuals"]
    at: Literal["input", "output", "measured"] | None = None
    size: Values | None = None
    sizes: list[Values] | None = None
    times: list[Lag] | None = None
    every: Time | None = None
    time_constant: Time | None = None
    period: Time | None = None
    phase: Number | Literal["random"] | None = None
    file: Annotated[str, Field(min_length=1, max_length=1000)] | None = None

    @model_validator(mode="after")
    def _fits_its_kind(self) -> LoadTable:
        if self.kind != "residuals":
            self.made()
        elif self.settings().keys() - {"at"} != {"file"}:
            raise ValueError("a file for a load of kind 'residuals', and nothing else beside its kind and at")
        return self

    def settings(self) -> dict[str, Any]:
        """What is said of it."""
        given = {name: value for name, value in self if value is not None and name != "kind"}
        if given.get("phase") == "random":
            given["phase"] = None
        return given

    def made(self) -> Load:
        """The load, of a kind that needs no file."""
        kind, given = LOADS[self.kind], self.settings()
        known = {field.name: field for field in fields(kind)}
        wrong = given.keys() - known.keys()
        missing = {name for name, field in known.items() if field.default is MISSING} - given.keys()
        if wrong or missing:
            what = f"no {', '.join(sorted(wrong))}" if wrong else f"{', '.join(sorted(missing))}"
            raise ValueError(f"{what} for a load of kind {self.kind!r}")
        with said_at("other settings of the load: ", ValueError):
            load: Load = kind(**given)
        return load


class ValvesTable(Table):
    band: Values = 0.0
    jump: Values = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> ValvesTable:
        with said_at("other valves: ", ValueError):
            Valves(**self.model_dump())
        return self


Share = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]


class MismatchTable(Table):
    gain: Share = 0.0
    lag: Share = 0.0
    dead_time: Share = 0.0


class SwitchTable(Table):
    """From a sample on, another variant of banks of controllers decides."""

    at: Whole
    variant: Word


class LimitsTable(Table):
    u_min: Values | None = None
    u_max: Values | None = None
    du_max: Values | None = None
    y_min: Values | None = None
    y_max: Values | None = None


class LimitsNowTable(LimitsTable):
    """From a sample on, other limits than those of the problem; none for these again."""

    at: Whole


class ManualTable(Table):
    """An input that somebody moves by hand, from a sample on and up to another one."""

    at: Whole
    until: Whole
    input: Word
    value: Number

    @model_validator(mode="after")
    def _lasts(self) -> ManualTable:
        if self.until <= self.at:
            raise ValueError(f"until beyond at, which is {self.at}; received {self.until}")
        return self


class ScenarioTable(Table):
    name: Name
    noise: Values = 0.0
    seed: Seed = 0
    input_disturbance: Values | None = None
    output_disturbance: Values | None = None
    measured_disturbance: Values | None = None
    disturbance_at: Whole = 0
    loads: list[LoadTable] = []
    valves: ValvesTable | None = None
    mismatch: MismatchTable | None = None
    switches: list[SwitchTable] = []
    limits: list[LimitsNowTable] = []
    manual: list[ManualTable] = []
