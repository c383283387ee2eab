"""The rival: for every output an ARX model by plain least squares.

Only its poles are kept; inputs, constants and integrators are then found as for any other model.

Source: Ljung, System Identification (1999), section 10.1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mampc.base.checks import Array
from mampc.identification.delays import Integers
from mampc.identification.drift import high_passed
from mampc.identification.estimate import PROJECTED, Settings, finished
from mampc.identification.parts import Part, records_of_part
from mampc.identification.scaling import Scaled
from mampc.identification.triangular import fold, solve

HIGHEST = 8  # order of one output


def estimate_arx(
    records: Scaled, delays: Integers, settings: Settings, trend: str, orders: Sequence[int] | None = None
) -> list[Part]:
    """One part per output, each with the smallest order that explains the record nearly best.

    Args:
        delays: in samples, shape (l, m).
        orders: one per output, if they are known.
    """
    parts = []
    for i, row in enumerate(delays):
        own = records_of_part(records, (i,), row)
        seen = high_passed(own, 0.0) if trend == "differences" else own
        shortest = min(map(len, seen.u))
        most = max(1, min(HIGHEST, (shortest - 10) // (4 * (len(row) + 2))))

        def dynamics(n: int, seen: Scaled = seen) -> tuple[Array, Array]:
            return _companion(_denominator(seen.u, seen.y, n, PROJECTED[trend]))

        tried = range(1, most + 1) if orders is None else (orders[i],)
        parts.append(finished(dynamics, tried, own, seen, (i,), row, settings, trend))
    return parts


def _denominator(u: Sequence[Array], y: Sequence[Array], n: int, degree: int) -> Array:
    """a_1 .. a_n of y[k] = sum a_i y[k - i] + sum b_ij u_j[k - i] + trend."""
    R: Array = np.empty((0, 0))
    for inputs, output in zip(u, y, strict=True):
        N = len(output) - n
        time = np.arange(N) / N - 0.5
        columns: list[Array] = [time[:, None] ** np.arange(degree + 1)]
        columns += [inputs[n - i : n - i + N] for i in range(n + 1)]
        columns += [output[n - i : n - i + N] for i in range(1, n + 1)]
        rows = np.concatenate([*columns, output[n:]], axis=1)
        own = degree + 1
        R = fold(R if R.size else np.empty((0, rows.shape[1] - own)), _reduced(rows, own))
    return solve(R)[-n:]


def _reduced(rows: Array, own: int) -> Array:
    """Rows without their first columns, which are projected off."""
    return fold(np.empty((0, rows.shape[1])), rows)[own:, own:]


def _companion(a: Array) -> tuple[Array, Array]:
    """A and C with the poles of an ARX model."""
    n = len(a)
    A = np.eye(n, k=1)
    A[:, 0] = a
    return A, np.eye(1, n)
