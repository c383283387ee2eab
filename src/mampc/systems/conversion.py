"""Models out of the systems of other libraries."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

from mampc.base.checks import Array, as_number
from mampc.base.errors import MampcError
from mampc.systems.state_space import StateSpace

REDUNDANT = 1e-10  # of a matrix: directions that inputs or past states do not reach
LEADING = 1e-14  # of a polynomial: leading coefficients that are rounding

Polynomial: TypeAlias = Array
Matrices: TypeAlias = tuple[Array, Array, Array, Array]


def model_of(system: Any, dt: float | None) -> StateSpace:
    """A model at the sample time wanted, if any; see `StateSpace.from_any`."""
    dt = None if dt is None else as_number("dt", dt, 0.0)
    if isinstance(system, StateSpace):
        model = system
    else:
        A, B, C, D, own_dt = matrices_of(system)
        stated = dt if own_dt is None else own_dt
        if stated is None:
            raise MampcError("from_any: expected a sample time, received a system that states none; pass dt=")
        model = StateSpace(A, B, C, D, stated)
    if dt is None or np.isclose(model.dt, dt, rtol=1e-9, atol=0.0):
        return model
    if model.is_discrete:
        raise MampcError(
            f"from_any: expected a sample time of {dt:g} s, received a system with {model.dt:g} s"
        )
    return model.discretise(dt)


def matrices_of(system: Any) -> tuple[Any, Any, Any, Any, float | None]:
    """A, B, C, D and the sample time: 0 for continuous, None where the system leaves it open.

    Raises:
        MampcError: an unknown kind of object, or one without a state-space form.
    """
    origin = type(system).__module__.split(".")[0]
    try:
        if origin == "control":
            if hasattr(system, "num") and hasattr(system, "den"):
                return *_realised(system.num, system.den), _stated(system.dt)
            if not hasattr(system, "A"):
                import control

                system = control.ss(system)
            return system.A, system.B, system.C, system.D, _stated(system.dt)
        if origin == "scipy" and hasattr(system, "to_ss"):
            model = system.to_ss()
            return model.A, model.B, model.C, model.D, 0.0 if model.dt is None else _stated(model.dt)
        if isinstance(system, (tuple, list)) and len(system) in (4, 5):
            return *system[:4], _stated(system[4] or 0.0) if len(system) == 5 else 0.0
    except (TypeError, ValueError, NotImplementedError) as error:  # improper, or beyond the library
        raise MampcError(f"from_any: expected a system with a state-space form, received: {error}") from None
    raise MampcError(
        "from_any: expected a python-control or scipy.signal system or (A, B, C, D[, dt]), "
        f"received {type(system).__name__}"
    )


def _stated(dt: Any) -> float | None:
    """A sample time, or None where a library's None or True leaves it open."""
    return None if dt is None or dt is True else float(dt)


def _realised(numerators: Any, denominators: Any) -> Matrices:
    """A realisation of transfer functions, [outputs][inputs] of polynomials with the highest power first.

    Input by input or output by output, whichever takes fewer states. What is redundant, such as an integrator that
    stands in two channels of an output, is left out.
    """
    channels = [
        [_proper(num, den) for num, den in zip(*row, strict=True)]
        for row in zip(numerators, denominators, strict=True)
    ]
    by_input = _by_input(channels)
    A, B, C, D = _by_input([list(column) for column in zip(*channels, strict=True)])
    return by_input if len(by_input[0]) <= len(A) else (A.T, C.T, B.T, D.T)


def _proper(numerator: Any, denominator: Any) -> tuple[Polynomial, Polynomial]:
    """With a leading one in the denominator and as many coefficients in the numerator."""
    num, den = (_stripped(np.atleast_1d(np.asarray(p, dtype=float))) for p in (numerator, denominator))
    if len(num) > len(den):
        raise ValueError(f"an improper transfer function, of order {len(num) - 1} over {len(den) - 1}")
    num = np.concatenate([np.zeros(len(den) - len(num)), num])
    if not num.any():
        return np.zeros(1), np.ones(1)
    return num / den[0], den / den[0]


def _stripped(polynomial: Polynomial) -> Polynomial:
    large = np.abs(polynomial) > LEADING * np.abs(polynomial).max()
    return polynomial[large.argmax() :] if large.any() else np.zeros(1)


def _by_input(channels: list[list[tuple[Polynomial, Polynomial]]]) -> Matrices:
    """The inputs' parts side by side, less what does not show in the outputs."""
    D = np.array([[num[0] for num, _ in row] for row in channels])
    parts = [_of_input(list(column)) for column in zip(*channels, strict=True)]
    # Each part is of a size that outputs and inputs of any unit see alike.
    effect = np.array([np.linalg.norm(C, axis=1) for _, _, C in parts]).T
    rows: Array = np.ones(len(D))
    columns: Array = np.ones(len(parts))
    for _ in range(3):
        columns = _positive((effect / rows[:, None]).max(axis=0))
        rows = _positive((effect / columns).max(axis=1))
    n = sum(len(A) for A, _, _ in parts)
    A: Array = np.zeros((n, n))
    B, C = np.zeros((n, len(parts))), np.zeros((len(D), n))
    at = 0
    for j, (part, drive, seen) in enumerate(parts):
        own = slice(at, at := at + len(part))
        A[own, own], B[own, j], C[:, own] = part, drive[:, 0] * columns[j], seen / columns[j]
    turned = _reached(A.T, C.T, B.T)
    return turned[0].T, turned[2].T, turned[1].T, D


def _positive(sizes: Array) -> Array:
    return np.where(sizes > 0, sizes, 1.0)


def _of_input(channels: list[tuple[Polynomial, Polynomial]]) -> tuple[Array, Array, Array]:
    """A, B, C of one input: a controllable form for each denominator, less what they have in common."""
    found: dict[tuple[float, ...], Array] = {}
    for i, (num, den) in enumerate(channels):
        if len(den) > 1:
            rows = found.setdefault(tuple(den), np.zeros((len(channels), len(den) - 1)))
            rows[i] = num[1:] - num[0] * den[1:]
    n = sum(len(den) - 1 for den in found)
    A, B, C = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((len(channels), n))
    at = 0
    for key, rows in found.items():
        own = slice(at, at := at + len(key) - 1)
        A[own, own] = np.eye(len(key) - 1, k=-1)
        A[own.start, own] = -np.array(key[1:])
        B[own.start], C[:, own] = 1.0, rows
    return _reached(A, B, C)


def _reached(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """The part that inputs reach, by orthogonal steps from B on.

    Source: Rosenbrock, State-Space and Multivariable Theory (1970): the staircase form.
    """
    from scipy.linalg import matrix_balance

    if not len(A):
        return A, B, C
    A, (scale, _) = matrix_balance(A, permute=False, separate=True)
    B, C = B / scale[:, None], C * scale
    step = basis = _range(B / _positive(np.linalg.norm(B, axis=0)), 1.0)
    while step.shape[1] and basis.shape[1] < len(A):
        step = A @ step
        size = float(np.linalg.norm(step))
        for _ in range(2):  # once more, so that rounding leaves it orthogonal
            step = step - basis @ (basis.T @ step)
        step = _range(step, size)
        basis = np.hstack([basis, step])
    if basis.shape[1] == len(A):
        return A, B, C
    return basis.T @ A @ basis, basis.T @ B, C @ basis


def _range(matrix: Array, size: float) -> Array:
    """An orthonormal basis of the range, of what is not rounding beside `size`."""
    left, values, _ = np.linalg.svd(matrix, full_matrices=False)
    return left[:, values > REDUNDANT * max(size, 1e-300)]
