"""A closed-loop run: what came of a plant, a regulator and a reference."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.base.files import written_whole
from mampc.base.names import Names
from mampc.base.tolerances import SAME
from mampc.controllers.decision import Decision
from mampc.loop import metrics
from mampc.loop.metrics import Metrics
from mampc.loop.told import told_cells, told_columns
from mampc.program.problem import Limits
from mampc.program.zone import Zone

DECIDED = (
    "status", "objective", "lower_bound", "iterations", "solve_time_us", "remarks", "ignored", "load", "variant",
)  # fmt: skip
ENDS = ("zone_low", "zone_high")  # of zones, in names of columns
ROUNDED = 1e-12  # of the largest cost in a run: one at rest is rounding

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Run:
    """A closed-loop run of T samples, in engineering units.

    Attributes:
        t: time in seconds, shape (T,).
        u: decided inputs, shape (T, m); u[k] acts from t[k] on.
        y: true outputs at t[k], shape (T, l), without measurement noise.
        y_measured: what the regulator saw, shape (T, l).
        r: reference, shape (T, l).
        u_initial: inputs before the first sample, shape (m,).
        decisions: the regulator's decisions, with their states left out.
        v: measured disturbances, shape (T, d).
        faults: sample -> what took the plant out of its range there (see `Plant`); empty if nothing did.
        position: where the actuators were, shape (T, m): the decided inputs unless there are `Valves`.
        dt: sample time in seconds.
        names: of the inputs and outputs.
        zone: within which outputs cost nothing, ends of shape (T, l); None where all have set points.
        told: what the regulator was told of limits, inputs in manual and applied inputs at each sample; empty where
            that was nothing.
        zone_told: whether the regulator was told this zone in place of the reference, which then is its middle.
        resolution: changes up to here are rounding and no moves, in input units, shape (m,), as in `Decision`; 1e-9
            unless the controller says otherwise.
    """

    t: Array
    u: Array
    y: Array
    y_measured: Array
    r: Array
    u_initial: Array
    decisions: tuple[Decision, ...] = field(repr=False)
    dt: float
    names: Names
    v: Array
    faults: dict[int, tuple[str, ...]]
    position: Array = None  # type: ignore[assignment]  # always set after construction
    resolution: Array = None  # type: ignore[assignment]  # as above
    zone: Zone | None = None
    zone_told: bool = False
    told: tuple[Mapping[str, Any], ...] = ()

    def __post_init__(self) -> None:
        if self.resolution is None:
            object.__setattr__(self, "resolution", np.full(self.u.shape[1], SAME))
        if self.position is None:
            object.__setattr__(self, "position", self.u)

    def __repr__(self) -> str:
        statuses = ", ".join(f"{count} {status}" for status, count in self.statuses.items())
        return (
            f"Run({len(self.t)} samples of {self.dt:g} s, {self.u.shape[1]} inputs, {self.y.shape[1]} outputs, "
            f"decisions: {statuses or 'not kept'})"
        )

    def metrics(
        self, *, threshold: float = 0.1, skip: int = 0, dead_band: Any = 0.0, output_weight: Any = None
    ) -> Metrics:
        """How often the inputs move and how well the outputs follow; see `Metrics`."""
        return metrics.compute(
            self.u, self.y, self.r, self.u_initial, self.dt,
            threshold=threshold, skip=skip, dead_band=dead_band, position=self.position,
            resolution=self.resolution, zone=self.zone, output_weight=output_weight,
        )  # fmt: skip

    @property
    def solve_times(self) -> Array:
        """Seconds per step, shape (T,)."""
        return np.array([decision.solve_time for decision in self.decisions])

    @property
    def gaps(self) -> Array:
        """How much each plan may cost more than the best one, as a share of its own cost, shape (T,).

        0 where it is proven best, infinite where nothing is proven, not-a-number where inputs were held.
        """
        objective = np.array([decision.objective for decision in self.decisions])
        gap = np.array([decision.gap for decision in self.decisions])
        cost = np.abs(objective)
        cost = np.maximum(cost, ROUNDED * np.fmax.reduce(cost, initial=0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            shares: Array = np.where(gap > 0, gap / cost, gap)
        return np.where(np.isnan(objective), np.nan, shares)

    @property
    def statuses(self) -> dict[str, int]:
        """How often each status came."""
        return dict(Counter(decision.status.value for decision in self.decisions))

    def plot(self, *, limits: Limits | None = None) -> Figure:
        """All outputs with their references above all inputs as staircases; needs mampc[plot].

        Args:
            limits: to be shown too, such as `problem.limits`.
        """
        from mampc.base.drawing import BLUE
        from mampc.loop.drawing import Look, signals_figure

        return signals_figure({"closed loop": self}, look={"closed loop": Look(BLUE)}, limits=limits)

    def to_csv(self, path: str | Path) -> None:
        """Write time, decided inputs, measured disturbances, outputs, references, status, remarks, ignored outputs,
        what loads seem to do and variant, in full precision; and where the actuators were, if not as told, the
        ends of the zone, if it was told, and limits and inputs in manual, if there were some.
        """
        if len(self.decisions) != len(self.t):
            raise MampcError(
                "to_csv: expected a run with its decisions, received none; pass keep_decisions=True"
            )
        inputs, outputs = self.names.inputs, self.names.outputs
        header = [
            "time", *inputs, *self.names.disturbances, *outputs,
            *(f"{y}_measured" for y in outputs), *(f"{y}_reference" for y in outputs), *DECIDED,
        ]  # fmt: skip
        numbers = np.hstack([self.t[:, None], self.u, self.v, self.y, self.y_measured, self.r]).tolist()
        positions: list[list[Any]] = [[] for _ in self.t]
        if not np.array_equal(self.position, self.u):
            header += [f"{u}_position" for u in inputs]
            positions = self.position.tolist()
        if self.zone is not None and self.zone_told:
            header += [f"{y}_{end}" for end in ENDS for y in outputs]
            ends = np.hstack([self.zone.low, self.zone.high]).tolist()
            positions = [own + row for own, row in zip(positions, ends, strict=True)]
        if self.told:
            header += told_columns(self.names)
            cells = [[*told_cells(told, len(inputs)), "", ""] for told in self.told]
            positions = [own + row for own, row in zip(positions, cells, strict=True)]
        with written_whole(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(header)
            for row, decision, position in zip(numbers, self.decisions, positions, strict=True):
                writer.writerow([*row, *decided_cells(decision), *position])


def decided_cells(decision: Decision) -> list[Any]:
    """What a file holds of a decision beside its inputs, in the columns `DECIDED`."""
    d = decision
    told = d.status.value, d.objective, d.lower_bound, d.iterations, round(d.solve_time * 1e6, 2)
    return [*told, *told_by(d).values()]


def told_by(decision: Decision) -> dict[str, str]:
    """What a decision says beside its numbers and its status, by column of a file."""
    ignored = " ".join(f"{y}:{fault}" for y, fault in decision.ignored_outputs.items())
    load = "" if decision.load is None else str(decision.load)
    return {
        "remarks": " ".join(decision.remarks),
        "ignored": ignored,
        "load": load,
        "variant": decision.variant or "",
    }
