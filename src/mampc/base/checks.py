"""Turning what a user passes into checked float arrays, with one wording for every complaint."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from mampc.base.errors import MampcError, shown

Array: TypeAlias = npt.NDArray[np.floating[Any]]  # float64 throughout
BoolArray: TypeAlias = npt.NDArray[np.bool_]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]

FLOAT = np.dtype(np.float64)
LARGEST = 1e12  # in engineering units; beyond it a number is a fault, and double precision has little left
T = TypeVar("T")


def is_usable(vector: Array) -> bool:
    """Whether all entries of a vector are numbers below `LARGEST` in size; never warns."""
    return not vector.size or bool(vector[vector.argmin()] > -LARGEST and vector[vector.argmax()] < LARGEST)


def as_read(name: str, value: Any) -> Array:
    """Numbers as they come in the loop, finite or not and without a copy where possible.

    Masked entries and None are not-a-number; what is no number at all raises `MampcError`.
    """
    try:
        if isinstance(value, np.ma.MaskedArray):
            value = np.ma.filled(value.astype(np.float64), np.nan)
        array: Array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise MampcError(f"{name}: expected numbers, received {shown(value)}") from None
    return array


def as_shaped(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    """Numbers of exactly this shape, as `as_read` takes them; `MampcError` otherwise."""
    if type(value) is np.ndarray and value.dtype == FLOAT and value.shape == shape:  # as nearly always
        return value
    array = as_read(name, value)
    if array.shape != shape:
        raise MampcError(f"{name}: expected shape {shape}, received {array.shape}")
    return array


def as_array(name: str, value: Any) -> Array:
    """A new, contiguous float64 array; raises `MampcError` for text, ragged lists, complex numbers or flags."""
    try:
        array = np.array(value)
        if array.dtype.kind not in "iuf":
            raise TypeError
        return np.ascontiguousarray(array, dtype=np.float64).reshape(array.shape)
    except (TypeError, ValueError):
        raise MampcError(f"{name}: expected real numbers, received {shown(value)}") from None


def as_matrix(name: str, value: Any, rows: int | None = None, columns: int | None = None) -> Array:
    """A finite matrix of shape (rows, columns), None meaning any; raises `MampcError` otherwise."""
    array = as_array(name, value)
    fits = (
        array.ndim == 2
        and (rows is None or array.shape[0] == rows)
        and (columns is None or array.shape[1] == columns)
    )
    if not fits:
        expected = f"({'any' if rows is None else rows}, {'any' if columns is None else columns})"
        raise MampcError(f"{name}: expected a matrix of shape {expected}, received shape {array.shape}")
    return require_finite(name, array)


def as_vector(
    name: str, value: Any, size: int, minimum: float = -np.inf, *, exclusive: bool = False
) -> Array:
    """A finite vector of `size` entries of at least `minimum` (above it when `exclusive`), a scalar meaning that
    value in each; raises `MampcError`.
    """
    array = as_array(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,):
        raise MampcError(f"{name}: expected a scalar or {size} values, received shape {array.shape}")
    least = require_finite(name, array).min(initial=np.inf)
    if least < minimum or (exclusive and least == minimum):
        raise MampcError(f"{name}: expected numbers{_bound(minimum, exclusive)}, received {shown(value)}")
    return array


def as_one_or_each(name: str, value: Any, minimum: float) -> float | tuple[float, ...]:
    """A finite number of at least `minimum`, or a tuple of them, one per signal; raises `MampcError`."""
    array = as_array(name, value)
    vector = as_vector(name, array, array.size, minimum)
    return tuple(vector.tolist()) if array.ndim else float(array)


def as_limit(name: str, value: Any, size: int, unlimited: float) -> Array:
    """A limit per signal: None or infinite means `unlimited`; not-a-number raises `MampcError`."""
    if value is None:
        return np.full(size, unlimited)
    array = as_array(name, value)
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.shape != (size,):
        raise MampcError(f"{name}: expected None, a scalar or {size} values, received shape {array.shape}")
    if np.isnan(array).any() or (array == -unlimited).any():
        raise MampcError(f"{name}: expected numbers or {unlimited}, received {shown(value)}")
    return array


def as_weight(name: str, value: Any, size: int) -> Array:
    """A symmetric positive semidefinite (size, size) matrix from a scalar, a diagonal or a matrix."""
    array = require_finite(name, as_array(name, value))
    if array.ndim == 0:
        array = np.full(size, float(array))
    if array.ndim == 1 and array.shape == (size,):
        array = np.diag(array)
    if array.shape != (size, size):
        raise MampcError(
            f"{name}: expected a scalar, {size} values or a {size} x {size} matrix, "
            f"received shape {array.shape}"
        )
    if not np.allclose(array, array.T, rtol=1e-10, atol=0.0):
        raise MampcError(f"{name}: expected a symmetric matrix, received {shown(value)}")
    array = (array + array.T) / 2
    eigenvalues = np.linalg.eigvalsh(array)
    if eigenvalues[0] < -1e-12 * max(1.0, eigenvalues[-1]):
        raise MampcError(
            f"{name}: expected no negative weight, received smallest eigenvalue {eigenvalues[0]:.3g}"
        )
    return array


def as_whole(name: str, value: Any, minimum: int, maximum: int | None = None) -> int:
    """A whole number within minimum..maximum; raises `MampcError` otherwise (True is not 1 here)."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or value < minimum or (maximum is not None and value > maximum):
        upto = "" if maximum is None else f" and at most {maximum}"
        raise MampcError(
            f"{name}: expected a whole number of at least {minimum}{upto}, received {shown(value)}"
        )
    return int(value)


def as_choice(name: str, value: Any, choices: Collection[str]) -> str:
    """One of some words; raises `MampcError` for anything else."""
    if not isinstance(value, str) or value not in choices:
        raise MampcError(f"{name}: expected one of {', '.join(choices)}, received {shown(value)}")
    return value


def as_instance(name: str, value: Any, kind: type[T]) -> T:
    """A value of one of our classes; raises `MampcError` for anything else."""
    if not isinstance(value, kind):
        raise MampcError(f"{name}: expected a mampc.{kind.__name__}, received {type(value).__name__}")
    return value


def as_jobs(jobs: int) -> int:
    """A number of processes, -1 for one a core; raises `MampcError`."""
    if as_whole("--jobs", jobs, -1) == 0:
        raise MampcError(f"--jobs: expected -1 for one a core, or a number of processes, received {jobs}")
    return jobs


def as_flag(name: str, value: Any) -> bool:
    """True or false; raises `MampcError` for anything else, such as the text "no"."""
    if not isinstance(value, bool):
        raise MampcError(f"{name}: expected true or false, received {shown(value)}")
    return value


def as_number(name: str, value: Any, minimum: float = -np.inf, *, exclusive: bool = False) -> float:
    """A finite number of at least `minimum` (above it when `exclusive`); raises `MampcError`."""
    number = np.nan
    if isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool):
        with suppress(OverflowError):  # a whole number may be larger than any float
            number = float(value)
    if not np.isfinite(number) or number < minimum or (exclusive and number == minimum):
        raise MampcError(
            f"{name}: expected a finite number{_bound(minimum, exclusive)}, received {shown(value)}"
        )
    return number


def _bound(minimum: float, exclusive: bool) -> str:
    return "" if minimum == -np.inf else f" {'above' if exclusive else 'of at least'} {minimum:g}"


def require_finite(name: str, array: Array) -> Array:
    """The array itself, or `MampcError` naming the first entry that is not finite."""
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise MampcError(f"{name}: expected finite numbers, received {array[place]} at {list(place)}")
    return array
