"""What regulators need by estimator alone: moves at 1.25 times plain MPC's error, beside those with a Kalman filter.

    python benchmarks/estimators.py [--plants tank level]

The plants and loads of the attention benchmark with fewer scenarios. The exact price, at six prices, estimates with a
Kalman filter as it comes, with a load bank that knows the noise, and with one that guesses it from limits; both banks
without and with later data. Nothing is tuned: with the settings of plain MPC, and with a tail and light moves.
"""

from __future__ import annotations

import numpy as np

import mampc
from attention_cases import Case, cases, plain_mpc, points_of, problem_of
from mampc.compare.fronts import moves_at
from measuring import options

LOADS = ("none", "steps", "wandering")
PRICES, SEEDS, RATIO = 100 * np.geomspace(1 / 30, 30, 6), range(2000, 2002), 1.25
SETTINGS = {"as plain MPC": {}, "tail, light moves": {"lighter": 0.1, "tail": 20.0}}
ESTIMATORS = ("Kalman filter", "bank", "bank, later data", "guessing bank", "guessing bank, later data")


def regulators(case: Case, problem: mampc.TrackingProblem, name: str) -> list[mampc.Regulator]:
    """One at each price."""
    if name == "Kalman filter":
        estimator: object = mampc.KalmanFilter.offset_free(case.model)
    else:
        noise = None if name.startswith("guessing") else case.noise
        estimator = mampc.LoadBank.for_problem(problem, noise=noise)
    later = name.endswith("later data")
    return [
        mampc.Regulator(mampc.MAMPC(problem, mampc.MoveRules(price=p)), estimator, value_of_information=later)
        for p in PRICES
    ]


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--plants", nargs="*", default=[*cases()], help="only these")
    ratios: dict[str, list[list[float]]] = {setting: [] for setting in SETTINGS}
    for name in parser.parse_args().plants:
        case = cases()[name]
        for load in LOADS:
            base = plain_mpc(case, load, SEEDS)
            for setting, settings in SETTINGS.items():
                problem = problem_of(case, moves=3, **settings)
                found = [
                    moves_at(
                        points_of(case, load, each, regulators(case, problem, each), SEEDS), base, RATIO
                    ).value
                    for each in ESTIMATORS
                ]
                ratios[setting].append([value / found[0] for value in found])
                told = ", ".join(
                    f"{100 * value:.1f} {each}" for value, each in zip(found, ESTIMATORS, strict=True)
                )
                print(f"{name}, {load}, {setting}, percent of plain MPC's moves: {told}", flush=True)
    for setting, rows in ratios.items():
        means = np.exp(np.nanmean(np.log(rows), axis=0))
        told = ", ".join(f"{mean:.2f} {each}" for mean, each in zip(means, ESTIMATORS, strict=True))
        print(f"{setting}, moves over those with a Kalman filter, geometric mean: {told}")


if __name__ == "__main__":
    main()
