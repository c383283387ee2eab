"""What an engineer asks of a model: gains, time constants, dead times, integrators, interaction, limiting zeros.

A channel is one output and one input (or measured disturbance). Modes that do not decay, such as integrators, are set
apart from the rest, which settles.

Sources: Bristol, IEEE Trans. Automatic Control 11 (1966), for the relative gain array; Skogestad and Postlethwaite,
Multivariable Feedback Control (2005), section 10.6, for its form with integrators.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mampc.base.checks import Array, BoolArray, ComplexArray
from mampc.systems.modes import apart
from mampc.systems.state_space import StateSpace, as_discrete

LASTS = 1e-9  # distance from the unit circle of modes that do not decay
SEEN = 0.02  # of a channel's largest change: what ends its dead time, and what is left when it has settled
GROWS = 1e-6  # a pole's size beyond one from where on it makes a model unstable
RISEN = 1 - np.exp(-1.0)  # of the way, after one time constant
LONGEST = 2**13  # samples of a response
NEGLIGIBLE = 1e-9  # of the largest in its row and column: a channel of rounding alone
MOST_FOR_ZEROS = 200  # states
MATTERS = 0.1  # of the largest effect on an output: what an input may do to it unnoticed
GROWN = 10.0  # times that errors of an unstable model may grow within a prediction horizon
SINGULAR = 1e-6  # of the gain about it: the gain at a zero


@dataclass(frozen=True, eq=False)
class Properties:
    """Properties of a discrete model; times in seconds.

    Attributes:
        gain: steady gain of each channel, (l, m + d); per second where it integrates, infinite where it grows.
        integrating: channels that integrate, (l, m + d).
        time_constant: from the end of the dead time to 63 % of the way; not-a-number where a channel does not answer,
            integrates or grows.
        dead_time: until 2 % of the largest change, or of the final slope.
        settling_time: until what settles stays within 2 %; one number for the model.
        integrators, unstable: numbers of poles at one and outside the unit circle.
        relative_gain: (l, m), independent of units; None where gains grow or vanish.
        condition: of the gains, in units in which all inputs and all outputs are alike; None as before.
        limiting_zeros: zeros outside the unit circle and slower than a sample, as time constants; None where not sought
            (unequal numbers of inputs and outputs, or many states).
    """

    gain: Array
    integrating: BoolArray
    time_constant: Array
    dead_time: Array
    settling_time: float
    integrators: int
    unstable: int
    relative_gain: Array | None
    condition: float | None
    limiting_zeros: Array | None


def properties(model: StateSpace) -> Properties:
    """The properties of a discrete model.

    Raises:
        MampcError: a continuous model.
    """
    as_discrete("properties", model)
    lasting, settling = _apart(model)
    poles = np.linalg.eigvals(lasting.A) if lasting.n_states else np.zeros(0)
    unstable = int((np.abs(poles) > 1 + LASTS).sum())
    final = settling.dc_gain()
    response = _settled(settling, final)
    samples = len(response)
    size = np.abs(response).max(axis=0)
    slope = _slopes(lasting, samples)
    total = np.maximum(size, np.abs(slope) * samples)
    seen = _beside_rounding(total)
    integrating = seen & (np.abs(slope) * samples > NEGLIGIBLE * size) & (slope != 0)
    gain = np.where(integrating, slope / model.dt, np.where(seen, final, 0.0))
    if unstable:
        growing = seen & (np.abs(slope) * samples > SEEN * size)
        gain, integrating = np.where(growing, np.inf, gain), integrating & ~growing
    dead = _dead(response, slope, integrating)
    matrix = _at_low_frequency(gain, integrating, samples * model.dt)[:, : model.n_inputs]
    relative, condition = _interaction(matrix)
    return Properties(
        gain=gain,
        integrating=integrating,
        time_constant=np.where(
            seen & ~integrating & np.isfinite(gain), model.dt * _rise(response, final, dead), np.nan
        ),
        dead_time=np.where(seen, model.dt * dead, 0.0),
        settling_time=model.dt * _longest_settling(response, final, seen),
        integrators=len(poles) - unstable,
        unstable=unstable,
        relative_gain=relative,
        condition=condition,
        limiting_zeros=_limiting(model),
    )


def growth(model: StateSpace) -> float:
    """By how much errors of an unstable discrete model grow in a sample; 1 for every other model."""
    largest = float(np.abs(model.poles()).max(initial=0.0))
    return largest if largest > 1 + GROWS else 1.0


def samples_to_grow(model: StateSpace) -> int | None:
    """Samples in which errors of an unstable model grow `GROWN` times: a horizon that sees more sees little else.

    None for a model that is not unstable.
    """
    each = growth(model)
    return None if each == 1.0 else int(np.ceil(np.log(GROWN) / np.log(each)))


def _apart(model: StateSpace) -> tuple[StateSpace, StateSpace]:
    """The modes that do not decay, and the rest with D."""
    blocks, T, count = apart(model.A, lambda pole: abs(pole) >= 1 - LASTS)
    B, C = np.linalg.solve(T, model.B), model.C @ T
    lasts, rest = np.s_[:count], np.s_[count:]
    parts = (
        (blocks[lasts, lasts], B[lasts], C[:, lasts], np.zeros_like(model.D)),
        (blocks[rest, rest], B[rest], C[:, rest], model.D),
    )
    # All columns count as inputs.
    first, second = (StateSpace(*part, model.dt) for part in parts)
    return first, second


def _slopes(lasting: StateSpace, samples: int) -> Array:
    """What lasting modes add in a sample at the end of so many, (l, m + d)."""
    if not lasting.n_states:
        return np.zeros_like(lasting.D)
    with np.errstate(over="ignore", invalid="ignore"):
        last = lasting.C @ np.linalg.matrix_power(lasting.A, samples - 1) @ lasting.B
    slope: Array = np.nan_to_num(last, nan=0.0, posinf=1e300, neginf=-1e300)
    return slope


def _settled(settling: StateSpace, final: Array) -> Array:
    """The step response until every channel has settled for as long again, (samples, l, m + d)."""
    samples = 32
    while True:
        response = settling.step_response(samples)
        left = np.abs(response[samples // 2 :] - final).max(axis=0)
        if samples >= LONGEST or (left <= SEEN * np.abs(response).max(axis=0) + 1e-300).all():
            return response
        samples *= 2


def _beside_rounding(size: Array) -> BoolArray:
    """Which channels answer at all, whatever the units: size (l, m + d) beside the largest of row and column."""
    rows = size.max(axis=1, keepdims=True)
    columns = np.max(size / np.where(rows > 0, rows, 1.0), axis=0)
    answers: BoolArray = (size > NEGLIGIBLE * rows * columns) & (size > 0)
    return answers


def _dead(response: Array, slope: Array, integrating: BoolArray) -> Array:
    """Samples before each channel answers, (l, m + d): a held input shows one sample after it acts."""
    steps = np.diff(response, axis=0, prepend=0.0) + slope
    steps[0] -= slope
    course = np.abs(np.where(integrating, steps / np.where(integrating, slope, 1.0), response))
    seen = course > SEEN * np.where(integrating, 1.0, course.max(axis=0))
    first: Array = np.maximum(np.argmax(seen, axis=0) - 1.0, 0.0)
    return first


def _rise(response: Array, final: Array, dead: Array) -> Array:
    """Samples from the end of the dead time to 63 % of the way, between samples on straight lines."""
    share = response / np.where(final != 0, final, 1.0)
    there = np.argmax(share >= RISEN, axis=0)
    before = np.maximum(there - 1, 0)
    now, last = (np.take_along_axis(share, k[None], axis=0)[0] for k in (there, before))
    part = np.where(now > last, (RISEN - last) / np.where(now > last, now - last, 1.0), 1.0)
    rise: Array = np.where(there > 0, np.maximum(before + part - dead, 0.0), 0.0)
    return rise


def _longest_settling(response: Array, final: Array, seen: BoolArray) -> float:
    """Samples until every channel stays within 2 % of its largest change from where it settles."""
    away = (np.abs(response - final) > SEEN * np.abs(response).max(axis=0)) & seen
    samples = np.flatnonzero(away.any(axis=(1, 2)))
    return float(samples[-1] + 1) if len(samples) else 1.0


def _at_low_frequency(gain: Array, integrating: BoolArray, period: float) -> Array:
    """Gains that can be compared: in a row that integrates, those channels alone."""
    rows = integrating.any(axis=1, keepdims=True)
    return np.where(rows & ~integrating, 0.0, gain * np.where(rows, period, 1.0))


def _interaction(gain: Array) -> tuple[Array | None, float | None]:
    if not np.isfinite(gain).all() or not gain.any(axis=1).all() or not gain.any(axis=0).all():
        return None, None
    for _ in range(50):  # to rows and columns of equal size
        gain = gain / np.linalg.norm(gain, axis=1, keepdims=True)
        gain = gain / np.linalg.norm(gain, axis=0)
    values = np.linalg.svd(gain, compute_uv=False)
    condition = float(values[0] / values[-1]) if values[-1] > 1e-12 * values[0] else float("inf")
    relative: Array = gain * np.linalg.pinv(gain).T
    return relative, condition


def _limiting(model: StateSpace) -> Array | None:
    """Time constants of real and complex zeros in the right half plane of continuous time, slower than a sample.

    Eigenvalues that stand for zeros at infinity come out scattered. A zero is one at which the gain is singular.
    """
    m = model.n_inputs
    if m != model.n_outputs or model.n_states > MOST_FOR_ZEROS or not model.n_states:
        return None
    zeros = model.zeros()
    near = (np.abs(zeros) > 1 + 1e-6) & (np.abs(zeros) < np.e) & (np.abs(np.angle(zeros)) < np.pi / 4)
    found = [zero for zero in zeros[near & (zeros.imag >= 0)] if _is_zero(model, zero)]
    return np.sort([model.dt / float(np.log(np.abs(zero))) for zero in found])[::-1]


def _is_zero(model: StateSpace, zero: complex) -> bool:
    m = model.n_inputs

    def gain(z: complex) -> ComplexArray:
        found: ComplexArray = model.C @ np.linalg.solve(z * np.eye(model.n_states) - model.A, model.B[:, :m])
        return found + model.D[:, :m]

    try:
        here, near = gain(zero), gain(1 + (zero - 1) * 1.3)
    except np.linalg.LinAlgError:
        return False
    rows = np.linalg.norm(near, axis=1, keepdims=True)  # not those at the zero, where a whole row may vanish
    smallest, usual = (
        np.linalg.svd(matrix / np.where(rows > 0, rows, 1.0), compute_uv=False)[-1] for matrix in (here, near)
    )
    return bool(smallest < SINGULAR * usual)


def gain_deviation(model: StateSpace, found: Properties) -> Array | None:
    """Standard deviations of the gains, (l, m + d), where the record told those of the step response."""
    deviation = None if model.evidence is None else model.evidence.deviation
    if deviation is None:
        return None
    length = max(len(deviation) - 1, 1) * model.dt
    spread: Array = deviation[-1] / np.where(found.integrating, length, 1.0)
    return spread


def doubtful_gains(model: StateSpace, found: Properties) -> list[str]:
    """Channels whose gain is less than two standard deviations, named, where that is no small part of all effects."""
    deviation = gain_deviation(model, found)
    if deviation is None or model.evidence is None:
        return []
    inputs = (*model.names.inputs, *model.names.disturbances)
    moved = np.diff(model.evidence.inputs)[:, 0]
    effect = np.where(np.isfinite(found.gain), np.abs(found.gain), 0.0) * moved
    matters = 2 * deviation * moved > MATTERS * effect.max(axis=1, keepdims=True)
    weak = (np.abs(found.gain) < 2 * deviation) & (found.gain != 0) & matters
    return [f"{model.names.outputs[i]} from {inputs[j]}" for i, j in np.argwhere(weak)]


def channels_in_words(model: StateSpace, most: int = 9) -> list[str]:
    """A line each for the first channels: gain, time constant, dead time."""
    found = properties(model)
    inputs = (*model.names.inputs, *model.names.disturbances)
    answering = [(i, j) for i, j in np.ndindex(found.gain.shape) if found.gain[i, j] != 0]
    lines = []
    for i, j in answering[:most]:
        words = [
            f"gain {found.gain[i, j]:.4g}" + (" per second, integrating" if found.integrating[i, j] else "")
        ]
        if np.isfinite(found.time_constant[i, j]):
            words.append(f"time constant {time_in_words(float(found.time_constant[i, j]))}")
        if found.dead_time[i, j] > 0:
            words.append(f"dead time {time_in_words(float(found.dead_time[i, j]))}")
        lines.append(f"  {model.names.outputs[i]} from {inputs[j]}: {', '.join(words)}")
    if len(answering) > most:
        lines.append(f"  and {len(answering) - most} more")
    return lines


def time_in_words(seconds: float) -> str:
    """A time with a unit in which it is no large number."""
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"
