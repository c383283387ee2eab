"""A model in parts: outputs that share dead times, each part a system of its own behind them.

A part is identified from inputs set back by its dead times, and the model puts the parts side by side behind
shift registers, one per input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.identification.data import IOData
from mampc.identification.delays import Integers
from mampc.identification.scaling import Scaled
from mampc.identification.simulation_error import InputFit, residuals
from mampc.systems.state_space import StateSpace

UNLIKE = 3  # samples by which dead times of one part may differ; states make up for them


class Part(NamedTuple):
    """Some outputs, and what is known of them in units of the records' spread.

    Attributes:
        outputs: their indices.
        delays: in samples, one per input, shape (m,).
        A, C: of which the first states, `integrators` many, integrate and nothing else.
        stabilised: True if poles were moved inside the unit circle.
        fit: the rest of the model and the trends of the records.
    """

    outputs: tuple[int, ...]
    delays: Integers
    A: Array
    C: Array
    integrators: int
    stabilised: bool
    fit: InputFit


def groups(delays: Integers) -> list[tuple[tuple[int, ...], Integers]]:
    """Outputs that share dead times, and these; from delays of shape (l, m)."""
    found: list[tuple[list[int], Integers]] = []
    for i, row in enumerate(delays):
        for k, (members, least) in enumerate(found):
            most = delays[[*members, i]].max(axis=0)
            least = np.minimum(least, row)
            if (most - least <= UNLIKE).all():
                found[k] = ([*members, i], least)
                break
        else:
            found.append(([i], row.copy()))
    return [(tuple(members), least) for members, least in found]


def records_of_part(records: Scaled, outputs: Sequence[int], delays: Integers) -> Scaled:
    """The records as a part sees them: inputs set back, samples without a past left out."""
    longest, picked = int(delays.max(initial=0)), list(outputs)
    if not longest and picked == list(range(len(records.y_spread))):
        return records
    u, y = [], []
    for inputs, measured in zip(records.u, records.y, strict=True):
        N = len(inputs)
        if longest < N:
            shifted = [inputs[longest - d : N - d, j] for j, d in enumerate(delays)]
            u.append(np.column_stack(shifted))
            y.append(measured[longest:, picked])
    mean = tuple(
        m[picked] for m, inputs in zip(records.y_mean, records.u, strict=True) if len(inputs) > longest
    )
    return Scaled(tuple(u), tuple(y), records.u_mean, mean, records.u_spread, records.y_spread[picked])


def part_residuals(part: Part, records: Scaled) -> list[Array]:
    """What a part leaves of its outputs, in units of their spread, one array per record."""
    return residuals(part.A, part.C, part.fit, records_of_part(records, part.outputs, part.delays))


def assembled(parts: Sequence[Part], records: Scaled, like: IOData) -> StateSpace:
    """The model in engineering units, about the rest that the records' trends tell.

    Its first states are the integrators. Where these drift under the mean inputs, the inputs of the operating
    point are the nearest ones, in units of their spread, under which they rest.
    """
    l, manipulated = len(records.y_spread), len(like.names.inputs)
    share = np.array([len(u) for u in records.u]) / records.samples
    drives = np.concatenate([_mean(share, [trend.drive for trend in part.fit.trends]) for part in parts])
    rows = np.vstack([part.fit.B[: part.integrators, :manipulated] for part in parts])
    du = np.linalg.lstsq(rows, -drives)[0] if len(drives) else np.zeros(manipulated)
    y_op = np.empty(l)
    for part in parts:
        q, picked, B, D = part.integrators, list(part.outputs), part.fit.B[:, :manipulated], part.fit.D
        rest = np.linalg.solve(np.eye(len(part.A) - q) - part.A[q:, q:], B[q:] @ du)
        offset = _mean(share, [trend.polynomial[:1].sum(axis=0) for trend in part.fit.trends])
        offset = offset + part.C[:, q:] @ rest + D[:, :manipulated] @ du
        y_op[picked] = (
            _mean(share, [mean[picked] for mean in records.y_mean]) + records.y_spread[picked] * offset
        )
    u_op = records.u_mean.copy()
    u_op[:manipulated] += du * records.u_spread[:manipulated]
    A, B, C, D = _side_by_side(parts, l, len(u_op))
    spread = records.y_spread[:, None]
    return StateSpace(
        A, B / records.u_spread, spread * C, spread * D / records.u_spread, like.dt, u_op[:manipulated], y_op,
        like.names, v_op=u_op[manipulated:],
    )  # fmt: skip


def _mean(share: Array, values: Sequence[Array]) -> Array:
    """The mean over records by their length; records too short for a part have no say."""
    weights = share[: len(values)] if len(values) == len(share) else np.full(len(values), 1.0)
    mean: Array = np.tensordot(weights / weights.sum(), np.array(values), axes=1)
    return mean


def _side_by_side(parts: Sequence[Part], l: int, m: int) -> tuple[Array, Array, Array, Array]:
    """A, B, C, D of all parts behind one shift register per input."""
    longest = np.max([part.delays for part in parts], axis=0).astype(int)
    sizes = [len(part.A) for part in parts]
    n, taps = sum(sizes), np.concatenate([[0], np.cumsum(longest)])
    A, B = np.zeros((n + taps[-1], n + taps[-1])), np.zeros((n + taps[-1], m))
    C, D = np.zeros((l, n + taps[-1])), np.zeros((l, m))
    for j, length in enumerate(longest):
        first = n + taps[j]
        if length:  # state first + d - 1 is the input d samples ago
            B[first, j] = 1.0
            A[range(first + 1, first + length), range(first, first + length - 1)] = 1.0
    at = 0
    for part, size in zip(parts, sizes, strict=True):
        own, picked = np.s_[at : at + size], list(part.outputs)
        A[own, own], C[picked, own] = part.A, part.C
        for j, d in enumerate(part.delays):
            if d:
                A[own, n + taps[j] + d - 1] = part.fit.B[:, j]
                C[picked, n + taps[j] + d - 1] = part.fit.D[:, j]
            else:
                B[own, j], D[picked, j] = part.fit.B[:, j], part.fit.D[:, j]
        at += size
    starts = np.concatenate([[0], np.cumsum(sizes)])[:-1]
    first_states = [
        int(start) + k for start, part in zip(starts, parts, strict=True) for k in range(part.integrators)
    ]
    order = [*first_states, *(k for k in range(len(A)) if k not in set(first_states))]
    return A[np.ix_(order, order)], B[order], C[:, order], D
