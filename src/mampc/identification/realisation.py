"""From the range of the observability matrix to A and C."""

from __future__ import annotations

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError


def realise(gamma: Array, l: int) -> tuple[Array, Array]:
    """A and C of order n by shift invariance of `gamma`, shape (s l, n)."""
    return np.linalg.lstsq(gamma[:-l], gamma[l:])[0], gamma[:l]


def inside_unit_circle(A: Array, unstable: str, integrators: int = 0) -> tuple[Array, bool]:
    """A itself, or with each pole outside the unit circle mirrored to 1 / conj(pole).

    The first states of A, as many as `integrators`, stand for themselves and are left alone.
    """
    if integrators:
        q, fixed = integrators, A.copy()
        fixed[q:, q:], stabilised = inside_unit_circle(A[q:, q:], unstable)
        return fixed, stabilised
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
