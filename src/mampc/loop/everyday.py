"""What a load bank needs to know at a sample at which nothing is missing, as one matrix product."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.loop.hypotheses import Loads, Member
from mampc.loop.kalman_filter import KalmanFilter


class Everyday(NamedTuple):
    """Linear maps of a sample.

    Attributes:
        of_mixed: from a mixed z, transposed, the same for all hypotheses: to z predicted, innovation and movement
            of the outputs.
        of_known: from all else, (u, v_last, v, y, 1, late, plain): to the same, and below these to the next `late`
            and `plain`, and to what the plain filter missed of the outputs, in standard deviations of their noise.
        parts: the rows of each of these four.
    """

    of_mixed: Array
    of_known: Array
    parts: list[slice]


def everyday(loads: Loads, member: Member, of_late: Array, plain: KalmanFilter) -> Everyday:
    """The maps of a bank with these loads, of which `member` is one hypothesis.

    Args:
        of_late: from (late, u) to the next `late`.
    """
    model, k = plain.model, loads.count
    n, m, l, d = model.n_states, model.n_inputs, model.n_outputs, model.n_disturbances
    sizes = (m, d, d, l, 1, len(of_late), n + l + m)
    u, v_last, v, y, one, late, filtered = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
    op = np.outer(model.all_inputs_op, one)
    drive = model.B @ (np.vstack([u, v_last]) - op)
    surplus = y - np.outer(model.y_op, one) - model.D @ (np.vstack([u, v]) - op)
    A, C = member.A.copy(), member.C
    A[n : n + k, n + k :] = A[n + k :, n + k :] = np.eye(k)
    of_z = np.vstack([A, -C @ A, model.C @ (A[:n] - np.eye(n, len(A)))])
    driven = np.vstack([drive, np.zeros((2 * k, drive.shape[1]))])
    next_filtered, innovation = np.split(
        plain.map[: n + l + m + l] @ np.vstack([filtered, u, v_last, v, y, one]), [n + l + m]
    )
    nexts = [
        np.vstack([driven, surplus - C @ driven, model.C @ drive]),
        of_late @ np.vstack([late, u]),
        next_filtered,
        innovation / loads.noise[:, None],
    ]
    ends = [0, *np.cumsum([len(part) for part in nexts]).tolist()]
    return Everyday(np.ascontiguousarray(of_z.T), np.vstack(nexts), [slice(*pair) for pair in pairwise(ends)])
