"""How honest the standard deviations of step responses are: errors over them on made-up records whose plant is known.

    python benchmarks/coverage.py [--seeds 3] [--plant column ...] [--noise white ...]

An honest standard deviation leaves ratios whose root mean square is one, of which 95 % are below two and hardly any
above three. Ratios are taken of every channel of the step response, at a tenth, a third and all of the settling time.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.signal import lfilter

from mampc import IOData, StateSpace, n4sid, prbs

DT = 10.0
SAMPLES = 3000


def first_order(gain, time_constant, dead_time=0.0):
    return StateSpace.from_first_order(
        gain=gain, time_constant=time_constant, dead_time=np.broadcast_to(dead_time, np.shape(gain)), dt=DT
    )


def random_matrix(outputs, inputs, seed):
    """First-order channels with time constants of 3 to 40 samples."""
    rng = np.random.default_rng(seed)
    gain = rng.uniform(0.3, 2.0, (outputs, inputs)) * rng.choice([-1, 1], (outputs, inputs))
    return first_order(gain, DT * np.exp(rng.uniform(np.log(3), np.log(40), (outputs, inputs))))


PLANTS = {
    "one": first_order([[2.0]], [[120.0]]),
    "two": StateSpace([[0.9, 0.05], [0.0, 0.8]], [[0.1, 0.05], [0.0, 0.3]], np.eye(2), None, DT),
    "column": first_order(  # Wood and Berry's, minutes as seconds times ten
        [[12.8, -18.9], [6.6, -19.4]], np.array([[16.7, 21.0], [10.9, 14.4]]) * 10,
        np.array([[1.0, 3.0], [7.0, 3.0]]) * 10,
    ),
    "3x2": random_matrix(3, 2, 1),
    "5x3": random_matrix(5, 3, 2),
    "stiff": first_order([[1.0, 0.5], [0.4, 2.0]], [[20.0, 2500.0], [3000.0, 30.0]]),
}  # fmt: skip
NOISES = {"white": 0.0, "coloured": 0.9, "slow": 0.98, "walk": 1.0}  # the pole of the noise


def settling(plant):
    """Samples within which a step response comes to within 1 % of its end, 40 to 600."""
    response = plant.step_response(600)
    away = np.abs(response - response[-1]).max(axis=(1, 2)) / np.abs(response[-1]).max()
    return int(np.clip(np.count_nonzero(away > 0.01), 40, 600))


def record(plant, colour, seed, samples=SAMPLES, share=0.3):
    """PRBS of a twelfth of the settling time a bit; coloured noise of `share` of what the outputs move."""
    m = plant.B.shape[1]
    hold = max(1, settling(plant) // 12)
    u = prbs(order=10, hold=hold, inputs=m, samples=samples, seed=seed)
    clean = plant.response(plant.u_op + u)
    white = np.random.default_rng(seed + 1000).standard_normal((samples + 500, clean.shape[1]))
    noise = lfilter([1.0], [1.0, -colour], white, axis=0)[500:]
    noise *= np.sqrt(1 - colour**2) if colour < 1 else 1 / np.sqrt(500)
    noise += (colour > 0) * 0.1 * np.random.default_rng(seed + 2000).standard_normal(noise.shape)
    units_u, units_y = 10.0 ** np.random.default_rng(seed).uniform(-3, 3, (2, max(clean.shape[1], m)))
    y = clean + share * clean.std(axis=0) * noise
    units = units_y[: clean.shape[1], None] / units_u[:m]
    return IOData(u * units_u[:m], y * units_y[: clean.shape[1]], plant.dt), units


def ratios(plant, colour, seed):
    """Errors over standard deviations, and errors relative to the largest gain of each output."""
    data, units = record(plant, colour, seed)
    last = settling(plant)
    fitted = n4sid(data, feedthrough=False)
    true = plant.step_response(last + 1) * units
    error = fitted.model.step_response(last + 1) - true
    at = [max(1, last // 10), max(2, last // 3), last]
    deviation = fitted.uncertainty(last + 1)
    error, deviation = error[at], deviation[at]
    size = np.abs(true / units).max(axis=(0, 2))[:, None]
    ratio = error / np.where(deviation > 0, deviation, np.where(error == 0, 1.0, 1e-3 * units))
    return ratio, error / units / size, fitted


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--plant", nargs="*", default=list(PLANTS))
    parser.add_argument("--noise", nargs="*", default=list(NOISES))
    parser.add_argument("--each", action="store_true", help="a line for every record")
    options = parser.parse_args()
    print(
        f"{'plant':8} {'noise':9} {'rms':>6} {'median':>7} {'< 2':>5} {'> 3':>5} {'largest':>8} {'error':>7} {'CPU':>6}"
    )
    together = []
    for name in options.plant:
        for colour in options.noise:
            own, errors, start = [], [], time.process_time()
            for seed in range(options.seeds):
                z, relative, fitted = ratios(PLANTS[name], NOISES[colour], seed)
                own.append(z)
                errors.append(relative)
                if options.each:
                    rms = np.sqrt(np.mean(z**2, axis=(1, 2)))
                    print(f"    {seed} order {fitted.order} {fitted.detrend} {rms.round(2)} {fitted.notes}")
            z = np.abs(np.array(own)).ravel()
            together.append(z)
            print(line(name, colour, z, np.array(errors), time.process_time() - start), flush=True)
    print(line("all", "", np.concatenate(together), np.zeros(1), 0.0))


def line(name, colour, z, errors, seconds):
    return (
        f"{name:8} {colour:9} {np.sqrt(np.mean(z**2)):6.2f} {np.median(z):7.2f} {100 * np.mean(z < 2):4.0f}% "
        f"{100 * np.mean(z > 3):4.0f}% {z.max():8.1f} {100 * np.sqrt(np.mean(errors**2)):6.1f}% {seconds:6.1f}"
    )


if __name__ == "__main__":
    main()
