"""The parameter of a sample: every number that changes from sample to sample, in one vector p.

    p = (x, u_prev, u_prev - u_op, d_u, d_y, v - v_op, 1, r - y_op)

with r either one reference (l,) that holds over the horizon, or r_0 .. r_np one after the other; where outputs have a
zone, each r holds the ends of these (see `zone.ZoneEnds`). Deviations from the
operating point are taken before anything is multiplied: large responses of an integrator would turn the rounding of
absolute values into errors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mampc.base.checks import Array, as_shaped
from mampc.program.problem import TrackingProblem
from mampc.program.sample import Indices
from mampc.program.zone import Zone, ZoneEnds

_ONE = np.ones(1)


class Parameter:
    """Where each quantity stands in p, for a previewed reference.

    Attributes:
        x: state, a slice of n entries, as the others are slices of p.
        u_previous: inputs until now, m entries, in engineering units.
        u_deviation: the same from the operating point.
        input_disturbance, output_disturbance: m and l entries.
        measured_disturbance: d entries, from the operating point.
        one: the constant 1.
        reference: (np + 1) l entries, from the operating point; with zones the ends of each sample.
        references: where r_0 .. r_np stand, the lower ends of zones among them, ((np + 1) l,).
        final_reference: the last l of `references`.
        lower_ends, upper_ends: where those of zoned outputs stand, sample by sample.
        lower_aims, upper_aims: the same of what they are drawn to; empty where they are not.
        size: of p.
        origin: what is subtracted from engineering units, by the length of p.
    """

    def __init__(self, problem: TrackingProblem) -> None:
        model = problem.model
        m, l, zoned = model.n_inputs, model.n_outputs, np.flatnonzero(problem.zoned)
        self._problem = problem
        self._ends = ZoneEnds(problem) if len(zoned) else None
        samples, width = problem.prediction_horizon + 1, l if self._ends is None else self._ends.width
        self._samples, self._width = samples, width
        sizes = [model.n_states, m, m, m, l, len(model.v_op), 1, samples * width]
        ends = np.cumsum(sizes).tolist()
        (
            self.x, self.u_previous, self.u_deviation, self.input_disturbance, self.output_disturbance,
            self.measured_disturbance, self.one, self.reference,
        ) = (slice(end - size, end) for size, end in zip(sizes, ends, strict=True))  # fmt: skip
        self.size = ends[-1]
        at = self.reference.start + np.arange(samples * width).reshape(samples, width)
        self.references, self.final_reference = at[:, :l].ravel(), at[-1, :l]
        more: list[Indices] = [
            part.ravel() for part in np.split(at[:, l:], max((width - l) // max(len(zoned), 1), 1), axis=1)
        ]
        self.lower_ends, self.upper_ends = at[:, zoned].ravel(), more[0]
        none: Indices = np.zeros(0, dtype=np.intp)
        self.lower_aims, self.upper_aims = more[1:] if len(more) > 1 else (none, none)
        origin = np.zeros(self.size)
        origin[self.u_deviation], origin[self.measured_disturbance] = model.u_op, model.v_op
        origin[self.reference] = np.tile(
            np.concatenate([model.y_op, *[model.y_op[zoned]] * len(more)]), samples
        )
        self.origin = {len(of): of for of in (origin, origin[: self.reference.start + width])}
        # No disturbances, and the measured ones of the operating point.
        self._usual: tuple[Array, Array, Array] = np.zeros(m), np.zeros(l), model.v_op

    def vector(
        self,
        x: Array,
        u_previous: Array,
        reference: Array,
        output_disturbance: Any = None,
        input_disturbance: Any = None,
        measured_disturbance: Any = None,
    ) -> Array:
        """p; all arguments in engineering units, the reference (l,) or (np + 1, l), disturbances may be left out.

        With zones the reference may have their ends in its place.
        """
        if self._ends is not None:
            reference = self.with_ends(reference)
        if reference.ndim == 2:
            reference = reference.ravel()
        d_u, d_y, v = self._usual
        if input_disturbance is not None:
            d_u = as_shaped("input_disturbance", input_disturbance, d_u.shape)
        if output_disturbance is not None:
            d_y = as_shaped("output_disturbance", output_disturbance, d_y.shape)
        if measured_disturbance is not None:
            v = as_shaped("measured_disturbance", measured_disturbance, v.shape)
        vector = np.concatenate((x, u_previous, u_previous, d_u, d_y, v, _ONE, reference))
        vector -= self.origin[len(vector)]
        return vector

    def with_ends(self, reference: Array) -> Array:
        """What stands in p for references of shape (..., l): with zones their ends, (..., width of `ZoneEnds`)."""
        if self._ends is None or reference.shape[-1] == self._width:
            return reference
        return self._ends.about(reference)

    def of_zone(self, zone: Zone) -> Array:
        """What stands in p for a zone; `MampcError` if it does not fit the problem."""
        return (ZoneEnds(self._problem) if self._ends is None else self._ends).of(zone)

    def of_zones(self, zone: Zone) -> Array:
        """The same for any number of samples, shape (T, width of `ZoneEnds`)."""
        return (ZoneEnds(self._problem) if self._ends is None else self._ends).of_rows(zone)

    def no_map(self, rows: int) -> Array:
        """A map of p to `rows` zeros, shape (rows, size), to be filled in."""
        return np.zeros((rows, self.size))

    def with_constant_reference(self, preview_map: Array) -> Array:
        """The map of a p whose reference has shape (l,): the columns of all samples summed up."""
        start, rows = self.reference.start, len(preview_map)
        constant = preview_map[:, start:].reshape(rows, self._samples, self._width).sum(axis=1)
        return np.hstack([preview_map[:, :start], constant])
