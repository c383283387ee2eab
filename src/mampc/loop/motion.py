"""How plants answer and move between samples, one loop or many at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.plants import Plant, advance, state_sizes
from mampc.systems.state_space import StateSpace

Faults = tuple[str, ...]


class Motion(NamedTuple):
    """What a loop needs of its plant: x (n,) is its state, u (m + d,) its inputs with measured disturbances behind."""

    output: Callable[[Array, Array], Array]
    move: Callable[[Array, Array], Array]
    faults: Callable[[Array, Array], Faults]


class Motions(NamedTuple):
    """The same of many loops: x (S, n), u (S, m + d); faults by loop."""

    output: Callable[[Array, Array], Array]
    move: Callable[[Array, Array], Array]
    faults: Callable[[Array, Array], dict[int, Faults]]


def motion_of(plant: Plant | StateSpace, dt: float) -> Motion:
    """The motion of one plant, sampled every dt seconds.

    Raises:
        MampcError: a discrete plant with another sample time.
    """
    if not isinstance(plant, StateSpace):
        faults, sizes = getattr(plant, "faults", lambda x, u: ()), state_sizes(plant)
        return Motion(plant.output, lambda x, u: advance(plant, x, u, dt, sizes=sizes), faults)
    _require_sampled(plant, dt)
    A, B, C, D, op, y_op = plant.A, plant.B, plant.C, plant.D, plant.all_inputs_op, plant.y_op
    return Motion(
        lambda x, u: y_op + C @ x + D @ (u - op), lambda x, u: A @ x + B @ (u - op), lambda x, u: ()
    )


def motions_of(plants: Sequence[Plant | StateSpace], dt: float, x: Array, u: Array) -> Motions:
    """The motion of many loops, one plant each (which may be the same), of which x and u are examples.

    Models move by matrix products, and one nonlinear plant as a batch if its methods give the same for a batch as
    one by one; everything else goes loop by loop.
    """
    first = plants[0]
    alike = all(plant is first for plant in plants)
    if alike and isinstance(first, StateSpace):
        _require_sampled(first, dt)
        A, B, C, D = (matrix.T for matrix in (first.A, first.B, first.C, first.D))
        op, y_op = first.all_inputs_op, first.y_op
        return Motions(
            lambda x, u: y_op + x @ C + (u - op) @ D, lambda x, u: x @ A + (u - op) @ B, lambda x, u: {}
        )
    if alike and not isinstance(first, StateSpace) and _takes_batches(first, x[0], u[0]):
        sizes = state_sizes(first)
        return Motions(
            first.output,
            lambda x, u: advance(first, x, u, dt, sizes=sizes),
            lambda x, u: _batch_faults(first, x, u),
        )
    if all(isinstance(plant, StateSpace) for plant in plants):
        return _stacked([plant for plant in plants if isinstance(plant, StateSpace)], dt)
    each = [motion_of(plant, dt) for plant in plants]

    def faults(x: Array, u: Array) -> dict[int, Faults]:
        found = {s: each[s].faults(x[s], u[s]) for s in range(len(x))}
        return {s: wrong for s, wrong in found.items() if wrong}

    return Motions(
        lambda x, u: np.array([motion.output(*of) for motion, *of in zip(each, x, u, strict=True)]),
        lambda x, u: np.array([motion.move(*of) for motion, *of in zip(each, x, u, strict=True)]),
        faults,
    )


def _stacked(plants: list[StateSpace], dt: float) -> Motions:
    """Models with different numbers; their states are filled up to the same number with zeros."""
    n = max(plant.n_states for plant in plants)
    for plant in plants:
        _require_sampled(plant, dt)

    def stack(name: str, rows: bool, columns: bool) -> Array:
        matrices = [getattr(plant, name) for plant in plants]
        more = [n - plant.n_states for plant in plants]
        return np.array(
            [np.pad(M, ((0, k * rows), (0, k * columns))) for M, k in zip(matrices, more, strict=True)]
        )

    A, B, C, D = (
        stack("A", True, True),
        stack("B", True, False),
        stack("C", False, True),
        stack("D", False, False),
    )
    op = np.array([plant.all_inputs_op for plant in plants])
    y_op = np.array([plant.y_op for plant in plants])

    def product(M: Array, v: Array) -> Array:
        result: Array = (M @ v[..., None])[..., 0]
        return result

    return Motions(
        lambda x, u: y_op + product(C, x) + product(D, u - op),
        lambda x, u: product(A, x) + product(B, u - op),
        lambda x, u: {},
    )


def _require_sampled(plant: StateSpace, dt: float) -> None:
    if not np.isclose(plant.dt, dt, rtol=1e-6):
        raise MampcError(f"simulate: expected a plant sampled every {dt:g} s, received {plant.dt:g} s")


def _takes_batches(plant: Plant, x: Array, u: Array) -> bool:
    """Whether rates and outputs of a batch are those of its rows, about a state (n,) and inputs (m + d,)."""
    rng, rows = np.random.default_rng(0), len(x) + len(u) + len(plant.names.outputs)
    spread = 1e-3 * rng.standard_normal((rows, len(x)))
    states, inputs = x + spread * np.maximum(np.abs(x), 1e-3), np.tile(u, (rows, 1))
    inputs = inputs + 1e-3 * np.abs(inputs) * rng.standard_normal(inputs.shape)
    try:
        with np.errstate(all="ignore"):
            for method in (plant.derivative, plant.output):
                together = np.asarray(method(states, inputs))
                apart = np.array([method(*row) for row in zip(states, inputs, strict=True)])
                scale = np.abs(apart).max(axis=0)
                if together.shape != apart.shape or not np.allclose(
                    together, apart, rtol=1e-9, atol=1e-9 * scale
                ):
                    return False
    except Exception:  # whatever a method does with what it was not made for, it takes no batches
        return False
    return True


def _batch_faults(plant: Plant, x: Array, u: Array) -> dict[int, Faults]:
    """What is wrong with each loop; asked of all of them at once first."""
    check = getattr(plant, "faults", None)
    if check is None:
        return {}
    try:
        if not check(x, u):
            return {}
    except Exception:  # made for one state only
        pass
    found = {s: check(x[s], u[s]) for s in range(len(x))}
    return {s: wrong for s, wrong in found.items() if wrong}
