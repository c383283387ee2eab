"""How a plant moves from one sample to the next: by few steps of fixed kinds, many states at once.

A step of Dormand and Prince, or two or four; where these are not enough, as for stiff plants, linearly implicit
steps with extrapolation; and LSODA for what is left, such as a tank that runs empty. Every kind estimates its error,
and every state takes the first one within tolerance, so that it ends where it would alone. The number of steps and
their kind hardly ever change with the last digits of a state, so neither does where it ends.

Source: Dormand and Prince, J. Computational and Applied Mathematics 6 (1980); Deuflhard, SIAM Review 27 (1985).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mampc.base.checks import Array
from mampc.base.errors import MampcError
from mampc.plants.plant import Plant

# Tight enough that the simulation error stays far below any measurement noise.
RTOL, ATOL = 1e-7, 1e-8
LENIENT = (
    5.0  # an explicit step's estimate is its error of fourth order; the end, of fifth, is far more exact
)

# Each stage as a combination of the rates before it (the last one is the end), and the difference of the end from
# that of fourth order.
STAGES = (
    np.array([1 / 5]),
    np.array([3 / 40, 9 / 40]),
    np.array([44 / 45, -56 / 15, 32 / 9]),
    np.array([19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]),
    np.array([9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]),
    np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84]),
)
ERROR = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
EXTRAPOLATED = 8  # linearly implicit Euler steps with 1 to 8 substeps
STIFF = 3.0  # times h: an explicit step is not stable for faster modes
ROUNDED = 1e-12  # up to here a steady state is zero: units of states are not as large as that
SLOPE = 1e-7  # of a state's size: steps of the differences for its Jacobian


def state_sizes(plant: Plant) -> Array | None:
    """How large each state usually is, shape (n,); None where the plant tells no steady state.

    That is as in its steady state; of a state that is zero there, as far as inputs change it, and at most one.
    """
    rest = _at_rest(plant, None)
    if rest is None:
        return None
    sizes = np.abs(rest)
    zero = ~(np.isfinite(sizes) & (sizes > ROUNDED))
    if zero.any():
        sizes[zero] = 0.0
        moved = _moved(plant, rest)[zero]
        sizes[zero] = np.where((moved > 0) & (moved < 1.0), moved, 1.0)
    return sizes


def _moved(plant: Plant, rest: Array) -> Array:
    """The largest changes of the steady states with each input changed by itself, shape (n,)."""
    usual = getattr(plant, "u_op", None)
    moved: Array = np.zeros(len(rest))
    if usual is None:
        return moved
    inputs = np.concatenate([np.ravel(usual), np.ravel(getattr(plant, "v_op", ()))]).astype(float)
    for i, value in enumerate(inputs):
        changed = inputs.copy()
        changed[i] += 0.1 * (abs(value) or 1.0)
        there = _at_rest(plant, changed)
        if there is not None and there.shape == rest.shape:
            far = np.abs(there - rest)
            certain = far > ROUNDED * np.maximum(np.abs(there), np.abs(rest))
            moved = np.maximum(moved, np.where(np.isfinite(far) & certain, far, 0.0))
    return moved


def _at_rest(plant: Plant, inputs: Array | None) -> Array | None:
    try:
        state = plant.steady_state() if inputs is None else plant.steady_state(inputs)
        found: Array = np.array(state, dtype=float)
    except Exception:  # whatever a plant does when it is asked for a steady state that it does not have
        return None
    return found if found.ndim == 1 else None


def advance(plant: Plant, x: Array, u: Array, dt: float, *, sizes: Array | None = None) -> Array:
    """The states dt seconds later, shape (..., n), from x (..., n) under constant inputs u (..., m + d).

    Args:
        plant: what moves.
        x, u: states and inputs.
        dt: seconds.
        sizes: of the states, shape (n,), of which errors are a share where a state is smaller (see `state_sizes`);
            default one in each unit.

    Raises:
        MampcError: the integration failed.
    """
    x, u = np.asarray(x, dtype=float), np.asarray(u, dtype=float)
    if sizes is None or sizes.shape != x.shape[-1:]:
        sizes = np.ones(x.shape[-1:])
    end, error = _in_steps(_explicit, 1, plant, x, u, dt, sizes)
    if not (error <= 1).all():
        inputs = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1]))
        for kind, steps, largest in FINER:
            chosen = np.asarray((error > 1) & (error <= largest))
            if not chosen.any():
                continue
            if x.ndim == 1:  # a plant of the user's may take nothing else
                end, error = _in_steps(kind, steps, plant, x, u, dt, sizes)
            else:
                end[chosen], error[chosen] = _in_steps(
                    kind, steps, plant, x[chosen], inputs[chosen], dt, sizes
                )
        for place in map(tuple, np.argwhere(~(error <= 1))):
            end[place] = _by_lsoda(plant, x[place], inputs[place], dt, sizes)
    # Rounding must not make a level or a pressure negative.
    end = np.maximum(end, getattr(plant, "x_min", -np.inf))
    return end


Kind = Callable[[Plant, Array, Array, float, Array], tuple[Array, Array]]


def _in_steps(
    kind: Kind, steps: int, plant: Plant, x: Array, u: Array, dt: float, sizes: Array
) -> tuple[Array, Array]:
    """The ends of some steps of equal length, shape (..., n), and the largest error of each, shape (...)."""
    error: Array = np.zeros(x.shape[:-1])
    with np.errstate(all="ignore"):  # what is no number counts as too large an error
        for _ in range(steps):
            end, estimate = kind(plant, x, u, dt / steps, sizes)
            size = np.abs(end)
            share = estimate / (ATOL * np.maximum(size, sizes) + RTOL * size)
            share[~np.isfinite(end)] = np.inf
            x, error = end, np.maximum(error, share.max(axis=-1, initial=0.0))
    return x, np.where(np.isnan(error), np.inf, error)


def _explicit(plant: Plant, x: Array, u: Array, h: float, sizes: Array) -> tuple[Array, Array]:
    """A step of Dormand and Prince, and its estimated error, both of shape (..., n)."""
    rates, end = np.empty((len(ERROR), *x.shape)), x
    flat = rates.reshape(len(rates), -1)
    rates[0] = plant.derivative(x, u)
    for i, weights in enumerate(STAGES):
        end = x + h * weights.dot(flat[: i + 1]).reshape(x.shape)
        rates[i + 1] = plant.derivative(end, u)
    return end, np.abs(h / LENIENT * ERROR.dot(flat).reshape(x.shape))


def _implicit(plant: Plant, x: Array, u: Array, h: float, sizes: Array) -> tuple[Array, Array]:
    """A linearly implicit step of Euler with 1, 2, .. substeps, extrapolated; its estimated error."""
    first, n = np.asarray(plant.derivative(x, u)), x.shape[-1]
    jacobian = np.empty((*x.shape, n))
    for i in range(n):
        step, moved = SLOPE * np.maximum(np.abs(x[..., i]), 1e-3 * sizes[i]), x.copy()
        moved[..., i] += step
        jacobian[..., i] = (plant.derivative(moved, u) - first) / step[..., None]
    jacobian[~np.isfinite(jacobian).all(axis=(-1, -2))] = 0.0
    stiff = np.abs(np.linalg.eigvals(jacobian)).max(axis=-1) > STIFF / h
    ends: list[Array] = []
    before: list[Array] = []
    for substeps in range(1, EXTRAPOLATED + 1):
        try:
            implicit = np.linalg.inv(np.eye(n) - h / substeps * jacobian)
        except np.linalg.LinAlgError:
            return x, np.full(x.shape, np.inf)
        at, rate = x, first
        for j in range(substeps):
            if j:
                rate = np.asarray(plant.derivative(at, u))
            at = at + h / substeps * (implicit @ rate[..., None])[..., 0]
        before, ends = ends, [at]
        for j, coarser in enumerate(before):
            ends.append(ends[j] + (ends[j] - coarser) / (substeps / (substeps - j - 1) - 1))
    # Where a plant is not stiff, it was a bend that explicit steps failed at.
    return ends[-1], np.where(stiff[..., None], np.abs(ends[-1] - ends[-2]), np.inf)


# Kinds of steps, how many, and the largest error of the kind before at which they may be enough: a step half as long
# has an error of a thirty-second, an implicit one still less.
FINER: tuple[tuple[Kind, int, float], ...] = (
    (_explicit, 2, 0.8 * 2**5),
    (_explicit, 4, 0.8 * 4**5),
    (_implicit, 1, np.inf),
    (_implicit, 2, 100.0),
    (_implicit, 4, 100.0),
)


def _by_lsoda(plant: Plant, x: Array, u: Array, dt: float, sizes: Array) -> Array:
    from scipy.integrate import solve_ivp

    def rate(_: float, state: Array) -> Array:
        change = plant.derivative(state, u)
        if not np.isfinite(change).all():  # LSODA would never return
            raise MampcError(f"{type(plant).__name__}: the integration failed at inputs {u}: rates {change}")
        return change

    atol = ATOL * np.maximum(np.abs(x), sizes)
    result = solve_ivp(rate, (0.0, dt), x, method="LSODA", rtol=RTOL, atol=atol)
    if not result.success or not np.isfinite(result.y[:, -1]).all():
        raise MampcError(f"{type(plant).__name__}: the integration failed at inputs {u}: {result.message}")
    end: Array = result.y[:, -1]
    return end
