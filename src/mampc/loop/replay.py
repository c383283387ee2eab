"""Replaying a recorded run: the same measurements must lead to the same decisions.

What a regulator decides depends on its state and on what it is told, and on nothing else. So a recording of
what it was told accounts for why it decided as it did, and shows whether anything has changed since.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.base.csv_table import CSVTable
from mampc.base.errors import MampcError
from mampc.base.names import Names
from mampc.loop.regulator import Regulator
from mampc.loop.run import ENDS, Run, told_by
from mampc.loop.state import RegulatorState
from mampc.loop.told import Live, read_live
from mampc.program.zone import Zone

SAME_DECISION = 1e-9  # relative to the size of a number, at least one unit


@dataclass(frozen=True, eq=False)
class Recording:
    """What a regulator was told in T samples, and what it decided, in engineering units.

    (Of a simulated run with preview not how the reference goes on beyond the run.)

    Attributes:
        t: seconds, shape (T,).
        y: measurements, shape (T, l), not-a-number where none came.
        r: references, shape (T, l).
        v: measured disturbances, shape (T, d), not-a-number where none came.
        u: decided inputs, shape (T, m).
        objective: of each decision, shape (T,), not-a-number where inputs were held.
        status, remarks, ignored, load: of each decision, as text.
        variant: which controller of a `ControllerBank` decided, by name; empty words where there is none.
        names: of the signals.
        zone: told in place of the references, ends of shape (T, l); None where none was.
        live: what each sample was told beside that; none where nothing was.
    """

    t: Array
    y: Array
    r: Array
    v: Array
    u: Array
    objective: Array
    status: tuple[str, ...]
    remarks: tuple[str, ...]
    ignored: tuple[str, ...]
    load: tuple[str, ...]
    variant: tuple[str, ...]
    names: Names
    zone: Zone | None = None
    live: tuple[Live, ...] = ()

    @classmethod
    def of(cls, run: Run) -> Recording:
        """The recording of a simulated run."""
        objective = np.array([decision.objective for decision in run.decisions])
        status = tuple(decision.status.value for decision in run.decisions)
        said = [told_by(decision) for decision in run.decisions]
        remarks, ignored, load, variant = (
            tuple(words[kind] for words in said) for kind in ("remarks", "ignored", "load", "variant")
        )
        return cls(
            run.t,
            run.y_measured,
            run.r,
            run.v,
            run.u,
            objective,
            status,
            remarks,
            ignored,
            load,
            variant,
            run.names,
            run.zone if run.zone_told else None,
            tuple(Live(dict(told), None, "") for told in run.told),
        )

    @classmethod
    def from_csv(cls, path: str | Path, names: Names) -> Recording:
        """Read what `Run.to_csv` or a `Recorder` wrote of a plant with these names, up to its last whole row.

        Raises:
            MampcError: anything else.
        """
        table = CSVTable(path, whole=True)
        live = read_live(table, names)

        def columns(words: list[str], *, finite: bool = True) -> Array:
            read = [table.numbers(word, finite=finite) for word in words]
            return np.array(read).reshape(len(words), len(table)).T

        zone = None
        if f"{names.outputs[0]}_{ENDS[0]}" in table.header:
            zone = Zone(*(columns([f"{name}_{end}" for name in names.outputs], finite=False) for end in ENDS))
        return cls(
            table.numbers("time"),
            columns([f"{name}_measured" for name in names.outputs], finite=False),
            columns([f"{name}_reference" for name in names.outputs], finite=zone is None and not live),
            columns(list(names.disturbances), finite=not live),
            columns(list(names.inputs)),
            table.numbers("objective", finite=False),
            tuple(table.words("status")),
            tuple(table.words("remarks")),
            tuple(table.words("ignored")),
            tuple(table.words("load")),
            tuple(table.words("variant")),
            names,
            zone,
            live,
        )

    def asked(self, k: int, samples: int | None) -> Array | Zone:
        """What the regulator was asked for at sample k; of so many samples from it on where it saw ahead."""
        ahead = self.live[k].reference if self.live else None
        if ahead is not None:
            return ahead
        part: Any = k
        if samples is not None and not (self.live and self.live[0].state):  # a simulated run
            part = np.minimum(np.arange(k, k + samples), len(self.t) - 1)
        return self.r[part] if self.zone is None else Zone(self.zone.low[part], self.zone.high[part])


@dataclass(frozen=True)
class Difference:
    """The first decision that did not come out as recorded."""

    sample: int
    time: float
    quantity: str
    recorded: str
    replayed: str

    def __str__(self) -> str:
        return (
            f"sample {self.sample} (t = {self.time:g} s): {self.quantity} was {self.recorded}, "
            f"and is {self.replayed} now"
        )


def replay(
    regulator: Regulator,
    state: RegulatorState | None,
    recording: Recording,
    *,
    preview: bool = False,
    tolerance: float = SAME_DECISION,
) -> Difference | None:
    """Decide again on what was recorded, and find the first decision that differs.

    Args:
        regulator: a new one, as it was then.
        state: from which the recording began; None for the one that a `Recorder` wrote down.
        recording: what the regulator was told and decided.
        preview: whether it saw the reference of a simulated run over its horizon.
        tolerance: of times, inputs and objectives, relative to their size (at least one unit); 0 for the same bits.

    Returns:
        None if every decision came out as recorded.
    """
    tolerance = as_number("tolerance", tolerance, 0.0)
    model, l = regulator.controller.problem.model, recording.y.shape[1]
    m, d = recording.u.shape[1], recording.v.shape[1]
    if (m, l) != (model.n_inputs, model.n_outputs) or model.n_disturbances not in (0, d):
        raise MampcError(
            f"replay: expected a recording of {model.n_inputs} inputs, {model.n_outputs} outputs and "
            f"{model.n_disturbances} measured disturbances, received {m}, {l} and {d}"
        )
    samples = regulator.controller.problem.prediction_horizon + 1 if preview else None
    for k, t in enumerate(recording.t.tolist()):
        told: dict[str, Any] = recording.live[k].told if recording.live else {}
        if recording.live and recording.live[k].state and (k > 0 or state is None):
            state = regulator.state_from_json(recording.live[k].state)
        if state is None:
            raise MampcError("replay: expected a state from which the recording began, received none")
        decision = regulator.step(
            state,
            recording.y[k],
            recording.asked(k, samples),
            measured_disturbance=recording.v[k] if model.n_disturbances else None,
            variant=recording.variant[k] or None,
            **told,
        )
        state = decision.state
        for name, said, says in (
            ("the status", recording.status[k], decision.status.value),
            ("the remarks", recording.remarks[k], told_by(decision)["remarks"]),
            ("the ignored outputs", recording.ignored[k], told_by(decision)["ignored"]),
            ("the load", recording.load[k], told_by(decision)["load"]),
        ):
            if said != says:
                return Difference(k, t, name, said or "none", says or "none")
        for name, was, now in (
            ("the time", t, k * model.dt),
            *zip(recording.names.inputs, recording.u[k].tolist(), decision.u.tolist(), strict=True),
            ("the objective", float(recording.objective[k]), decision.objective),
        ):
            both_unknown = was != was and now != now
            if not (both_unknown or abs(now - was) <= tolerance * max(1.0, abs(was))):
                return Difference(k, t, name, repr(was), repr(float(now)))
    return None
