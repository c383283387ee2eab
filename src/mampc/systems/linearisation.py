"""Linear models of nonlinear plants."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from mampc.base.checks import Array, as_array
from mampc.base.errors import MampcError
from mampc.base.names import Names
from mampc.systems.state_space import StateSpace


class Differentiable(Protocol):
    """What `linearise` needs of a plant: dx/dt = derivative(x, u), y = output(x, u), a rest state."""

    def derivative(self, x: Array, u: Array) -> Array: ...
    def output(self, x: Array, u: Array) -> Array: ...
    def steady_state(self, u: Any = None) -> Array: ...


def linearise(plant: Differentiable, u: Any = None) -> StateSpace:
    """The continuous-time linear model of a plant about its steady state at inputs u.

    Jacobians by central differences with steps of 1e-6 of each variable's size.

    Args:
        plant: with `derivative`, `output`, `steady_state`; its `names`, `u_op` and `v_op` (measured
            disturbances) are used if it has them.
        u: inputs at the operating point, shape (m,) or (m + d,); default the plant's.
    """
    given = getattr(plant, "u_op", None) if u is None else u
    if given is None:
        raise MampcError(f"linearise: expected inputs u, since {type(plant).__name__} has no u_op")
    inputs = as_array("u", given)
    names: Names | None = getattr(plant, "names", None)
    m = len(inputs) if names is None else len(names.inputs)
    if names is not None and len(inputs) == m:
        inputs = np.concatenate([inputs, as_array("v_op", getattr(plant, "v_op", ()))])
        names = names if len(inputs) > m else names.undisturbed()
    x_op = as_array("steady_state", plant.steady_state(inputs))

    def jacobian(function: Any, point: Array) -> Array:
        columns = []
        for i, value in enumerate(point):
            step = np.zeros_like(point)
            step[i] = 1e-6 * max(1.0, abs(value))
            columns.append((function(point + step) - function(point - step)) / (2 * step[i]))
        return np.stack(columns, axis=-1)

    return StateSpace(
        A=jacobian(lambda x: plant.derivative(x, inputs), x_op),
        B=jacobian(lambda v: plant.derivative(x_op, v), inputs),
        C=jacobian(lambda x: plant.output(x, inputs), x_op),
        D=jacobian(lambda v: plant.output(x_op, v), inputs),
        dt=0.0,
        u_op=inputs[:m],
        y_op=plant.output(x_op, inputs),
        names=names,  # type: ignore[arg-type]
        v_op=inputs[m:],
    )
