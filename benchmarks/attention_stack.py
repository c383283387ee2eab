"""Why ours loses on the fuel cell: the same loops with the stack, with its linear model in its place, and with the
stack where its air stays so near to where the model was taken that the model holds.

    python benchmarks/attention_stack.py

Moves at 1.25 times plain MPC's error, in percent of its moves, of methods with the knob that suits each case best.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

import mampc
from attention import BASELINE, DRIFTS, RATIO, measured
from attention_cases import cases
from mampc.compare.fronts import moves_at
from measuring import options

SEEDS = range(4)
KNOBS = {  # structures and values of the knob
    "exact price, load bank": ((("bank", 0.0, 0.3),), np.geomspace(0.02, 2.0, 7)),
    "dead-band": (DRIFTS, np.geomspace(0.5, 10.0, 7)),
    "concave penalty on moves": (((0.3, 0.0, 1.0, "MCP"),), np.geomspace(0.5, 10.0, 7)),
}
LOADS = ("none", "wandering", "sinusoidal")


def main() -> None:
    options(__doc__).parse_args()
    stack = cases()["fuel cell"]
    print("| plant | load | " + " | ".join(KNOBS) + " |\n|---|---|" + "---|" * len(KNOBS))
    near = mampc.Limits(u_min=[80.0, 80.0], u_max=[120.0, 130.0])
    compared = {
        "stack": stack,
        "its linear model": replace(stack, plant=stack.model),
        "stack, air 80 to 130 %": replace(stack, limits=near),
    }
    for name, case in compared.items():
        for kind in LOADS:
            baseline = measured(case, kind, *BASELINE, [1.0], SEEDS)[0]
            row = []
            for method, (structures, knobs) in KNOBS.items():
                print(f"{name}, {kind}: {method} ...", file=sys.stderr)
                found = [measured(case, kind, method, own, knobs, SEEDS) for own in structures]
                fewest = np.nanmin([np.inf, *(moves_at(points, baseline, RATIO).value for points in found)])
                row.append(f"{100 * fewest:.1f}" if np.isfinite(fewest) else "not reached")
            print(f"| {name} | {kind} | " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
