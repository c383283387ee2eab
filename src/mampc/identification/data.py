"""Input-output records: from a plant, from a file, to a file."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from mampc.base.checks import Array, as_array, as_matrix, as_number, as_vector, as_whole
from mampc.base.errors import MampcError
from mampc.base.files import written_whole
from mampc.base.names import Names, require_count
from mampc.plants import Plant, advance, require_plant, state_sizes
from mampc.systems.state_space import StateSpace

if TYPE_CHECKING:
    from mampc.identification.export.table import ReadingOptions


@dataclass(frozen=True, eq=False)
class IOData:
    """A record of inputs u (N, m + d) and outputs y (N, l), sampled together every dt seconds.

    y[k] is measured just as u[k] begins to act. Engineering units. The last d inputs are measured
    disturbances, if the names say so.

    Args:
        u, y: the record; one-dimensional arrays mean a single signal.
        dt: sample time in seconds.
        names: default u1.., y1...

    Raises:
        MampcError: different lengths, no samples, or numbers that are not finite.
    """

    u: Array
    y: Array
    dt: float
    names: Names = None  # type: ignore[assignment]  # always set after construction

    def __post_init__(self) -> None:
        u, y = (_column(name, getattr(self, name)) for name in ("u", "y"))
        if len(u) != len(y) or len(u) == 0:
            raise MampcError(
                f"IOData: expected as many input as output samples, received {len(u)} and {len(y)}"
            )
        if u.shape[1] == 0 or y.shape[1] == 0:
            raise MampcError(
                f"IOData: expected at least one input and output, received {u.shape[1]} and {y.shape[1]}"
            )
        names = Names.numbered(u.shape[1], y.shape[1]) if self.names is None else self.names
        names = replace(names, states=())
        require_count("names.inputs", names.inputs + names.disturbances, u.shape[1])
        require_count("names.outputs", names.outputs, y.shape[1])
        object.__setattr__(self, "u", u)
        object.__setattr__(self, "y", y)
        object.__setattr__(self, "dt", as_number("dt", self.dt, 0.0, exclusive=True))
        object.__setattr__(self, "names", names)

    def __len__(self) -> int:
        return len(self.u)

    def __getitem__(self, rows: slice) -> IOData:
        """The samples of a slice, as a record."""
        if not isinstance(rows, slice):
            raise MampcError(f"IOData: expected a slice of samples, received {rows!r}")
        return replace(self, u=self.u[rows], y=self.y[rows])

    def split(self, share: float = 2 / 3) -> tuple[IOData, IOData]:
        """The first `share` of the samples and the rest: to estimate on and to validate on."""
        cut = round(as_number("share", share, 0.0) * len(self))
        if not 0 < cut < len(self):
            raise MampcError(f"split: expected a share that leaves samples on both sides, received {share}")
        return self[:cut], self[cut:]

    def to_csv(self, path: str | Path) -> None:
        """Write a header `time,inputs,outputs` and one row per sample, in full precision."""
        time = np.arange(len(self))[:, None] * self.dt
        with written_whole(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time", *self.names.inputs, *self.names.disturbances, *self.names.outputs])
            writer.writerows(np.hstack([time, self.u, self.y]).tolist())

    @classmethod
    def from_csv(
        cls,
        path: str | Path,
        *,
        inputs: Sequence[str],
        outputs: Sequence[str],
        disturbances: Sequence[str] = (),
        dt: float | None = None,
        **options: Unpack[ReadingOptions],
    ) -> IOData:
        """Read the named columns of an export without gaps: CSV in its many forms, Excel, Parquet or JSON.

        See `read_export`, which takes the same arguments, returns the pieces where gaps split a record, and
        lists what it noticed; here, a warning says where samples are not simply what stands in the rows.

        Args:
            path: the file.
            inputs, outputs: column names.
            disturbances: columns of inputs that are measured and not manipulated.
            dt: sample time in seconds; default from the column of times, with which it must agree.
            options: see `ReadingOptions`; messages say which one they miss.

        Raises:
            MampcError: a file that cannot be read, a list of what cannot be decided with its rows, or gaps.
        """
        from mampc.identification.export import read_one

        return read_one(
            Path(path), inputs=inputs, outputs=outputs, disturbances=disturbances, dt=dt, **options
        )

    @classmethod
    def from_frame(
        cls,
        frame: Any,
        *,
        inputs: Sequence[str],
        outputs: Sequence[str],
        disturbances: Sequence[str] = (),
        dt: float | None = None,
        **options: Unpack[ReadingOptions],
    ) -> IOData:
        """Read the named columns of a pandas DataFrame, as `from_csv` does; its index may hold the times."""
        from mampc.identification.export import read_one

        return read_one(frame, inputs=inputs, outputs=outputs, disturbances=disturbances, dt=dt, **options)


def excite(
    plant: Plant | StateSpace,
    u: Any,
    *,
    dt: float | None = None,
    noise: Any = 0.0,
    seed: int = 0,
    x0: Any = None,
) -> IOData:
    """Apply inputs to a plant and record it.

    Args:
        plant: nonlinear plant, or a discrete model.
        u: inputs in engineering units, each held for dt, shape (N, m), or (N, m + d) to move the plant's
            measured disturbances too.
        dt: sample time in seconds (a discrete model has its own).
        noise: standard deviation of Gaussian measurement noise, scalar or (l,), in output units.
        seed: of the noise.
        x0: initial state; default the steady state at the plant's usual inputs, or at the first ones.

    Raises:
        MampcError: inputs of the wrong width, or a failed integration.
    """
    if isinstance(plant, StateSpace):
        if not plant.is_discrete or dt not in (None, plant.dt):
            raise MampcError(
                f"excite: expected a discrete model and its dt, received {plant.dt:g} s and dt={dt}"
            )
        dt = plant.dt
    else:
        require_plant(plant)
    dt = as_number("dt", dt, 0.0, exclusive=True)
    names, l = plant.names, len(plant.names.outputs)
    signal = _column("u", u)
    if signal.shape[1] == len(names.inputs):
        names = names.undisturbed()
    signal = as_matrix("u", signal, None, len(names.inputs) + len(names.disturbances))
    if isinstance(plant, StateSpace):
        rest = np.tile(plant.v_op, (len(signal), 1))[:, : plant.B.shape[1] - signal.shape[1]]
        y = plant.response(np.hstack([signal, rest]), x0)
    else:
        x = as_array("x0", plant.steady_state(getattr(plant, "u_op", signal[0])) if x0 is None else x0)
        x = as_vector("x0", x, len(plant.names.states) or x.size)
        y, sizes = np.empty((len(signal), l)), state_sizes(plant)
        for k, inputs in enumerate(signal):
            y[k] = plant.output(x, inputs)
            x = advance(plant, x, inputs, dt, sizes=sizes)
    spread = as_vector("noise", noise, l, 0.0)
    y = y + spread * np.random.default_rng(as_whole("seed", seed, 0)).standard_normal(y.shape)
    return IOData(signal, y, dt, names)


def _column(name: str, value: Any) -> Array:
    array = as_array(name, value)
    return as_matrix(name, array[:, None] if array.ndim == 1 else array)
