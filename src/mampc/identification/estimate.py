"""One part of a model from records: order, integrators, inputs and constants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.identification.delays import Integers
from mampc.identification.drift import high_passed, theta, white_and_walk
from mampc.identification.integrators import explains_as_well, near_one, with_integrators
from mampc.identification.parts import Part, records_of_part
from mampc.identification.realisation import inside_unit_circle, realise
from mampc.identification.scaling import Scaled
from mampc.identification.simulation_error import (
    InputFit,
    fit_inputs,
    fit_trends,
    independent_samples,
    integrated,
    residuals,
)
from mampc.identification.subspace import (
    correlations,
    hankel_factor,
    observability,
    require_excitation,
    supported_order,
)

NEAR_BEST = 1.02  # simulation errors that are as good as equal
VERY_STRONG = 10.0  # difference of Schwarz's criterion (Kass and Raftery, J. Amer. Stat. Assoc. 90 (1995))
ROUNDING = 1e-6  # of the spread: smaller errors are as good as none
LITTLE = 0.2  # a filter's pole that makes no difference
EQUATIONS, LEAST = 15_000, 1000  # in which orders are compared, and samples
SIGNIFICANT = 4.0  # a square of two standard deviations
FILTERED = ("differences", "whitened")  # trends after whose filter nothing is left of levels
DEGREES = {
    "none": -1,
    "constant": 0,
    "linear": 1,
    "differences": -1,
    "whitened": 0,
}  # of the trend that is fitted
PROJECTED = {"none": -1, "constant": 0, "linear": 1, "differences": 0, "whitened": 0}  # taken off Hankel rows

Dynamics = Callable[[int, Scaled], tuple[Array, Array]]  # A and C of an order, from records


@dataclass(frozen=True)
class Settings:
    """How to estimate; see `n4sid`."""

    order: int | None
    weighting: str
    block_rows: int
    feedthrough: bool
    unstable: str


def estimate(
    records: Scaled, outputs: Sequence[int], delays: Integers, settings: Settings, trend: str
) -> tuple[Part, Array]:
    """The part of a model that explains some outputs, and the singular values its order was read from."""
    own = records_of_part(records, outputs, delays)
    if trend != "differences":
        return _estimated(own, own, tuple(outputs), delays, settings, trend)
    part, values = _estimated(own, high_passed(own, 0.0), tuple(outputs), delays, settings, trend)
    pole = theta(*white_and_walk(residuals(part.A, part.C, part.fit, own)))
    if pole < LITTLE:
        return part, values
    return _estimated(own, high_passed(own, pole), tuple(outputs), delays, settings, trend)


def _estimated(
    own: Scaled, seen: Scaled, outputs: tuple[int, ...], delays: Integers, settings: Settings, trend: str
) -> tuple[Part, Array]:
    """The part that explains `seen`, the records of the part or these filtered."""
    l, m, s = len(outputs), len(delays), settings.block_rows
    # A record that starts or ends in a transient has means that are not a rest of the system: the constant
    # left would pass for one more mode. "n4sid" and "moesp" keep it, as SLICOT does.
    slicot = trend == "constant" and settings.weighting != "cva"
    R = hankel_factor(seen.u, seen.y, s, -1 if slicot else PROJECTED[trend])
    require_excitation(R, m, s)
    gamma, values = observability(R, m, l, s, settings.weighting, own.y_spread)
    most = len(values) - l
    if settings.order is None:
        columns = seen.samples - 2 * s * len(seen.u) - s * m
        orders = range(1, supported_order(correlations(R, m, l, s), columns, m, l, s) + 1)
    elif settings.order <= most:
        orders = range(settings.order, settings.order + 1)
    else:
        raise MampcError(f"order: expected at most {most} with {s} block rows, received {settings.order}")
    part = finished(
        lambda n, _: realise(gamma[:, :n], l), orders, own, seen, outputs, delays, settings, trend
    )
    return part, values


def finished(
    dynamics: Dynamics, orders: Sequence[int], own: Scaled, seen: Scaled, outputs: tuple[int, ...], delays: Integers,
    settings: Settings, trend: str,
) -> Part:  # fmt: skip
    """A part from A and C of several orders: the order that explains the records best for its size.

    Orders are compared on no more samples than that takes.

    Args:
        own: the records of the part.
        seen: what of them is explained: themselves, or what a filter leaves of them.
    """
    few = seen.shortened(max(LEAST, EQUATIONS // len(outputs)))

    def fitted(A: Array, C: Array, q: int = 0, records: Scaled = seen) -> InputFit:
        degree = DEGREES[trend]
        return fit_inputs(A, C, records, feedthrough=settings.feedthrough, degree=degree, integrators=q)

    tried: dict[int, Part] = {}

    def attempt(n: int) -> Part:
        if n not in tried:
            A, C = dynamics(n, few)
            A, stabilised = inside_unit_circle(A, settings.unstable)
            tried[n] = Part(outputs, delays, A, C, 0, stabilised, fitted(A, C, 0, few))
        return tried[n]

    def left(n: int) -> list[Array]:
        part = attempt(n)
        return residuals(part.A, part.C, part.fit, few)

    part = attempt(_likeliest(left, orders, few.u[0].shape[1], white=trend == "whitened"))
    A, C = dynamics(len(part.A), seen)
    if few is not seen:
        stable, stabilised = inside_unit_circle(A, settings.unstable)
        part = part._replace(A=stable, C=C, stabilised=stabilised, fit=fitted(stable, C))
    part = _with_integrators(part, A, C, seen, settings.unstable, fitted, spare=len(orders) > 1)
    if trend in FILTERED:
        return _on_levels(part, own)
    return _without_idle_constant(part, seen, settings.feedthrough) if trend == "constant" else part


def _likeliest(
    left: Callable[[int], Sequence[Array]], orders: Sequence[int], inputs: int, *, white: bool
) -> int:
    """The order of the least Schwarz criterion, or a larger one: the smallest whose errors are within 2 % of the best.

    Where residuals are `white` the criterion counts them rightly, and decides alone: the smallest order that none
    beats by very strong evidence.

    Every order up to six is tried, every second or third beyond, and those beside the one that these point to.
    Residuals count as so many samples as they amount to, given how the fullest model's are correlated.
    """
    coarse = [n for k, n in enumerate(orders) if k < 6 or (k < 12 and k % 2) or k % 3 == 1 or n == orders[-1]]
    if len(coarse) == 1:
        return coarse[0]

    @cache
    def variance(n: int) -> Array:
        mean: Array = np.mean(np.concatenate(left(n)) ** 2, axis=0)
        return np.log(np.maximum(mean, ROUNDING**2))

    fullest = left(min(coarse, key=lambda n: variance(n).sum()))
    outputs = fullest[0].shape[1]
    samples = np.array(
        [max(independent_samples([one[:, i : i + 1] for one in fullest]), 1.0) for i in range(outputs)]
    )
    price = (inputs + outputs) * np.log(samples.sum())
    information = cache(lambda n: float(samples @ variance(n) + price * n))
    at = coarse.index(min(coarse, key=information))
    lower, upper = coarse[max(at - 1, 0)], coarse[min(at + 1, len(coarse) - 1)]
    near = [n for n in orders if lower <= n <= upper]
    likeliest = min(near, key=information)
    if white:
        least = information(likeliest) + VERY_STRONG
        return next(n for n in orders if (n in coarse or n in near) and information(n) <= least)
    best = min(variance(n).sum() for n in coarse)
    alike = next(n for n in coarse if variance(n).sum() <= best + 2 * outputs * np.log(NEAR_BEST))
    return max(likeliest, alike)


def _with_integrators(
    found: Part,
    A: Array,
    C: Array,
    records: Scaled,
    unstable: str,
    fitted: Callable[..., InputFit],
    *,
    spare: bool,
) -> Part:
    """As many slow poles moved to one as the records do not contradict; see `integrators`.

    Those that explain no more than chance does, by Schwarz's criterion, are left out if `spare`: a disturbance that
    walks passes for them.
    """
    counts = near_one(A, max(map(len, records.u)))
    if not counts:
        return found
    free = fitted(A, C) if found.stabilised else found.fit  # what grows slowly is compared as it was found
    for q in counts:
        A1, C1 = with_integrators(A, C, q)
        A1, stabilised = inside_unit_circle(A1, unstable, q)
        fit = fitted(A1, C1, q)
        if spare and q < len(A1):
            rest = found._replace(
                A=A1[q:, q:], C=C1[:, q:], stabilised=stabilised, fit=fitted(A1[q:, q:], C1[:, q:])
            )
            N = independent_samples(residuals(A1, C1, fit, records))
            worth = q * (len(C1) + records.u[0].shape[1]) * np.log(max(N, 2.0))
            if N * ((rest.fit.error / max(fit.error, 1e-300)) ** 2 - 1.0) <= worth:
                return rest
        if explains_as_well(fit.error, free.error, independent_samples(residuals(A1, C1, fit, records))):
            part = found._replace(A=A1, C=C1, integrators=q, stabilised=stabilised, fit=fit)
            return _without_leaks(part, records, fitted)
    return found


def _without_leaks(found: Part, records: Scaled, fitted: Callable[..., InputFit]) -> Part:
    """Integrators act on no output in which records do not show them: a leak, however small, would pass for a level.

    Outputs are let off in the order of how little of an integrator they show, as long as each explains its own as well.
    """
    q = found.integrators
    left = residuals(found.A, found.C, found.fit, records)
    shown = integrated(found.A, found.C, found.fit, records, q)
    noise = np.sqrt(sum(np.sum(one**2, axis=0) for one in left))
    share = np.sqrt(sum(np.sum(one**2, axis=0) for one in shown)) / np.maximum(noise, 1e-300)
    for i in np.argsort(share).tolist():
        C = found.C.copy()
        C[i, :q] = 0.0
        if share[i] > 1 or np.linalg.matrix_rank(C[:, :q]) < q:
            break
        fit = fitted(found.A, C, q)
        own = residuals(found.A, C, fit, records)
        error = float(np.sqrt(sum(np.sum(one[:, i] ** 2) for one in own)))
        independent = independent_samples([one[:, i : i + 1] for one in own])
        if not explains_as_well(error, float(noise[i]), independent):
            break
        found = found._replace(C=C, fit=fit)
    return found


def _without_idle_constant(found: Part, records: Scaled, feedthrough: bool) -> Part:
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


def _on_levels(part: Part, records: Scaled) -> Part:
    """A part found from differences, with the trends of the records themselves."""
    fit = part.fit
    trends = fit_trends(part.A, part.C, fit.B, fit.D, records, degree=0, integrators=part.integrators)
    return part._replace(fit=fit._replace(trends=trends))
