"""What a study file may say: one class a table, one field a key."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, InstanceOf, model_validator

from mampc.base.errors import said_at
from mampc.loop.reference_filter import ReferenceFilter
from mampc.loop.valves import Valves
from mampc.methods.registry import METHODS, method_of
from mampc.moves.rules import MoveRules
from mampc.plants import Level, QuadrupleTank, SolidOxideFuelCell, VanDeVusse, ogunnaike_ray, wood_berry
from mampc.program.levels import OnOff
from mampc.program.problem import LONGEST_HORIZON
from mampc.rivals.registry import RIVALS, RULES, check_settings
from mampc.study.scenario_tables import LimitsTable, ReferenceTable, ScenarioTable
from mampc.study.values import (
    LONGEST_EXCITATION,
    LONGEST_RUN,
    Count,
    Lag,
    Name,
    NotNegative,
    Number,
    Positive,
    Rate,
    Seed,
    Table,
    Time,
    Values,
    Weight,
    Whole,
    Widths,
    Word,
    file_word,
)

PLANTS: dict[str, Callable[..., Any]] = {
    "quadruple-tank": QuadrupleTank, "sofc": SolidOxideFuelCell, "van-de-vusse": VanDeVusse, "level": Level,
    "wood-berry": wood_berry, "ogunnaike-ray": ogunnaike_ray,
}  # fmt: skip
SAMPLED = ("wood-berry", "ogunnaike-ray")  # models, made for the study's sample time
BANK = "bank"  # the method of a `ControllerBank`
PLUGIN = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")  # module:Class


class PlantTable(Table):
    kind: Word
    parameters: dict[str, Any] = {}
    operating_inputs: list[Number] | None = None


class ModelTable(Table):
    file: Annotated[str, Field(min_length=1, max_length=1000)]


class IdentificationTable(Table):
    order: Annotated[int, Field(ge=1, le=200)] | None = None
    weighting: Literal["cva", "n4sid", "moesp"] = "cva"
    feedthrough: bool = False
    prbs_order: Annotated[int, Field(ge=2, le=16)] = 8
    amplitude: Values
    hold: Annotated[int, Field(ge=1, le=10_000)] = 1
    noise: Values = 0.0
    seed: Seed = 1

    @model_validator(mode="after")
    def _not_endless(self) -> IdentificationTable:
        samples = (2**self.prbs_order - 1) * self.hold
        if samples > LONGEST_EXCITATION:
            raise ValueError(
                f"at most {LONGEST_EXCITATION} samples of excitation; received prbs_order and hold for {samples}"
            )
        return self


class ProblemTable(Table):
    prediction_horizon: Annotated[int, Field(ge=1, le=LONGEST_HORIZON)]
    control_horizon: Annotated[int, Field(ge=1, le=LONGEST_HORIZON)]
    output_weight: Weight = 1.0
    move_weight: Weight = 0.1
    limits: LimitsTable = LimitsTable()
    weigh_first_move: bool = True
    output_limit_weight: Positive = 1e4
    tail_horizon: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    u_target: Values | None = None
    u_target_weight: Weight = 0.0
    u_cost: Values = 0.0
    zone_below: Widths = 0.0
    zone_above: Widths = 0.0
    zone_pull: Annotated[float, Field(ge=0, lt=1)] = 0.0
    output_rank: Count | list[Count] | None = None


class ActuatorsTable(Table):
    """What is known of the actuators: their dead-band, and what their maker says they stand."""

    dead_band: NotNegative | list[NotNegative] = 0.0
    band: NotNegative | list[NotNegative] | None = None
    jump: NotNegative | list[NotNegative] | None = None
    starts_per_hour: Positive | list[Positive] | None = None
    million_starts: Positive | list[Positive] | None = None

    def valves(self) -> Valves:
        """What is known of how they stick; with a dead-band alone they go where they are told after larger changes."""
        band = self.dead_band if self.band is None else self.band
        jump = (self.dead_band if self.band is None else 0.0) if self.jump is None else self.jump
        return Valves(band=band, jump=jump)

    @model_validator(mode="after")
    def _consistent(self) -> ActuatorsTable:
        with said_at("other actuators: ", ValueError):
            self.valves()
        return self


class ReferenceFilterTable(Table):
    """As `mampc.ReferenceFilter`."""

    time_constant: Lag | list[Lag] = 0.0
    rate: Rate | list[Rate] | None = None

    def made(self) -> ReferenceFilter:
        return ReferenceFilter(**self.model_dump())


class PublishedTable(Table):
    sparse_density: list[Number]
    tracking_error: Number
    without_transient: PublishedTable | None = None


class OnOffTable(Table):
    """As `mampc.OnOff`; times in seconds or with a unit."""

    off: Number | None = None
    on: Number | None = None
    min_on: Lag = 0.0
    min_off: Lag = 0.0
    starts_per_hour: Count | None = None


# A step, a list of levels, on and off, or "any" for an input that takes any value.
Levels = (
    Positive
    | OnOffTable
    | list[Positive | Annotated[list[Number], Field(min_length=1)] | OnOffTable | Literal["any"]]
)


class RulesTable(Table):
    max_moves: Whole | None = None
    sparsity_horizon: Annotated[int, Field(ge=1, le=LONGEST_HORIZON)] = 1
    price: Values = 0.0
    counting: Literal["elementwise", "simultaneous"] = "elementwise"
    min_size: Values = 0.0
    dwell: Annotated[int, Field(ge=1, le=LONGEST_HORIZON)] = 1
    max_moves_per_step: Count | None = None
    blocks: Annotated[list[Count], Field(min_length=1)] | None = None
    levels: Levels | None = None

    def made(self) -> MoveRules:
        """The rules that the table describes."""
        levels = (
            [_entry(entry) for entry in self.levels] if isinstance(self.levels, list) else _entry(self.levels)
        )
        return MoveRules(**self.model_dump(exclude={"levels"}), levels=levels)

    @model_validator(mode="after")
    def _consistent(self) -> RulesTable:
        with said_at("other rules: ", ValueError):
            self.made()
        return self


def _entry(levels: Any) -> Any:
    if isinstance(levels, OnOffTable):
        return OnOff(**levels.model_dump())
    return None if levels == "any" else levels


class ControllerTable(Table):
    name: Name
    method: Word
    rules: RulesTable | None = None
    settings: dict[str, Any] = {}
    around: Word = "mpc"
    on_limit_violation: Literal["keep_budget", "ignore_budget"] = "keep_budget"
    violation_margin: Values = 0.0
    reference_filter: ReferenceFilterTable | None = None
    compensate: bool = False
    learn_gains: bool = False
    published: PublishedTable | None = None
    variants: list[Word] = []

    @model_validator(mode="after")
    def _rules_where_needed(self) -> ControllerTable:
        if self.compensate and self.method not in (*METHODS, BANK):
            raise ValueError(
                f"compensate with one of {', '.join(METHODS)}, {BANK} only; received {self.method!r}"
            )
        if (self.method == BANK) != bool(self.variants):
            raise ValueError(f"variants, names of other controllers, with the method {BANK!r} and no other")
        if self.method == BANK:
            if self.rules is not None or self.settings:
                raise ValueError(
                    f"neither rules nor settings for the method {BANK!r}: its variants have them"
                )
            return self
        if self.method in RIVALS:
            return self._as_rival()
        if self.around != "mpc":
            raise ValueError(
                f"around with the rules {', '.join(RULES)} only; received the method {self.method!r}"
            )
        if self.method == "mpc":
            if self.rules is not None or self.settings:
                raise ValueError("neither rules nor settings for the method 'mpc', which has none")
            return self
        if self.method not in METHODS:
            known = ", ".join(("mpc", *METHODS, *RIVALS))
            raise ValueError(f"a method, one of {known}; received {self.method!r}")
        if self.rules is None:
            raise ValueError(f"rules for the method {self.method!r}, such as rules = {{ max_moves = 3 }}")
        with said_at("other settings: ", ValueError):
            method_of(self.method, self.settings)
        return self

    def _as_rival(self) -> ControllerTable:
        with said_at("other settings: ", ValueError):
            check_settings(self.method, self.settings)
        if self.around != "mpc" and (self.method not in RULES or self.around not in METHODS):
            raise ValueError(
                f"around one of {', '.join(('mpc', *METHODS))}, with {', '.join(RULES)} only; received {self.around!r}"
            )
        if (self.rules is None) != (self.around == "mpc"):
            raise ValueError("rules for what a rule is put around, if that is not 'mpc'")
        return self


class EstimatorTable(Table):
    kind: Literal["usual", "kalman_filter", "load_bank"] = "usual"  # what each controller has by default
    value_of_information: bool | None = None  # usual where moves have a price and are few
    price_follows_noise: bool = False
    disturbance: Literal["auto", "output", "input"] = "auto"
    measurement_noise: Values | None = None
    drift: Values | None = None
    input_noise: Values | None = None

    @model_validator(mode="after")
    def _settings_of_the_kind(self) -> EstimatorTable:
        if self.kind == "load_bank":
            other = {"disturbance", "drift", "input_noise"} & self.model_fields_set
            if other:
                raise ValueError(
                    f"neither disturbance, drift nor input_noise for a load_bank; received {', '.join(sorted(other))}"
                )
        elif self.value_of_information and self.is_kalman_filter:
            raise ValueError('value_of_information with kind = "load_bank" only, which knows the noise')
        if self.price_follows_noise and not self.value_of_information:
            raise ValueError("value_of_information beside price_follows_noise")
        return self

    @property
    def is_kalman_filter(self) -> bool:
        """Whether it is one for all controllers: it says so, or says what only a Kalman filter is told."""
        told = self.disturbance != "auto" or self.drift is not None or self.input_noise is not None
        return self.kind == "kalman_filter" or told


class SensorsTable(Table):
    y_low: Values | None = None
    y_high: Values | None = None
    largest_jump: Values | None = None
    confirm: Count = 3
    stuck_after: Annotated[int, Field(ge=2, le=LONGEST_RUN)] | None = 10
    max_blind_steps: Whole = 0


class Place(NamedTuple):
    """Where a study comes from.

    Attributes:
        folder: in which the files and modules that it names are looked for.
        trusted: whether its plant's code may be imported.
    """

    folder: Path = Path()
    trusted: bool = False


class Study(Table):
    """A checked study; attributes are the keys of the file, and the `place` that it comes from."""

    name: Word
    steps: Count
    dt: Time
    threshold: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.1
    skip: Whole = 0
    plant: PlantTable
    identification: IdentificationTable | None = None
    model: ModelTable | None = None
    problem: ProblemTable
    estimator: EstimatorTable = EstimatorTable()
    sensors: SensorsTable = SensorsTable()
    actuators: ActuatorsTable | None = None
    reference: ReferenceTable
    scenarios: Annotated[list[ScenarioTable], Field(min_length=1)]
    controllers: Annotated[list[ControllerTable], Field(min_length=1)]

    place: InstanceOf[Place] = Place()

    @property
    def error_weight(self) -> Any:
        """Q, where the outputs weigh differently, so that errors are compared with it; None where all weigh alike."""
        weight = np.asarray(self.problem.output_weight, dtype=np.float64)
        matrix = np.diag(weight) if weight.ndim == 1 else weight
        alike = weight.ndim == 0 or np.array_equal(matrix, matrix[0, 0] * np.eye(len(matrix)))
        return None if alike else self.problem.output_weight

    @model_validator(mode="after")
    def _consistent(self) -> Study:
        if (self.identification is None) == (self.model is None):
            raise ValueError("one of the tables [identification] and [model]")
        if self.plant.kind not in ("model", *PLANTS) and not PLUGIN.fullmatch(self.plant.kind):
            known = ", ".join(sorted(("model", *PLANTS)))
            raise ValueError(f"a plant.kind among {known}, or module:Class; received {self.plant.kind!r}")
        if self.plant.kind == "model" and self.model is None:
            raise ValueError("a table [model] with a file for plant.kind = 'model'")
        if self.plant.kind == "model" and self.plant.parameters:
            raise ValueError("no plant.parameters for plant.kind = 'model'")
        if any(table.compensate for table in self.controllers) and self.actuators is None:
            raise ValueError(
                "a table [actuators] with a dead_band, or a band and jump, for controllers that compensate it"
            )
        if self.skip >= self.steps:
            raise ValueError(f"a skip below the {self.steps} steps; received {self.skip}")
        for kind in ("scenarios", "controllers"):
            names = [file_word(table.name) for table in getattr(self, kind)]
            if len(set(names)) != len(names):
                raise ValueError(f"{kind} with names that differ in letters or digits; received {names}")
        self._check_banks()
        return self

    def _check_banks(self) -> None:
        alone = [table.name for table in self.controllers if table.method in ("mpc", *METHODS)]
        asked = {switch.variant for scenario in self.scenarios for switch in scenario.switches}
        banks = [table for table in self.controllers if table.method == BANK]
        if asked and not banks:
            raise ValueError(f"switches of scenarios with a controller of the method {BANK!r}; received none")
        for table in self.controllers:
            own = table.compensate or table.learn_gains or table.reference_filter is not None
            if own and any(table.name in bank.variants for bank in banks):
                raise ValueError(
                    f"neither compensate, learn_gains nor a reference_filter of {table.name!r}, a variant of a bank"
                )
        for table in banks:
            if not set(table.variants) <= set(alone) or not asked <= set(table.variants):
                raise ValueError(
                    f"variants of {table.name!r} among {', '.join(alone)}, with all that scenarios switch to; "
                    f"received {', '.join(table.variants)}, and switches to {', '.join(sorted(asked)) or 'none'}"
                )
