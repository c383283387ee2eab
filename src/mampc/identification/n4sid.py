"""Subspace identification (N4SID) of a state-space model from input-output records."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mampc.base.checks import Array, as_whole
from mampc.base.errors import MampcError
from mampc.identification.data import IOData
from mampc.identification.integrators import explains_as_well, near_one, with_integrators
from mampc.identification.realisation import inside_unit_circle, realise
from mampc.identification.scaling import Scaled, scaled
from mampc.identification.simulation_error import InputFit, fit_inputs, independent_samples, residuals
from mampc.identification.subspace import (
    WEIGHTINGS,
    correlations,
    hankel_factor,
    observability,
    require_excitation,
    supported_order,
)
from mampc.identification.validation import Validation, validate
from mampc.systems.state_space import StateSpace

NEAR_BEST = 1.02  # simulation errors that are as good as equal
SIGNIFICANT = 4.0  # a square of two standard deviations


@dataclass(frozen=True, eq=False)
class Identified:
    """An identified model and how well it explains the record it came from.

    Attributes:
        model: discrete `StateSpace`; its operating point is where the model rests at the mean inputs.
        x0: state at the first sample of the first record, shape (n,).
        singular_values: of the weighted projection, shape (s * l,); canonical correlations for "cva",
            else in the outputs' units.
        order: n.
        integrators: how many poles are exactly one.
        fit: percent per output, shape (l,), of the simulated model on the (first) record itself.
        stabilised: True if poles were moved inside the unit circle.
    """

    model: StateSpace
    x0: Array
    singular_values: Array
    order: int
    integrators: int
    fit: Array
    stabilised: bool

    def validate(self, data: IOData) -> Validation:
        """Simulate the model on another record; see `mampc.validate`."""
        return validate(self.model, data)


def n4sid(
    data: IOData | Sequence[IOData],
    *,
    order: int | None = None,
    weighting: str = "cva",
    block_rows: int | None = None,
    feedthrough: bool = True,
    unstable: str = "stabilise",
) -> Identified:
    """Identify a state-space model from one record or several of the same plant.

    Every signal counts in units of its own spread. Slow poles that the record cannot tell from one are made
    exactly one (see `integrators`), and the operating point is one at which the model rests.

    Args:
        data: a record, or several of the same plant, each with an initial state and constants of its own.
        order: n; by default the singular values say how many orders the record supports, and the
            smallest of these is taken whose simulation error is within 2 % of the best.
        weighting: "cva" (canonical variates: whitens the future outputs, best with noise), "n4sid" or
            "moesp" (unweighted; the same range in the projected form used here, which is SLICOT's).
        block_rows: s, how many samples past and future hold; default 15, less for short records, more
            for a high order.
        feedthrough: False fixes D = 0, as for sampled physical plants.
        unstable: "stabilise" mirrors poles outside the unit circle to its inside, "refuse" raises.

    Raises:
        MampcError: a record too short, constant signals, or an unstable model with unstable="refuse".
    """
    if weighting not in WEIGHTINGS:
        raise MampcError(f"weighting: expected one of {WEIGHTINGS}, received {weighting!r}")
    if unstable not in ("stabilise", "refuse"):
        raise MampcError(f"unstable: expected 'stabilise' or 'refuse', received {unstable!r}")
    given = _records(data)
    first = given[0]
    m, l = first.u.shape[1], first.y.shape[1]
    s = _block_rows([len(record) for record in given], m, l, order, block_rows)
    records = scaled(given)
    degree = 0
    # A record that starts or ends in a transient has means that are not a rest of the system: the constant
    # left would pass for one more mode. "n4sid" and "moesp" keep it, as SLICOT does.
    R = hankel_factor(records.u, records.y, s, degree if weighting == "cva" else -1)
    require_excitation(R, m, s)
    gamma, singular_values = observability(R, m, l, s, weighting, records.y_spread)
    if order is None:
        most = supported_order(
            correlations(R, m, l, s), records.samples - 2 * s * len(given) - s * m, m, l, s
        )
        orders = range(1, most + 1)
    elif order <= len(singular_values) - l:
        orders = range(order, order + 1)
    else:
        most = len(singular_values) - l
        raise MampcError(f"order: expected at most {most} with {s} block rows, received {order}")
    chosen = _best_order(gamma, orders, records, feedthrough, unstable)
    chosen = _with_integrators(chosen, gamma[:, : len(chosen.A)], records, feedthrough, unstable)
    chosen = _without_idle_constant(chosen, records, feedthrough)
    model = _model(chosen, records, first)
    quality = validate(model, first)
    return Identified(
        model, quality.x0, singular_values, model.n_states, chosen.integrators, quality.fit, chosen.stabilised
    )


class _Candidate(NamedTuple):
    A: Array
    C: Array
    integrators: int
    stabilised: bool
    fit: InputFit


def _best_order(
    gamma: Array, orders: Sequence[int], records: Scaled, feedthrough: bool, unstable: str
) -> _Candidate:
    """The smallest order whose simulation error is nearly the least."""
    candidates = []
    for n in orders:
        A, C = realise(gamma[:, :n], records.y[0].shape[1])
        A, stabilised = inside_unit_circle(A, unstable)
        candidates.append(_Candidate(A, C, 0, stabilised, fit_inputs(A, C, records, feedthrough=feedthrough)))
    best = min(candidate.fit.error for candidate in candidates)
    return next(candidate for candidate in candidates if candidate.fit.error <= NEAR_BEST * best)


def _with_integrators(
    found: _Candidate, gamma: Array, records: Scaled, feedthrough: bool, unstable: str
) -> _Candidate:
    """As many slow poles moved to one as the records do not contradict; see `integrators`."""
    A, C = realise(gamma, records.y[0].shape[1])
    counts = near_one(A, max(map(len, records.u)))
    if not counts:
        return found
    free = found
    if found.stabilised:  # what grows slowly is compared as it was found
        free = found._replace(fit=fit_inputs(A, C, records, feedthrough=feedthrough))
    for q in counts:
        A1, C1 = with_integrators(A, C, q)
        A1, stabilised = inside_unit_circle(A1, unstable, q)
        fit = fit_inputs(A1, C1, records, feedthrough=feedthrough, integrators=q)
        if explains_as_well(fit.error, free.fit.error, independent_samples(residuals(A1, C1, fit, records))):
            return _Candidate(A1, C1, q, stabilised, fit)
    return found


def _without_idle_constant(found: _Candidate, records: Scaled, feedthrough: bool) -> _Candidate:
    """Constants beside the means only where they say something: elsewhere they compete with slow modes."""
    if found.integrators:
        return found
    A, C = found.A, found.C
    fit = fit_inputs(A, C, records, feedthrough=feedthrough, degree=-1)
    left = independent_samples(residuals(A, C, found.fit, records))
    constants = len(records.u) * len(C)
    if left * (fit.error**2 - found.fit.error**2) <= SIGNIFICANT * constants * found.fit.error**2:
        return found._replace(fit=fit)
    return found


def _model(chosen: _Candidate, records: Scaled, like: IOData) -> StateSpace:
    """In engineering units, about the rest that the records' constants tell.

    Where integrators drift under the mean inputs, the inputs of the operating point are the nearest ones, in
    units of their spread, under which they rest.
    """
    A, C, q, (B, D, trends, _) = chosen.A, chosen.C, chosen.integrators, chosen.fit
    m = len(like.names.inputs)
    share = np.array([len(u) for u in records.u]) / records.samples
    drive = sum(w * trend.drive for w, trend in zip(share, trends, strict=True))
    du = np.linalg.lstsq(B[:q, :m], -drive)[0] if q else np.zeros(m)
    rest = np.linalg.solve(np.eye(len(A) - q) - A[q:, q:], B[q:, :m] @ du)
    constant = sum(
        w * (mean + records.y_spread * trend.polynomial[:1].sum(axis=0))
        for w, mean, trend in zip(share, records.y_mean, trends, strict=True)
    )
    y_op = constant + records.y_spread * (C[:, q:] @ rest + D[:, :m] @ du)
    u_op = records.u_mean.copy()
    u_op[:m] += du * records.u_spread[:m]
    rows = records.y_spread[:, None]
    return StateSpace(
        A, B / records.u_spread, rows * C, rows * D / records.u_spread, like.dt, u_op[:m], y_op,
        like.names, v_op=u_op[m:],
    )  # fmt: skip


def _records(data: IOData | Sequence[IOData]) -> list[IOData]:
    records = [data] if isinstance(data, IOData) else list(data)
    if not records or not all(isinstance(record, IOData) for record in records):
        raise MampcError("n4sid: expected a record (IOData) or several, received something else")
    first = records[0]
    for record in records[1:]:
        if not np.isclose(record.dt, first.dt, rtol=1e-6) or record.names != first.names:
            raise MampcError(
                "n4sid: expected records of one sample time and one set of names, "
                f"received {first.dt:g} s and {record.dt:g} s, {first.names} and {record.names}"
            )
    return records


def _block_rows(samples: list[int], m: int, l: int, order: int | None, block_rows: int | None) -> int:
    if order is not None:
        as_whole("order", order, 1)
    least = 2 if order is None else -(-order // l) + 1

    # 2 s (m + l) Hankel rows want at least as many columns, N - 2 s + 1 of each record.
    def fits(s: int) -> bool:
        return 2 * s * (m + l) <= sum(max(0, N - 2 * s + 1) for N in samples)

    most = bisect_left(range(1, max(samples) + 1), True, key=lambda s: not fits(s))
    total = sum(samples)
    if most < least:
        raise MampcError(
            f"n4sid: expected at least {2 * (m + l + 1) * least - 1} samples for {m} inputs, {l} outputs"
            f"{'' if order is None else f' and order {order}'}, received {total}"
        )
    if block_rows is None:
        return max(least, min(max(15, least + 5), total // (8 * (m + l)), most))
    s = as_whole("block_rows", block_rows, least)
    if s > most:
        raise MampcError(f"block_rows: expected at most {most} for {total} samples, received {s}")
    return s
