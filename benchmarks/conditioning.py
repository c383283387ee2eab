"""How exact the exact method is, at any conditioning.

    python benchmarks/conditioning.py [first] [last]

Decisions on problems with integrators, unstable and slow poles, weights and outputs of any size, limits of inputs and
in every fourth of moves, and rules of every kind against brute force in 120 digits (tests/conditioned.py), one kind of
plant a line.
"""

from __future__ import annotations

import sys
import warnings
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from joblib import Parallel, delayed
from rich.console import Console
from rich.progress import track
from rich.table import Table

import mampc
from measuring import options

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
TIME_LIMIT = 60.0  # seconds a step, so that a busy machine changes nothing


class Result(NamedTuple):
    """One instance: how far objective and bound are from the optimum, relative to it."""

    kind: str
    outcome: str
    condition: float
    objective: float
    above: float


def measure(seed: int) -> Result:
    from conditioned import Referee, case_of

    case = case_of(seed, moves_limited=seed % 4 == 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mampc.MampcWarning)
        try:
            controller = mampc.MAMPC(case.problem, case.rules, method="exact", time_limit=TIME_LIMIT)
        except mampc.MampcError:
            return Result(case.kind, "refused", 0.0, 0.0, -np.inf)
    decision = controller.step(controller.initial_state(case.past), case.x, case.reference)
    condition = controller.condensed.condition
    if decision.status.startswith("held"):
        return Result(case.kind, decision.status.value, condition, 0.0, -np.inf)
    optimum = Referee(case).optimum()
    return Result(
        case.kind, decision.status.value, condition,
        float((decision.objective - optimum) / optimum), float((decision.lower_bound - optimum) / optimum),
    )  # fmt: skip


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("first", type=int, nargs="?", default=0, help="seed of the first instance")
    parser.add_argument("last", type=int, nargs="?", default=2000, help="one beyond that of the last")
    asked = parser.parse_args()
    first, last = asked.first, asked.last
    calls = Parallel(n_jobs=-1, return_as="generator")(delayed(measure)(seed) for seed in range(first, last))
    console = Console()
    if not console.is_terminal:
        console = Console(width=120)
    results = defaultdict(list)
    for result in track(calls, total=last - first, console=Console(stderr=True), description="instances"):
        results[result.kind].append(result)
    columns = (
        "",
        "instances",
        "proven",
        "otherwise",
        "condition up to",
        "objective off by",
        "bound above by",
    )
    table = Table(*columns, title="exact method against brute force in 120 digits, worst of all, relative")
    for kind, found in results.items():
        proven = [result for result in found if result.outcome == "optimal"]
        others = sorted({result.outcome for result in found} - {"optimal"})
        counts = ", ".join(f"{sum(r.outcome == outcome for r in found)} {outcome}" for outcome in others)
        table.add_row(
            kind, str(len(found)), str(len(proven)), counts, f"{max(r.condition for r in found):.0e}",
            f"{max((abs(r.objective) for r in proven), default=0.0):.0e}",
            f"{max((max(r.above, 0.0) for r in found), default=0.0):.0e}",
        )  # fmt: skip
    console.print(table)


if __name__ == "__main__":
    main()
