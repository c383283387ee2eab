"""Recording a live loop: what each step was told and decided, on disk before the next one, for `replay`."""

from __future__ import annotations

import csv
import json
import warnings
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mampc.base.checks import Array, as_instance, as_read, as_shaped
from mampc.base.errors import MampcError, MampcWarning
from mampc.controllers.decision import Decision
from mampc.loop.regulator import Regulator
from mampc.loop.run import DECIDED, decided_cells
from mampc.loop.state import RegulatorState
from mampc.loop.told import told_cells, told_columns
from mampc.program.problem import Limits
from mampc.program.zone import Zone


class Recorder:
    """A regulator whose steps are written down as they happen.

    One row a step, on disk before the decision comes back, so that a loop that is killed loses none. Where the disk
    fails the loop goes on: a `MampcWarning` says so, and nothing more is recorded.

    Args:
        path: of a CSV file, which must not be there yet.
        regulator: whose steps are recorded.

    Raises:
        MampcError: a file that is there, or cannot be written.

    Example:
        >>> import mampc
        >>> model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=1.0)
        >>> problem = mampc.TrackingProblem(model, prediction_horizon=10, control_horizon=3)
        >>> regulator = mampc.Regulator(mampc.MPC(problem))
        >>> folder = getfixture("tmp_path")
        >>> with mampc.Recorder(folder / "loop.csv", regulator) as recorder:
        ...     state = regulator.initial_state()
        ...     for y in ([0.0], [0.1], [0.3]):
        ...         decision = recorder.step(state, y, [1.0], manual=[False])
        ...         state = decision.state
        >>> recording = mampc.Recording.from_csv(folder / "loop.csv", model.names)
        >>> mampc.replay(regulator, None, recording, tolerance=0.0)
    """

    def __init__(self, path: str | Path, regulator: Regulator) -> None:
        self.regulator = as_instance("regulator", regulator, Regulator)
        if not isinstance(path, (str, Path)):
            raise MampcError(f"path: expected the name of a file, received {path!r}")
        self.path = Path(path)
        model = regulator.controller.problem.model
        self._dt, self._l, self._m = model.dt, model.n_outputs, model.n_inputs
        self._shapes, self._samples, self._last = (model.n_disturbances,), 0, None
        names = model.names
        try:
            self._file: Any = self.path.open("x", buffering=1, newline="", encoding="utf-8")
        except (OSError, ValueError) as error:
            raise MampcError(f"{path}: expected a new file that can be written, received: {error}") from None
        self._writer = csv.writer(self._file)
        self._writer.writerow([
            "time", *names.inputs, *names.disturbances,
            *(f"{y}_measured" for y in names.outputs), *(f"{y}_reference" for y in names.outputs),
            *DECIDED, *told_columns(names),
        ])  # fmt: skip

    def step(self, state: RegulatorState, y: Any, reference: Any, **told: Any) -> Decision:
        """`Regulator.step`, and a row of the file."""
        decision = self.regulator.step(state, y, reference, **told)
        if self._file is not None:
            try:
                self._writer.writerow(self._row(state, y, reference, decision, **told))
            except OSError as error:
                self._file = None
                warnings.warn(
                    f"{self.path}: {error}; nothing is recorded from here on", MampcWarning, stacklevel=2
                )
        self._samples, self._last = self._samples + 1, decision.state
        return decision

    def close(self) -> None:
        """Close the file; steps go on without being recorded."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _row(
        self,
        state: RegulatorState,
        y: Any,
        reference: Any,
        decision: Decision,
        *,
        u_applied: Any = None,
        measured_disturbance: Any = None,
        limits: Limits | None = None,
        manual: Any = None,
        variant: str | None = None,
    ) -> list[Any]:
        v = np.full(self._shapes, np.nan) if measured_disturbance is None else measured_disturbance
        asked, ahead = _asked(reference)
        return [
            self._samples * self._dt, *decision.u.tolist(),
            *as_shaped("measured_disturbance", v, self._shapes).tolist(),
            *as_shaped("y", y, (self._l,)).tolist(), *asked.tolist(),
            *decided_cells(decision),
            *told_cells({"u_applied": u_applied, "manual": manual, "limits": limits}, self._m),
            ahead, "" if state is self._last else state.to_json(),
        ]  # fmt: skip


def _asked(reference: Any) -> tuple[Array, str]:
    """The reference of a sample, shape (l,), and all that was asked for as text where that is more."""
    if isinstance(reference, Zone):
        centre = reference.centre
        text = json.dumps({"low": reference.low.tolist(), "high": reference.high.tolist()})
        return centre if centre.ndim == 1 else centre[0], text
    rows = as_read("reference", reference)
    return (rows, "") if rows.ndim == 1 else (rows[0], json.dumps(rows.tolist()))
