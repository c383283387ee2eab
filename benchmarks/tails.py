"""What a tail that follows the interval between moves would save: moves at 1.25 times plain MPC's error, tail by tail.

    python benchmarks/tails.py [--plants tank level] [--loads none steps]

The plants and loads of the attention benchmark, the exact price with a load bank that knows the noise and with later
data, moves three tenths as heavy as plain MPC's, at seven prices. Constant tails of none, a quarter and the whole of
the prediction horizon stand beside one per price, which is told the loads: N - np, not below none, with

    1 / N = (jumps a sample) + sqrt(6 W / price)        of jumps, and of a walk whose error grows by W a sample.

Source: for a scalar walk of variance W the best band is |e| = (6 price W)^(1/4); a price holds until sqrt(price / N).
An error that nothing changes lasts until the next jump. A sinusoid counts as a ramp of its mean square slope s,
N = (6 price / s)^(1/3) / 6; coloured loads as the walk that they are at first.
"""

from __future__ import annotations

from functools import partial

import numpy as np

import mampc
from attention_cases import LOADS, Case, cases, plain_mpc, points_of, problem_of
from mampc.compare.fronts import Estimate, moves_at
from measuring import options

PRICES, SEEDS, RATIO = 100 * np.geomspace(1 / 10, 30, 7), range(3000, 3004), 1.25
TAILS = ("none", "a quarter", "whole", "formula")
PLANTS = [name for name in cases() if name != "3 x 3 column"]
CHANGES, JUMPS = 1 / 90, 1 / 60  # a sample: of the reference, and of each input's load that steps


def follows(kind: str, case: Case, price: float) -> float:
    """N of one price, in samples; loads are in units of the noise that they make."""
    outputs, inputs = len(case.noise), case.model.n_inputs
    each = outputs * inputs
    jumps = CHANGES + (inputs * JUMPS if kind == "steps" else 0.0)
    if kind == "sinusoidal":
        slope = (6 * 2 * np.pi / 100) ** 2 / 2 * each
        return float(1 / (jumps + 6 / np.cbrt(6 * price / slope)))
    growth = {"wandering": 0.4**2, "coloured": 2 * 3.0**2 / 10}.get(kind, 0.0) * each
    return float(1 / (jumps + np.sqrt(6 * growth / price)))


def regulator(case: Case, tail: float, price: float) -> mampc.Regulator:
    problem = problem_of(case, moves=3, lighter=0.3, tail=tail)
    controller = mampc.MAMPC(problem, mampc.MoveRules(price=price))
    bank = mampc.LoadBank.for_problem(problem, noise=case.noise)
    return mampc.Regulator(controller, bank, value_of_information=True)


def compared(name: str, kind: str) -> list[Estimate]:
    """Moves over plain MPC's with each of the tails."""
    case = cases()[name]
    h = case.horizon
    base = plain_mpc(case, kind, SEEDS)
    formula = [max(follows(kind, case, price) - h, 0.0) for price in PRICES]
    tails = ([0.0] * len(PRICES), [h / 4] * len(PRICES), [float(h)] * len(PRICES), formula)
    return [
        moves_at(
            points_of(case, kind, tail, [*map(partial(regulator, case), each, PRICES)], SEEDS), base, RATIO
        )
        for tail, each in zip(TAILS, tails, strict=True)
    ]


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--plants", nargs="*", default=PLANTS, help="only these")
    parser.add_argument("--loads", nargs="*", default=list(LOADS), help="only these")
    given, values = parser.parse_args(), []
    for name in given.plants:
        for kind in given.loads:
            found = compared(name, kind)
            values.append([one.value for one in found])
            told = ", ".join(
                f"{100 * one.value:.1f} ± {100 * one.standard_error:.1f} {tail}"
                for one, tail in zip(found, TAILS, strict=True)
            )
            print(f"{name}, {kind}, percent of plain MPC's moves by tail: {told}", flush=True)
    rows = np.array(values)
    rows = rows[np.isfinite(rows).all(axis=1)]
    means = np.exp(np.log(rows / rows[:, 1:2]).mean(axis=0))
    told = ", ".join(f"{mean:.2f} {tail}" for mean, tail in zip(means, TAILS, strict=True))
    better = np.exp(np.log(rows[:, :2].min(axis=1) / rows[:, 1]).mean())
    print(
        f"moves over those with a quarter, geometric mean over {len(rows)} of {len(values)} cells: {told}; "
        f"{better:.2f} with the better of none and a quarter in each"
    )


if __name__ == "__main__":
    main()
