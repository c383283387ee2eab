"""A rival: for every output an ARX model by plain least squares.

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
from mampc.identification.output_error import least_output_error
from mampc.identification.parts import Part, records_of_part
from mampc.identification.prewhitening import denominator, prewhitened, refined
from mampc.identification.scaling import Scaled

HIGHEST = 8  # order of one output


def estimate_arx(
    records: Scaled, delays: Integers, settings: Settings, trend: str, orders: Sequence[int] | None = None
) -> list[Part]:
    """One part per output, each with the order that explains the record best for its size.

    Args:
        delays: in samples, shape (l, m).
        orders: one per output, if they are known; that of a single output is also the order asked for.
    """
    if orders is None and settings.order is not None and len(delays) == 1:
        orders = (settings.order,)
    parts = []
    first = 0 if settings.feedthrough else 1
    for i, row in enumerate(delays):
        own = records_of_part(records, (i,), row)
        seen = own
        if trend == "differences":
            seen = high_passed(own, 0.0)
        elif trend == "whitened":
            seen = prewhitened(own, first)
        shortest = min(map(len, seen.u))
        most = max(1, min(HIGHEST, (shortest - 10) // (4 * (len(row) + 2))))

        def dynamics(n: int, seen: Scaled) -> tuple[Array, Array]:
            found = denominator(seen.u, seen.y, n, PROJECTED[trend], first)
            if trend == "whitened":
                found = least_output_error(refined(found, seen, first), seen, first)
            return _companion(found)

        tried = range(1, most + 1) if orders is None else (orders[i],)
        parts.append(finished(dynamics, tried, own, seen, (i,), row, settings, trend))
    return parts


def _companion(a: Array) -> tuple[Array, Array]:
    """A and C with the poles of an ARX model."""
    n = len(a)
    A = np.eye(n, k=1)
    A[:, 0] = a
    return A, np.eye(1, n)
