"""Valves that stick: how often stems start at equal error, with and without compensation.

    python benchmarks/valves.py             # prints the figures of docs/methods.md; some minutes
    python benchmarks/valves.py --seeds 2   # fewer loads

The study `examples/sticking-valves.toml` (the quadruple tank, loads that jump, noise, valves with a band of 2
and a jump of 1) over a range of prices. A stem starts when it moves at all; an input moves when it changes.
Means over the seeds; what the one without compensation makes is read off straight lines between its prices, at
the error of the other.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from mampc.base.tolerances import SAME
from mampc.study import Study, load_study
from mampc.study.running import Prepared, prepare, regulator_of, run_seeds
from measuring import options

EXAMPLE = Path(__file__).parents[1] / "examples" / "sticking-valves.toml"
PRICES = (0.03, 0.1, 0.3, 1.0, 2.0, 4.0, 8.0)
NAMES = ("price", "compensated price")


class Outcome(NamedTuple):
    """Means over the seeds, of both valves together."""

    name: str
    price: float
    error: float
    starts: float
    moves: float


def outcome(study: Study, prepared: Prepared, name: str, price: float, seeds: int) -> Outcome:
    """One controller of the study at a price."""
    table = next(table for table in study.controllers if table.name == name)
    assert table.rules is not None
    priced = table.model_copy(update={"rules": table.rules.model_copy(update={"price": price})})
    regulator = regulator_of(study, prepared.model, priced)
    batch = run_seeds(study, prepared, study.scenarios[0], regulator, range(seeds))
    metrics = batch.metrics(skip=study.skip)

    def changes(signal: np.ndarray) -> float:
        return float((np.abs(np.diff(signal[:, study.skip :], axis=1)) > SAME).sum(axis=(1, 2)).mean())

    return Outcome(
        name, price, float(metrics.tracking_error.mean()), changes(batch.position), changes(batch.u)
    )


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=4, help="of loads and noise")
    arguments = parser.parse_args()
    study = load_study(EXAMPLE)
    prepared = prepare(study)
    every = [(name, price) for name in NAMES for price in PRICES]
    found = [
        outcome(study, prepared, name, price, arguments.seeds)
        for name, price in track(every, "valves", console=Console(stderr=True))
    ]
    usual = sorted((o for o in found if o.name == NAMES[0]), key=lambda o: o.error)
    errors = [o.error for o in usual]
    table = Table("controller", "price", "error", "starts", "moves", "starts without, at equal error")
    for o in found:
        equal = float(np.interp(o.error, errors, [u.starts for u in usual], left=np.nan, right=np.nan))
        beside = "" if o in usual else "its error is not reached" if np.isnan(equal) else f"{equal:.0f}"
        table.add_row(o.name, f"{o.price:g}", f"{o.error:.3f}", f"{o.starts:.0f}", f"{o.moves:.0f}", beside)
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
