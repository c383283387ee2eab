"""Linear models of nonlinear plants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from mampc.base.checks import Array, as_array, require_finite
from mampc.base.errors import MampcError, shown
from mampc.base.names import Names
from mampc.systems.state_space import StateSpace

KNOWN = 0.01  # share of a slope up to which it is known; beyond, it may be nothing but rounding


class Differentiable(Protocol):
    """What `linearise` needs of a plant: dx/dt = derivative(x, u), y = output(x, u), a rest state."""

    def derivative(self, x: Array, u: Array) -> Array: ...
    def output(self, x: Array, u: Array) -> Array: ...
    def steady_state(self, u: Any = None) -> Array: ...


def linearise(plant: Differentiable, u: Any = None) -> StateSpace:
    """The continuous-time linear model of a plant about its steady state at inputs u.

    Jacobians by central differences, each entry with the step at which its neighbours agree with it best, so that no
    unit decides.

    Args:
        plant: with `derivative`, `output`, `steady_state`; its `names`, `u_op` and `v_op` (measured
            disturbances) are used if it has them.
        u: inputs at the operating point, shape (m,) or (m + d,); default the plant's.
    """
    if not all(hasattr(plant, member) for member in ("derivative", "output", "steady_state")):
        raise MampcError(f"linearise: expected a nonlinear plant, received {shown(plant)}")
    given = getattr(plant, "u_op", None) if u is None else u
    if given is None:
        raise MampcError(f"linearise: expected inputs u, since {type(plant).__name__} has no u_op")
    inputs = np.atleast_1d(as_array("u", given))
    require_finite("u", inputs)
    if inputs.ndim != 1:
        raise MampcError(f"u: expected values of shape (m,), received shape {inputs.shape}")
    names: Names | None = getattr(plant, "names", None)
    m = len(inputs) if names is None else len(names.inputs)
    if names is not None and len(inputs) == m:
        inputs = np.concatenate([inputs, as_array("v_op", getattr(plant, "v_op", ()))])
        names = names if len(inputs) > m else names.undisturbed()
    x_op = as_array("steady_state", plant.steady_state(inputs))
    return StateSpace(
        A=_jacobian(lambda x: plant.derivative(x, inputs), x_op),
        B=_jacobian(lambda v: plant.derivative(x_op, v), inputs),
        C=_jacobian(lambda x: plant.output(x, inputs), x_op),
        D=_jacobian(lambda v: plant.output(x_op, v), inputs),
        dt=0.0,
        u_op=inputs[:m],
        y_op=plant.output(x_op, inputs),
        names=names,  # type: ignore[arg-type]
        v_op=inputs[m:],
    )


def _jacobian(function: Callable[[Array], Array], point: Array) -> Array:
    """The derivatives of a function (k,) by a point (n,), shape (k, n).

    Differences with large steps bend, and those with small ones drown in rounding. Which steps are large depends on
    units, and on how far from zero a variable is; so steps of all sizes are tried, each entry by itself.
    """
    noise = _rounding(function, point)
    columns = []
    for i, value in enumerate(point):
        far = abs(value)
        largest, smallest = 0.1 * max(1.0, far), 1e-6 * min(1.0, far or 1e-6)
        steps = np.geomspace(largest, smallest, 1 + round(np.log10(largest / smallest)))
        slopes = np.array([_slope(function, point, i, step) for step in steps])
        apart = np.abs(np.diff(slopes, axis=0))
        error = np.maximum(apart[:-1], apart[1:]) + noise / steps[1:-1, None]
        size = np.abs(slopes[1:-1])
        share = np.divide(error, size, out=np.full_like(error, np.inf), where=size > 0)
        for doubt in (error, share):
            doubt[~np.isfinite(error)] = np.inf
        known = share.min(axis=0) < KNOWN
        best = 1 + np.where(known, share.argmin(axis=0), error.argmin(axis=0))
        columns.append(slopes[best, np.arange(len(noise))])
    return np.stack(columns, axis=-1)


def _slope(function: Callable[[Array], Array], point: Array, i: int, step: float) -> Array:
    """A central difference by variable i, shape (k,); not-a-number where a step leads out of the function's range."""
    above, below = point.copy(), point.copy()
    above[i] += step
    below[i] -= step
    with np.errstate(all="ignore"):
        try:
            rise: Array = np.asarray(function(above), dtype=float) - np.asarray(function(below), dtype=float)
        except Exception:  # whatever a plant says of states that it does not have
            return np.full(np.shape(function(point)), np.nan)
        slope: Array = rise / (above[i] - below[i])
    return slope


def _rounding(function: Callable[[Array], Array], point: Array) -> Array:
    """What a change of the last digits of a point makes of a function's values, shape (k,)."""
    values = np.asarray(function(point), dtype=float)
    noise: Array = np.finfo(float).eps * np.abs(values)
    for i in range(len(point)):
        near = point.copy()
        near[i] *= 1 + 4 * np.finfo(float).eps
        noise += np.abs(np.asarray(function(near), dtype=float) - values)
    return noise
