"""A plant test planned from a first guess: how far to move each input, how often, and for how long.

Inputs switch between two levels, as a PRBS, all at once. What the test will tell is reckoned with the information
matrix of first-order channels with dead times: gain, time constant and dead time of each channel and a line in time of
each output are unknown; the noise is white, with a random walk beside it where outputs wander. The amplitudes are the
least with which gains come out as certain as asked.

Sources: Ljung, System Identification (1999), sections 7.4 and 13.3; Zhu, Multivariable System Identification for
Process Control (2001), chapter 3, for times between switches and lengths of tests in the process industries.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mampc.base.checks import (
    LARGEST,
    Array,
    BoolArray,
    as_array,
    as_limit,
    as_number,
    as_vector,
    as_whole,
    require_finite,
)
from mampc.base.errors import MampcError, listed
from mampc.base.files import written_whole
from mampc.base.names import Names, require_count
from mampc.identification.drift import whitened, whitening_pole
from mampc.systems.noise import white_noise
from mampc.systems.properties import properties, time_in_words
from mampc.systems.signals import prbs
from mampc.systems.state_space import StateSpace

SAMPLES = 40  # in a settling time
HOLDS = 5  # between possible switches, in a settling time
LENGTH, LONGEST = 12, 60  # settling times that a test takes, and may take at most
REST = 0.5  # of a settling time: inputs stay first, to show the noise
SETTLED = 4.0  # time constants until a first-order lag stays within 2 %
SIGNALS = 6  # from different starts, of which the one that tells most is taken
ROUND = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0, 3600.0)  # seconds
MOST_SAMPLES = 200_000


@dataclass(frozen=True, eq=False)
class PlannedTest:
    """A test to make on a plant.

    Attributes:
        u: inputs, shape (N, m), in engineering units.
        dt: sample time in seconds.
        around: levels about which inputs move, shape (m,).
        amplitude: half the distance between the two levels of each input, shape (m,).
        hold: samples between possible switches.
        uncertainty: two standard deviations of each gain, as a share of it, shape (l, m); not-a-number where no effect
            is expected.
        swing: how far each output is expected to move to either side, shape (l,).
        names: of inputs and outputs.
        notes: what the plan assumes and where it falls short, in sentences.
    """

    u: Array
    dt: float
    around: Array
    amplitude: Array
    hold: int
    uncertainty: Array
    swing: Array
    names: Names
    notes: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Seconds."""
        return len(self.u) * self.dt

    def to_csv(self, path: str | Path) -> None:
        """Write a header `time,inputs` and one row per sample, times in seconds."""
        with written_whole(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["time", *self.names.inputs])
            for k, row in enumerate(self.u):
                writer.writerow([f"{value:.10g}" for value in (k * self.dt, *row)])


def plan_test(
    gain: Any,
    settling_time: Any,
    noise: Any,
    *,
    wandering: Any = 0.0,
    dead_time: Any = 0.0,
    integrating: Any = False,
    dt: float | None = None,
    around: Any = 0.0,
    max_amplitude: Any = None,
    accuracy: float = 0.05,
    names: Names | None = None,
    seed: int = 0,
) -> PlannedTest:
    """Plan a test of a plant from a first guess of what it does.

    Guesses may be off by a factor of two: a gain twice as large is known twice as well.

    Args:
        gain: what each output does for each input, shape (l, m); 0 where nothing is expected; per second where it
            integrates.
        settling_time: seconds until an output stays within 2 % of where it goes, the dead time included, scalar or
            (l, m); where it integrates, as long as it may be left alone.
        noise: standard deviation of each output's noise, scalar or (l,).
        wandering: standard deviation of the steps of each output's random walk in one sample, scalar or (l,).
        dead_time: seconds, scalar or (l, m).
        integrating: which channels integrate, scalar or (l, m).
        dt: sample time in seconds; default about a fortieth of the longest settling time.
        around: levels about which inputs move, scalar or (m,).
        max_amplitude: largest amplitude of each input, scalar or (m,); with it the test becomes longer where it must.
        accuracy: two standard deviations of the gains asked for, as a share of them.
        names: of inputs and outputs.
        seed: chooses the signal.

    Raises:
        MampcError: shapes that do not fit together, values that are not positive, an input that moves no output.
    """
    K = np.atleast_2d(require_finite("gain", as_array("gain", gain)))
    if K.ndim != 2 or not K.size:
        raise MampcError(f"gain: expected a matrix (outputs, inputs), received shape {K.shape}")
    l, m = K.shape
    settling = _channels("settling_time", settling_time, (l, m))
    dead = _channels("dead_time", dead_time, (l, m))
    integrates = _channels("integrating", _flags(integrating), (l, m)) > 0
    sigma, walk = as_vector("noise", noise, l), as_vector("wandering", wandering, l)
    beyond = max(np.abs(K).max(), sigma.max(initial=0.0))
    if beyond > LARGEST or np.abs(K[K != 0]).min(initial=1.0) < 1 / LARGEST:
        raise MampcError(f"gain, noise: expected sizes of {1 / LARGEST:g} to {LARGEST:g}, received others")
    acts = K != 0
    if not acts.any(axis=0).all():
        idle = int(np.argmin(acts.any(axis=0))) + 1
        raise MampcError(f"gain: expected each input to move some output, received zeros of input {idle}")
    for name, values, wrong, expected in (
        ("dead_time", dead, dead < 0, "no negative number"),
        ("wandering", walk, walk < 0, "no negative number"),
        ("settling_time", settling, settling > LARGEST, f"at most {LARGEST:g} s"),
        ("settling_time", settling, settling <= dead, "more than the dead time"),
        ("noise", sigma, sigma <= 0, "more than 0; the least step that is shown, where there is none"),
    ):
        if wrong.any():
            raise MampcError(f"{name}: expected {expected}, received {float(values[wrong][0]):g}")
    accuracy = as_number("accuracy", accuracy, 0.0, exclusive=True)
    names = Names.numbered(m, l) if names is None else names
    require_count("names.inputs", names.inputs, m)
    require_count("names.outputs", names.outputs, l)
    middle = as_vector("around", around, m)
    most = as_limit("max_amplitude", max_amplitude, m, np.inf)
    if not (most > 0).all():
        raise MampcError(f"max_amplitude: expected more than 0, received {most.min():g}")
    seed = as_whole("seed", seed, 0)

    slowest, fastest = float(settling[acts].max()), float(settling[acts].min())
    dt = _round(slowest / SAMPLES) if dt is None else as_number("dt", dt, 0.0, exclusive=True)
    if LENGTH * slowest / dt > MOST_SAMPLES:
        raise MampcError(
            f"plan_test: expected at most {MOST_SAMPLES} samples, received more; take a longer dt"
        )
    hold = max(1, round(np.sqrt(slowest * fastest) / HOLDS / dt))
    pole = whitening_pole(sigma, walk)
    sigma = sigma / np.sqrt(pole)  # of what is left when the noise is made white
    plant = _Guess(
        K,
        np.maximum((settling - dead) / SETTLED, dt / 2),
        np.round(dead / dt).astype(int),
        integrates,
        dt,
        pole,
    )
    rest = int(np.ceil(REST * slowest / dt))
    samples = int(np.ceil(LENGTH * slowest / dt))
    longest = min(int(LONGEST * slowest / dt), MOST_SAMPLES)
    for _ in range(8):
        signal, unit = _best_signal(plant, samples, hold, rest, seed)
        relative = 2 * sigma[:, None] * unit / np.where(acts, np.abs(K), np.nan)  # with amplitudes of one
        needed = np.nanmax(relative, axis=0) / accuracy
        short = float((needed / most).max())
        if short <= 1 or samples >= longest:
            break
        samples = int(min(samples * max(1.1, 1.1 * min(short, 1e3) ** 2), longest))
    amplitude = np.minimum(_up(needed), most)
    u = middle + amplitude * signal
    uncertainty = relative / amplitude
    swing = np.abs(plant.outputs(amplitude * signal)).max(axis=0)
    return PlannedTest(
        u, dt, middle, amplitude, hold, uncertainty, swing, names,
        tuple(_notes(names, uncertainty, accuracy, integrates & acts, bool(walk.any()))),
    )  # fmt: skip


def first_guess(model: StateSpace) -> dict[str, Any]:
    """The arguments of `plan_test` that a model tells: one from a poor record, to record a better one.

    Raises:
        MampcError: a continuous model, or one without noise.
    """
    found = properties(model)
    m = model.n_inputs
    noise = white_noise(model.noise)
    if noise is None or model.noise is None:
        raise MampcError(
            "expected a model with the noise of its outputs, received one without; pass it (--noise)"
        )
    gain = found.gain[:, :m]
    if not np.isfinite(gain).all():
        raise MampcError(
            "expected a model whose outputs settle or integrate, received one in which they grow"
        )
    dead = np.nan_to_num(found.dead_time[:, :m])
    settling = np.where(
        found.integrating[:, :m],
        found.settling_time,
        dead + SETTLED * np.nan_to_num(found.time_constant[:, :m]),
    )
    return {
        "gain": gain, "dead_time": dead, "settling_time": np.maximum(settling, dead + model.dt),
        "integrating": found.integrating[:, :m], "noise": noise, "wandering": model.noise.drift,
        "dt": model.dt, "around": model.u_op,
        "names": model.names.undisturbed(),
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Guess:
    """First-order channels: gains, time constants in seconds, dead times in samples, which integrate; noise."""

    gain: Array
    constant: Array
    dead: Any
    integrates: BoolArray
    dt: float
    pole: Array  # of the filter that makes the noise of each output white; one where it is white

    def response(self, u: Array, i: int, j: int, slower: float = 1.0, later: int = 0) -> Array:
        """Of channel (i, j) with a gain of one, shape (N,)."""
        from scipy.signal import lfilter

        behind = 1 + int(self.dead[i, j]) + later
        held = np.concatenate([np.zeros(behind), u[: max(len(u) - behind, 0), j]])[: len(u)]
        if self.integrates[i, j]:
            summed: Array = np.cumsum(held) * self.dt
            return summed
        pole = np.exp(-self.dt / (slower * self.constant[i, j]))
        lagged: Array = lfilter([1 - pole], [1.0, -pole], held)
        return lagged

    def deviations(self, u: Array) -> Array:
        """Standard deviations of the gains for noise of one, (l, m); not-a-number where there is no channel."""
        N = len(u)
        found = np.full(self.gain.shape, np.nan)
        for i, row in enumerate(self.gain):
            columns: list[Array] = [np.arange(N) / N - 0.5]
            acting = np.flatnonzero(row).tolist()
            for j in acting:
                nominal = self.response(u, i, j)
                columns += [nominal, self.response(u, i, j, later=1) - nominal]
                if not self.integrates[i, j]:
                    columns.append(self.response(u, i, j, slower=1.1) - nominal)
            start = self.pole[i] ** np.arange(
                N
            )  # the filter's unknown state; the output's level where it is one
            X = np.column_stack([start, whitened(np.column_stack(columns), float(self.pole[i]))])
            size = np.linalg.norm(X, axis=0)
            size[size == 0] = 1.0
            spread = np.sqrt(np.diag(np.linalg.pinv((X / size).T @ (X / size), hermitian=True))) / size
            at = 2
            for j in acting:
                found[i, j] = spread[at]
                at += 2 if self.integrates[i, j] else 3
        return found

    def outputs(self, u: Array) -> Array:
        """Shape (N, l)."""
        l, m = self.gain.shape
        return np.column_stack(
            [sum(self.gain[i, j] * self.response(u, i, j) for j in range(m)) for i in range(l)]
        )


def _best_signal(plant: _Guess, samples: int, hold: int, rest: int, seed: int) -> tuple[Array, Array]:
    """Levels of -1, 0 and 1, shape (N, m), that tell most of all channels, and what they tell."""
    m = plant.gain.shape[1]
    bits = -(-samples // hold)
    order = int(np.clip(np.ceil(np.log2(max(bits + 1, 4 * m))), 4, 20))
    best = None
    for k in range(SIGNALS):
        moved = prbs(order=order, hold=hold, inputs=m, samples=samples, seed=seed + 1000 * k)
        signal = np.concatenate([np.zeros((rest, m)), moved])
        unit = plant.deviations(signal)
        far = np.abs(plant.outputs(signal)).max(axis=0)
        worth = float(np.nanmean(np.log(unit)) + np.mean(np.log(far)))
        if best is None or worth < best[0]:
            best = worth, signal, unit
    assert best is not None
    return best[1], best[2]


def _notes(
    names: Names, uncertainty: Array, accuracy: float, integrates: BoolArray, wanders: bool
) -> list[str]:
    notes = [
        "amplitudes are the least that the noise asks for; larger ones that the plant can bear tell more, and count "
        f"where loads move outputs {'more than in the record' if wanders else 'beside the noise'}"
    ]
    weak = np.argwhere(uncertainty > 1.05 * accuracy)
    if len(weak):
        gains = [
            f"{names.outputs[i]} from {names.inputs[j]} ({100 * uncertainty[i, j]:.0f} %)" for i, j in weak
        ]
        notes.append(
            f"gains less certain than asked for, with these amplitudes in {LONGEST} settling times: {listed(gains)}"
        )
    if integrates.any():
        outputs = listed([names.outputs[i] for i in np.flatnonzero(integrates.any(axis=1))])
        notes.append(
            f"{outputs} integrates: stop or bring it back by hand where it runs away, and record that too"
        )
    return notes


def _channels(name: str, value: Any, shape: tuple[int, int]) -> Array:
    """A number or a matrix as one of this shape."""
    array = require_finite(name, as_array(name, value))
    if array.ndim and array.shape != shape:
        raise MampcError(f"{name}: expected a number or shape {shape}, received shape {array.shape}")
    return np.broadcast_to(array, shape)


def _flags(value: Any) -> Any:
    """Flags as numbers; what is none stays, to be refused."""
    array = np.asarray(value)
    return array.astype(np.float64) if array.dtype == bool else value


def _round(seconds: float) -> float:
    """The longest round time that is no longer."""
    if seconds < ROUND[0]:
        return float(10.0 ** np.floor(np.log10(seconds)))
    return max(value for value in ROUND if value <= seconds)


def _up(values: Array) -> Array:
    """To two digits, upwards."""
    step = 10.0 ** (np.floor(np.log10(values)) - 1)
    rounded: Array = np.ceil(values / step - 1e-9) * step
    return rounded


def hold_in_words(plan: PlannedTest) -> str:
    """How the inputs move, in a sentence."""
    moves = ", ".join(str(int(np.count_nonzero(np.diff(column)))) for column in plan.u.T)
    return (
        f"{time_in_words(plan.duration)} in all, {len(plan.u)} samples of {plan.dt:g} s; inputs may switch every "
        f"{time_in_words(plan.hold * plan.dt)}, and do so {moves} times"
    )
