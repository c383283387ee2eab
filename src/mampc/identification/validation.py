"""How well a model explains a record it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, as_instance
from mampc.base.errors import MampcError
from mampc.identification.data import IOData
from mampc.identification.simulation_error import filtered, states
from mampc.identification.triangular import fold, solve
from mampc.systems.riccati import predicted_covariance
from mampc.systems.state_space import StateSpace

RUNAWAY = 7.0  # logarithm of the growth over a record beyond which a model is not simulated
NEGLIGIBLE = 1e-4  # disturbance of the states beside the inputs'


@dataclass(frozen=True, eq=False)
class Validation:
    """A simulated record beside the measured one.

    Attributes:
        fit: 100 (1 - |y - y_hat| / |y - mean(y)|) in percent, per output, shape (l,).
        y_hat: simulated outputs, shape (N, l).
        residuals: y - y_hat, shape (N, l).
        x0: initial state, fitted to the record, shape (n,).
        whiteness: p-value per output, shape (l,), of the Ljung-Box test that the residuals are white:
            small values say that they are not, which is usual for a simulation without a noise model.
    """

    fit: Array
    y_hat: Array
    residuals: Array
    x0: Array
    whiteness: Array


def validate(model: StateSpace, data: IOData, *, drift: bool = False) -> Validation:
    """Simulate the model over a record, without feedback of its outputs.

    An unstable model, whose simulation would run away, predicts one sample ahead instead, with the least
    correction by past outputs that keeps it stable (which mirrors its unstable poles).

    The outputs serve only to fit the initial state by least squares, and with `drift` a line in time at each
    output, which y_hat then contains and about which the fit is measured.

    Raises:
        MampcError: another sample time or number of signals than the model's.
    """
    model, data = as_instance("model", model, StateSpace), as_instance("data", data, IOData)
    if not np.isclose(model.dt, data.dt, rtol=1e-6):
        raise MampcError(f"validate: expected a record sampled every {model.dt:g} s, received {data.dt:g} s")
    if (data.u.shape[1], data.y.shape[1]) != (model.B.shape[1], model.n_outputs):
        raise MampcError(
            f"validate: expected {model.B.shape[1]} inputs and {model.n_outputs} outputs, "
            f"received {data.u.shape[1]} and {data.y.shape[1]}"
        )
    if _runs_away(model, len(data)):
        x0, y_hat = _predicted(model, data)
        line = np.zeros_like(y_hat)
    else:
        x0, line = initial_state(model, data, drift=drift)
        y_hat = model.response(data.u, x0) + line
    residuals = data.y - y_hat
    return Validation(fit(_about_lines(data, y_hat, drift)), y_hat, residuals, x0, whiteness(residuals))


def fit_to_all(model: StateSpace, records: Sequence[IOData], *, drift: bool = False) -> Array:
    """The fit to several records taken together, each with its own initial state, shape (l,)."""
    return fit(*(_about_lines(data, validate(model, data, drift=drift).y_hat, drift) for data in records))


def _about_lines(data: IOData, y_hat: Array, drift: bool) -> tuple[Array, Array]:
    own = _lines(len(data)) if drift else np.empty((len(data), 0))
    level = own @ (own.T @ data.y)
    return data.y - level, y_hat - level


def fit(*pairs: tuple[Array, Array]) -> Array:
    """100 (1 - |y - y_hat| / |y - mean(y)|) in percent per output, of one record or several, each about its own mean.

    100 for a constant matched exactly.
    """
    error = np.sqrt(sum(np.sum((y - y_hat) ** 2, axis=0) for y, y_hat in pairs))
    spread = np.sqrt(sum(np.sum((y - y.mean(axis=0)) ** 2, axis=0) for y, _ in pairs))
    with np.errstate(divide="ignore", invalid="ignore"):
        percent: Array = 100 * (1 - np.where(error == 0, 0.0, error / spread))
    return percent


def initial_state(model: StateSpace, data: IOData, *, drift: bool = False) -> tuple[Array, Array]:
    """The state at the first sample that fits the outputs best, shape (n,), and lines in time, shape (N, l).

    Least squares over all samples, each output in units of its standard deviation. Lines are zero without
    `drift`.
    """
    n, l, N = model.n_states, model.n_outputs, len(data)
    unexplained = data.y - model.response(data.u)
    spread = data.y.std(axis=0)
    spread[spread == 0.0] = 1.0
    lines = _lines(N) if drift else np.empty((N, 0))
    own = lines.shape[1] * l
    factor: Array = np.empty((0, n + own + 1))
    start = 0
    for free in filtered(model.A, model.C / spread[:, None], _impulse, (N, 1)):
        chunk = slice(start, start + len(free))
        at_outputs = np.einsum("kd,op->kodp", lines[chunk], np.eye(l)).reshape(len(free), l, own)
        right = (unexplained[chunk] / spread)[..., None]
        rows = np.concatenate([free[..., 0], at_outputs, right], axis=2)
        factor = fold(factor, rows.reshape(-1, n + own + 1))
        start += len(free)
    solution = solve(factor)
    return solution[:n], lines @ solution[n:].reshape(-1, l) * spread


def _runs_away(model: StateSpace, samples: int) -> bool:
    growth = np.abs(model.poles()).max(initial=0.0)
    return bool(growth > 1.0 and samples * np.log(growth) > RUNAWAY)


def _predicted(model: StateSpace, data: IOData) -> tuple[Array, Array]:
    """The initial state, shape (n,), and one-step predictions, shape (N, l)."""
    spread = data.y.std(axis=0)
    spread[spread == 0.0] = 1.0
    A, C = model.A, model.C / spread[:, None]
    unit = np.linalg.norm(model.B * data.u.std(axis=0), axis=1)
    Q = np.diag((NEGLIGIBLE * (unit + NEGLIGIBLE * unit.max(initial=1e-300))) ** 2)
    P = predicted_covariance(A, C, Q, np.eye(len(C)))
    K = A @ np.linalg.solve(C @ P @ C.T + np.eye(len(C)), C @ P).T
    predictor, du = A - K @ C, data.u - model.all_inputs_op
    direct = (data.y - model.y_op) / spread - du @ (model.D / spread[:, None]).T
    explained = states(predictor, du @ model.B.T + direct @ K.T, np.zeros(len(A))) @ C.T
    free = np.concatenate(list(filtered(predictor, C, _impulse, (len(data), 1))))[..., 0]
    x0 = np.linalg.lstsq(free.reshape(-1, len(A)), (direct - explained).reshape(-1))[0]
    return x0, data.y - (direct - explained - free @ x0) * spread


def _impulse(rows: slice) -> Array:
    """One at the first sample of all."""
    impulse: Array = (np.arange(rows.start, rows.stop) == 0)[:, None].astype(float)
    return impulse


def _lines(samples: int) -> Array:
    """An orthonormal basis of lines in time, shape (samples, 2)."""
    lines: Array = np.empty((samples, 2))
    lines[:, 0], lines[:, 1] = 1.0, np.arange(samples) - (samples - 1) / 2
    lines /= np.maximum(np.linalg.norm(lines, axis=0), 1e-300)
    return lines


def whiteness(residuals: Array, lags: int = 20) -> Array:
    """p-values of the Ljung-Box test, one per column; 1 for residuals that are all zero."""
    from scipy.stats import chi2

    count = len(residuals)
    lags = max(1, min(lags, count - 2))
    centred = residuals - residuals.mean(axis=0)
    power = np.maximum((centred**2).sum(axis=0), 1e-300)
    statistic = np.zeros(residuals.shape[1])
    for lag in range(1, lags + 1):
        correlation = (centred[lag:] * centred[:-lag]).sum(axis=0) / power
        statistic += correlation**2 / max(1, count - lag)
    p: Array = chi2.sf(count * (count + 2) * statistic, lags)
    return p
