"""From the range of the observability matrix to A, B, C, D."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.triangular import fold, solve

_CHUNK = 4096  # samples taken into the triangular factor at once


class Realisation(NamedTuple):
    """A, B, C, D, the root of the sum of squared simulation errors, and whether poles were moved."""

    A: Array
    B: Array
    C: Array
    D: Array
    error: float
    stabilised: bool


def realise(gamma: Array, u: Array, y: Array, *, feedthrough: bool, unstable: str) -> Realisation:
    """The model of order n whose observability matrix has the range of `gamma`, shape (s l, n).

    A and C by shift invariance; B and D by least squares on the simulation error, each output measured
    by its standard deviation.

    Args:
        gamma: see above.
        u, y: the record without its means, shapes (N, m) and (N, l).
        feedthrough: False fixes D = 0.
        unstable: "stabilise" or "refuse", see `n4sid`.

    Raises:
        MampcError: poles outside the unit circle and unstable="refuse".
    """
    spread = y.std(axis=0)
    l = y.shape[1]
    C = gamma[:l]
    A, stabilised = _inside_unit_circle(np.linalg.lstsq(gamma[:-l], gamma[l:])[0], unstable)
    B, D, error = _input_matrices(A, C / spread[:, None], u, y / spread, feedthrough)
    return Realisation(A, B, C, spread[:, None] * D, error, stabilised)


def _inside_unit_circle(A: Array, unstable: str) -> tuple[Array, bool]:
    """A itself, or with each pole outside the unit circle mirrored to 1 / conj(pole)."""
    poles, vectors = np.linalg.eig(A)
    outside = np.abs(poles) >= 1.0
    if not outside.any():
        return A, False
    if unstable == "refuse":
        raise MampcError(
            f"n4sid: expected a stable model, received poles of size {np.sort(np.abs(poles[outside]))}; "
            "remove drifts from the record, try another order, or allow unstable='stabilise'"
        )
    mirrored = np.where(outside, poles / np.maximum(np.abs(poles), 1.0 + 1e-6) ** 2, poles)
    stable: Array = np.real(vectors @ np.diag(mirrored) @ np.linalg.inv(vectors))
    return stable, True


def _input_matrices(A: Array, C: Array, u: Array, y: Array, feedthrough: bool) -> tuple[Array, Array, float]:
    """B and D by least squares on the simulation error, to which x0 contributes, and that error.

    Column (i, j) of the response to B is the output of (A, e_i, C) driven by input j. The means of a
    record with a transient are not quite a rest of the system. In a record so clean that the constant
    they leave is most of the error, it is fitted too; elsewhere it would compete with slow modes.
    """
    n, m, l = len(A), u.shape[1], len(C)
    direct = l * m if feedthrough else 0
    unknowns = n * m + n + direct
    state = np.zeros((n, n * m + n))
    state[:, n * m :] = np.eye(n)
    picks = np.eye(n)
    factor: Array = np.empty((0, unknowns + l + 1))
    for start in range(0, len(u), _CHUNK):
        block = u[start : start + _CHUNK]
        states = np.empty((len(block), n, n * m + n))
        for k, inputs in enumerate(block):
            states[k] = state
            state = A @ state
            state[:, : n * m] += np.kron(picks, inputs)
        rows = np.zeros((len(block), l, unknowns + l + 1))
        rows[:, :, : n * m + n] = C @ states
        if feedthrough:
            through = np.einsum("op,kj->kopj", np.eye(l), block)
            rows[:, :, n * m + n : unknowns] = through.reshape(len(block), l, direct)
        rows[:, :, unknowns:-1] = np.eye(l)
        rows[:, :, -1] = y[start : start + _CHUNK]
        factor = fold(factor, rows.reshape(-1, unknowns + l + 1))
    without_constant = np.delete(factor, np.s_[unknowns:-1], axis=1)
    solution, error = _fitted(without_constant)
    solution_with, error_with = _fitted(factor)
    if error_with < error / 2:
        solution, error = solution_with, error_with
    B = solution[: n * m].reshape(n, m)
    D = solution[n * m + n : unknowns].reshape(l, m) if feedthrough else np.zeros((l, m))
    return B, D, error


def _fitted(factor: Array) -> tuple[Array, float]:
    """Least-squares solution and the norm of what it leaves."""
    solution = solve(factor)
    return solution, float(np.linalg.norm(factor[:, -1] - factor[:, :-1] @ solution))
