"""What a wrong model costs with a load bank, beside a Kalman filter at the same price.

    python benchmarks/wrong_models.py [--plants 24] [--share 1.0] [--gain 1.0] [--kind integrator]

Random plants (lags, dead times, integrators, resonances, modes that grow, two by two), whose gains, times, frequencies
and dead times are `share` times 20 to 30 % off the model, follow two changes of reference under each kind of load.
Cost: squared errors in units of the change, and a price for each move. Per estimator: cost and error over those with
the filter, geometric means over plants and loads, the largest, and moves; and the mean offset of the last 40 samples
without loads, in standard deviations of the noise, its median over plants and outputs and in nine of ten.

With `--kind` only plants of one kind, among them those of `LATE`, where errors of a model swing a loop most: modes that
hardly fade or integrate, behind dead times that are off too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import signal

import mampc
from measuring import options

SAMPLES, PRICE, FIRST_SEED = 200, 0.15, 5000
LOADS = ("none", "steps", "wandering", "coloured", "sinusoidal")
ESTIMATORS = {"told": False, "guessing": False, "told, later data": True, "guessing, later data": True}
Rng = np.random.Generator


def transfer(
    gain: float, poles: list[float], zeros: list[float] | None = None, delay: int = 0
) -> mampc.StateSpace:
    """Gain, polynomials of the denominator and numerator in s (highest power first), and a delay in samples of 1 s."""
    matrices = signal.tf2ss(gain * np.array([1.0] if zeros is None else zeros), poles)
    model = mampc.StateSpace(*matrices, 0.0).discretise(1.0)
    if not delay:
        return model
    n = model.n_states
    A, B = np.eye(n + delay, k=1), np.zeros((n + delay, 1))
    A[:n] = np.hstack([model.A, model.B, np.zeros((n, delay - 1))])
    B[-1] = 1.0
    return mampc.StateSpace(A, B, np.hstack([model.C, np.zeros((1, delay))]), None, 1.0)


def two_by_two(gain: np.ndarray, lag: np.ndarray, delay: np.ndarray) -> mampc.StateSpace:
    return mampc.StateSpace.from_first_order(gain=gain, time_constant=lag, dead_time=delay, dt=1.0)


def pair(kind: str, rng: Rng, share: float) -> tuple[mampc.StateSpace, mampc.StateSpace]:
    """A model, and the plant that it is wrong about."""

    def off(value: float) -> float:
        return value * (1 + share * 0.3 * rng.choice([-1, 1]) * rng.uniform(0.6, 1))

    def both(
        make: Callable[..., mampc.StateSpace], *values: float
    ) -> tuple[mampc.StateSpace, mampc.StateSpace]:
        late = int(share * rng.integers(0, 4)) if kind in ("lag", "integrator", *LATE) else 0
        delay = int(rng.integers(0, 5)) if late else 0
        return make(*values, delay), make(*map(off, values), delay + late)

    slow, fast = rng.uniform(8, 25), rng.uniform(2, 8)
    if kind == "lag":
        return both(lambda k, t, d: transfer(k, [t, 1], delay=d), 1.0, slow)
    if kind == "two lags":
        return both(lambda k, a, b, d: transfer(k, [a * b, a + b, 1], delay=d), 1.0, slow, fast)
    if kind == "inverse response":
        return both(lambda k, a, b, d: transfer(k, [a * b, a + b, 1], [-fast, 1], d), 1.0, slow, fast)
    if kind == "integrator":
        return both(lambda k, d: transfer(k, [1, 0], delay=d), 0.1)
    if kind == "integrator and lag":
        return both(lambda k, t, d: transfer(k, [t, 1, 0], delay=d), 0.1, fast)
    if kind == "resonant":
        damping = rng.uniform(0.05, 0.35)
        return both(
            lambda k, w, d: transfer(k * w * w, [1, 2 * damping * w, w * w]),
            1.0,
            2 * np.pi / rng.uniform(10, 40),
        )
    if kind in ("late resonance", "late resonance of a level"):
        damping, integrates = rng.uniform(0.05, 0.3), [0.0] if kind.endswith("level") else []
        return both(
            lambda k, w, d: transfer(k * w * w, [1, 2 * damping * w, w * w, *integrates], delay=d),
            0.05 if integrates else 1.0,
            2 * np.pi / rng.uniform(8, 50),
        )
    if kind == "late level":
        return both(lambda k, t, d: transfer(k, [t, 1, 0], delay=d), 0.1, fast)
    if kind == "late integrators":
        return both(lambda k, d: transfer(k, [1, 0, 0], delay=d), 0.02)
    if kind == "growing":
        return both(lambda k, t, d: transfer(k, [slow * t, slow - t, -1]), 1.0, fast / 2)
    gain = np.array([[1, 0.5], [-0.4, 1]]) * rng.uniform(0.5, 1.5, (2, 2))
    lag, delay = rng.uniform(5, 25, (2, 2)), rng.integers(0, 5, (2, 2)).astype(float)
    wrong = np.vectorize(off)
    return two_by_two(gain, lag, delay), two_by_two(
        wrong(gain), wrong(lag), delay + share * rng.integers(0, 3, (2, 2))
    )


KINDS = (
    "lag", "two lags", "inverse response", "integrator", "integrator and lag", "resonant", "growing", "two by two",
)  # fmt: skip
LATE = ("late resonance", "late resonance of a level", "late level", "late integrators")


def loads(kind: str, size: float, period: float) -> list[object]:
    return {
        "none": [],
        "steps": [mampc.loads.RandomSteps(size=size, every=60.0)],
        "wandering": [mampc.loads.RandomWalk(size=0.08 * size)],
        "coloured": [mampc.loads.Coloured(size=0.5 * size, time_constant=10.0)],
        "sinusoidal": [mampc.loads.Sinusoid(size=0.5 * size, period=period, phase=None)],
    }[kind]


def costs(
    seed: int, share: float, gain: float, kinds: tuple[str, ...]
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Errors and moves of each estimator, a row for every load, the filter's under an empty name; and offsets.

    These are what stays without loads, of each estimator and output, shape (estimators, l), in deviations of the noise.
    """
    rng = np.random.default_rng(FIRST_SEED + seed)
    model, plant = pair(kinds[seed % len(kinds)], rng, share)
    plant = replace(plant, B=gain * plant.B, D=gain * plant.D)
    m, l = model.n_inputs, model.n_outputs
    change = 0.35 * np.abs(model.step_response(31)).max(axis=0).sum(axis=1)
    noise = change * 10 ** rng.uniform(-2.3, -1)
    grows = np.abs(model.poles()).max() > 1 + 1e-6
    problem = mampc.TrackingProblem(
        model, prediction_horizon=30, control_horizon=3, output_weight=1 / change**2, move_weight=0.02,
        tail_horizon=1.0 if grows else 20.0, limits=mampc.Limits(u_min=-np.ones(m), u_max=np.ones(m)),
    )  # fmt: skip
    towards = change * rng.uniform(0.3, 1, l) * rng.choice([-1, 1], l)
    reference = mampc.steps(SAMPLES, np.zeros(l), [(10, towards), (110, 0.2 * towards)])
    size, period = rng.uniform(0.05, 0.3), rng.uniform(30, 120)
    if grows:  # inputs with limits hold such plants near their operating point only
        size, reference = 0.2 * size, 0.3 * reference
    banks = {"told": mampc.LoadBank(model, noise=noise), "guessing": mampc.LoadBank.for_problem(problem)}
    sparse = mampc.MAMPC(problem, mampc.MoveRules(price=PRICE))
    regulators = {
        "": mampc.Regulator(sparse, mampc.KalmanFilter.offset_free(model, measurement_noise=noise))
    } | {
        name: mampc.Regulator(sparse, banks[name.split(",")[0]], value_of_information=later)
        for name, later in ESTIMATORS.items()
    }
    found: dict[str, list[list[float]]] = {name: [] for name in regulators}
    for kind in LOADS:
        batch = mampc.simulate_batch(
            plant, [*regulators.values()], reference, seeds=[seed] * len(regulators), noise=noise,
            loads=loads(kind, size, period), progress=False,
        )  # fmt: skip
        errors = np.square((batch.y - batch.r) / change).sum(axis=(1, 2))
        moves = np.count_nonzero(np.abs(np.diff(batch.u, axis=1)) > 1e-9, axis=(1, 2))
        if kind == "none":
            stays = np.abs((batch.y - batch.r)[:, -40:].mean(axis=1)) / noise
        for name, error, count in zip(regulators, errors, moves, strict=True):
            found[name].append([error, count])
    return {name: np.array(rows) for name, rows in found.items()}, stays


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--plants", type=int, default=3 * len(KINDS), help="how many")
    parser.add_argument("--share", type=float, default=1.0, help="of 20 to 30 %% that models are off")
    parser.add_argument("--gain", type=float, default=1.0, help="of all inputs beside that")
    parser.add_argument(
        "--kind", choices=(*KINDS, *LATE), help="of the plants; default all but the late ones in turn"
    )
    given = parser.parse_args()
    kinds = KINDS if given.kind is None else (given.kind,)
    made, stays = zip(
        *(costs(seed, given.share, given.gain, kinds) for seed in range(given.plants)), strict=True
    )
    offsets = np.quantile(np.hstack(stays), (0.5, 0.9), axis=1).T
    print("{:.2f} and {:.2f} deviations stay with the filter".format(*offsets[0]))
    filtered = np.concatenate([each[""] for each in made])
    for name, (half, most) in zip(ESTIMATORS, offsets[1:], strict=True):
        bank = np.concatenate([each[name] for each in made])
        cost = np.log((bank @ [1, PRICE]) / (filtered @ [1, PRICE]))
        error, moves = np.log(bank[:, 0] / filtered[:, 0]), np.log((bank[:, 1] + 1) / (filtered[:, 1] + 1))
        above = 100 * np.mean(cost > np.log(1.2))
        print(
            f"{name}: cost {np.exp(cost.mean()):.2f}, at most {np.exp(cost.max()):.2f}, above 1.2 in {above:.0f} %; "
            f"error {np.exp(error.mean()):.2f}, at most {np.exp(error.max()):.2f}; moves {np.exp(moves.mean()):.2f}; "
            f"{half:.2f} and {most:.2f} deviations stay"
        )


if __name__ == "__main__":
    main()
