"""What learnt gains are worth: moves at equal error on plants whose gains are off by 20 %, before and after learning.

    python benchmarks/learnt.py [--plants Wood-Berry] [--draws 3]

Each gain of the plant is 0.8 or 1.2 times the model's, drawn. Plain MPC makes records on it (200 samples each, random
steps as loads, set-point changes); `mampc.learn_gains` corrects the model from one or four of them; the exact price
with a load bank then runs with each model in other scenarios, and with the plant's own gains. Moves are at 1.25 times
the error of plain MPC with the model as it was, in percent of its moves, with the standard error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import mampc
from attention import BASELINE, EVALUATION, RATIO, measured, regulators_of
from attention_cases import Case, cases, load_of, reference_of
from mampc.compare.fronts import moves_at
from mampc.loop.corrected_gains import with_gains
from measuring import options

OFF = 0.2
STRUCTURE = ("bank", 0.0, 0.3)
PRICES = np.geomspace(1 / 30, 30, 9)
RECORDS = 2000, 2001, 2002, 2003  # seeds
KIND = "steps"


def records(case: Case) -> list[mampc.Run]:
    """Of plain MPC on the plant."""
    (plain,) = regulators_of(case, *BASELINE, [1.0])
    return [
        mampc.simulate(
            case.plant, plain, reference_of(case), noise=case.noise, loads=load_of(KIND, case), seed=seed,
            progress=False,
        )
        for seed in RECORDS
    ]  # fmt: skip


def models(case: Case, factors: np.ndarray) -> dict[str, Any]:
    """The models to compare, by what is known of the gains."""
    made = records(case)
    found = {
        f"learnt from {count}": mampc.learn_gains(case.model, made[:count], noise=case.noise)
        for count in (1, 4)
    }
    for name, one in found.items():
        off = np.abs(one.factors / factors - 1)
        taken = "accepted" if one.accepted else "not accepted"
        print(f"  {name}: {taken}; gains off by {100 * off.mean():.0f} % on average")
    return (
        {"as they were": case.model}
        | {name: one.model for name, one in found.items()}
        | {"those of the plant": case.plant}
    )


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--plants", nargs="*", default=["Wood-Berry", "3 x 3 column"])
    parser.add_argument("--draws", type=int, default=3)
    given = parser.parse_args()
    for name in given.plants:
        ratios: dict[str, list[float]] = {}
        for draw in range(given.draws):
            usual = cases()[name]
            shape = usual.model.n_outputs, usual.model.n_inputs
            factors = 1 + OFF * np.random.default_rng(draw).choice([-1.0, 1.0], shape)
            case = replace(usual, plant=with_gains(usual.model, factors))
            print(f"{name}, draw {draw}")
            (base,) = measured(case, KIND, *BASELINE, [1.0], EVALUATION)
            for known, model in models(case, factors).items():
                own = replace(case, model=model)
                points = measured(
                    own, KIND, "exact price, load bank", STRUCTURE, PRICES, EVALUATION, sized_for=case
                )
                at = moves_at(points, base, RATIO)
                ratios.setdefault(known, []).append(at.value)
                print(f"  gains {known}: {100 * at.value:.1f} ± {100 * at.standard_error:.1f}", flush=True)
        for known, values in ratios.items():
            mean = np.exp(np.log(np.array(values) / np.array(ratios["as they were"])).mean())
            print(f"{name}, gains {known}: {mean:.2f} times the moves with gains as they were")


if __name__ == "__main__":
    main()
