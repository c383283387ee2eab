"""What tuning promises beside what it keeps: plants and loads that it never saw, one by one.

    python benchmarks/tuned.py [--plants "3 x 3 column" tank level]

`mampc.tune` is given a model, its limits and 25 %, with the noise told and not; the controller found and plain MPC then
run on the benchmark's plant, which is off the model, under each kind of load alone, in eight scenarios. The promise is
a mean over all that tuning drew, so that single kinds may lie above it.
"""

from __future__ import annotations

import numpy as np

import mampc
from attention import EVALUATION
from attention_cases import LOADS, cases, load_of, reference_of
from measuring import options


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--plants", nargs="*", default=["3 x 3 column", "tank", "level"])
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    for name in given.plants:
        case = cases()[name]
        for told, noise in (("told", case.noise), ("not told", None)):
            tuned = mampc.tune(
                case.model, limits=case.limits, noise=noise, output_weight=1 / case.noise**2, jobs=given.jobs,
                progress=False,
            )  # fmt: skip
            print(f"{name}, noise {told}: {tuned.expected}")
            both, count, ratios = [tuned.regulator, tuned.baseline], len(EVALUATION), []
            for kind in LOADS:
                runs = mampc.simulate_batch(
                    case.plant, [own for own in both for _ in EVALUATION], reference_of(case),
                    seeds=[*EVALUATION] * 2, noise=case.noise, loads=load_of(kind, case), progress=False,
                )  # fmt: skip
                error = (
                    np.mean(((runs.y - runs.r) / case.noise) ** 2, axis=(1, 2)).reshape(2, count).mean(axis=1)
                )
                moves = (
                    (np.abs(np.diff(runs.u, axis=1)) > 1e-9).sum(axis=(1, 2)).reshape(2, count).mean(axis=1)
                )
                ratios.append(error[0] / error[1])
                print(
                    f"  {kind}: error {ratios[-1]:.2f}, moves {100 * moves[0] / moves[1]:.1f} %", flush=True
                )
            print(f"  mean of these: {np.mean(ratios):.2f}")


if __name__ == "__main__":
    main()
