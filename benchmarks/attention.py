"""Who needs the fewest moves at equal tracking error: seven plants, five kinds of load, ours and the rivals.

    python benchmarks/attention.py [--quick] [--jobs 2] [--plants tank level] [--again "exact price"]

Every method has one knob and three structures (how fast the estimator's loads drift, or the tail of the horizon).
In scenarios of its own each structure is run over the knob for every plant and load; the one with the fewest moves at
1.25 times plain MPC's error goes on, about the knob that led there, in other scenarios, from which the results come.
All methods are tuned alike, with the same number of simulations. Then those of `IN_ONE_SETTING` are measured with the
one structure that moved least in the tuning over all plants and loads.

What is finished is kept line by line in benchmarks/results/attention/, and a run that was killed goes on from there.
Results and what made them go to benchmarks/results/attention.json, tables and the heat map to docs/comparison.md.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

import mampc
from attention_cases import LOADS, STEPS, Case, cases, load_of, per_input, points_of, problem_of, reference_of
from attention_limits import SCENARIOS, limit
from mampc import rivals
from mampc.compare.fronts import Point, moves_at
from mampc.compare.journal import Journal
from measuring import options

RESULTS = Path(__file__).parent / "results"
TUNING, EVALUATION = range(1000, 1004), range(8)  # seeds
KNOB = np.geomspace(1 / 30, 30, 6)  # of the tuning, in units of noise
ABOUT = np.geomspace(1 / 6, 6, 9)  # of the evaluation, about the knob that was found
LOWER = ABOUT[0] / ABOUT[-1]  # times the knob where none of these keeps the error
RATIO = 1.25  # of errors, that methods are tuned for


def estimator_of(case: Case, drift: float | str) -> Any:
    """A filter whose loads drift by so much of the noise, or the bank of filters."""
    if drift == "bank":
        return mampc.LoadBank(case.model, noise=case.noise)
    return mampc.KalmanFilter.offset_free(case.model, measurement_noise=case.noise, drift=drift * case.noise)


def regulators_of(case: Case, method: str, structure: tuple, knobs: Any) -> list[mampc.Regulator]:
    """One method with one structure at some values of its knob, which counts in units of noise."""
    drift, tail, lighter, *kind = structure
    unit, sigma, name = per_input(case), case.noise, method.removesuffix(", load bank")
    ours = name == "exact price"
    problem = problem_of(case, lighter=lighter, tail=tail, moves=3 if ours else 5)
    mpc, estimator = mampc.MPC(problem), estimator_of(case, drift)
    make = {
        "MPC": lambda knob: mpc,
        "dead-band": lambda knob: rivals.DeadBand(mpc, size=knob * unit),
        "rounding": lambda knob: rivals.Rounded(mpc, step=knob * unit),
        "rounding, hysteresis": lambda knob: rivals.Rounded(mpc, step=knob * unit, hysteresis=0.4),
        "event-triggered": lambda knob: rivals.EventTriggered(mpc, threshold=knob * sigma),
        "l1 on moves": lambda knob: rivals.Penalised(problem, penalty=rivals.L1(weight=10 * knob, size=unit)),
        "group l2 on moves": lambda knob: rivals.Penalised(
            problem, penalty=rivals.GroupL2(weight=10 * knob, size=unit)
        ),
        "CLOT on moves": lambda knob: rivals.Penalised(
            problem, penalty=rivals.CLOT(weight=10 * knob, size=unit)
        ),
        "elastic net on moves": lambda knob: rivals.Penalised(
            problem, penalty=rivals.ElasticNet(weight=10 * knob, size=unit)
        ),
        "concave penalty on moves": lambda knob: rivals.Penalised(
            problem, penalty=CONCAVE[kind[0]](weight=10 * knob, size=unit)
        ),
        "l0 on inputs": lambda knob: rivals.SparseInputs(
            problem_of(case, lighter=knob), most=max(len(unit) - 1, 1)
        ),
        "self-triggered": lambda knob: rivals.SelfTriggered(mpc, longest=int(np.clip(np.ceil(5 * knob), 1, 100))),
        "exact price": lambda knob: mampc.MAMPC(problem, mampc.MoveRules(price=100 * knob)),
    }[name]  # fmt: skip
    informed = ours and drift == "bank"
    return [mampc.Regulator(make(float(knob)), estimator, value_of_information=informed) for knob in knobs]


CONCAVE = {"SCAD": rivals.SCAD, "MCP": rivals.MCP, "log-sum": rivals.LogSum}
BASELINE = "MPC", (0.3, 0.0, 1.0)
DRIFTS = tuple((drift, 0.0, 1.0) for drift in (0.1, 0.3, 1.0))
BANKS = ("bank", 0.0, 1.0), ("bank", 20.0, 1.0), ("bank", 20.0, 0.3)  # under a rule
METHODS = {
    "exact price": tuple((drift, 20.0, 0.1) for drift in (0.1, 0.3, 1.0)),
    "exact price, load bank": (("bank", 0.0, 0.3), ("bank", 20.0, 0.3), ("bank", 20.0, 0.1)),
    "dead-band": DRIFTS,
    "rounding": DRIFTS,
    "rounding, hysteresis": DRIFTS,
    "event-triggered": DRIFTS,
    "l1 on moves": DRIFTS,
    "elastic net on moves": DRIFTS,
    "concave penalty on moves": tuple((0.3, 0.0, 1.0, name) for name in CONCAVE),
    "self-triggered": DRIFTS,
    "dead-band, load bank": BANKS,
    "rounding, hysteresis, load bank": BANKS,
    "group l2 on moves": DRIFTS,
    "CLOT on moves": DRIFTS,
    "l0 on inputs": DRIFTS[1:2],
}
IN_ONE_SETTING = "exact price, load bank", "dead-band", "rounding, hysteresis"
LIMITS = ("non-anticipative", "clairvoyant")
EVERYTHING = METHODS | dict.fromkeys(LIMITS, ())


def measured(
    case: Case,
    kind: str,
    method: str,
    structure: tuple,
    knobs: Any,
    seeds: range,
    *,
    sized_for: Case | None = None,
) -> list[Point]:
    """A method over its knob, in the same scenarios at every value; loads are sized for the case, or another one."""
    regulators = regulators_of(case, method, structure, knobs)
    return points_of(case, kind, method, regulators, seeds, knobs=knobs, sized_for=sized_for)


@cache
def baseline_of(name: str, kind: str, seeds: range) -> Point:
    """Plain MPC."""
    return measured(cases()[name], kind, *BASELINE, [1.0], seeds)[0]


def knob_at(points: list[Point], baseline: Point) -> float:
    """Where a method reaches the error that it is tuned for, errors rising with the knob."""
    error = np.maximum.accumulate([p.error.mean() / baseline.error.mean() for p in points])
    return float(np.exp(np.interp(RATIO, error, np.log([p.value for p in points]))))


def cell(name: str, kind: str, method: str, quick: bool) -> dict:
    """One method on one plant under one kind of load: tuned, then measured in other scenarios."""
    case, began = cases()[name], time.process_time()
    if method in LIMITS:
        baseline = baseline_of(name, kind, SCENARIOS)
        around = load_of(kind, case), reference_of(case), 0.1 / per_input(case) ** 2
        return row(
            name, kind, method, None, None, [baseline, *limit(method, case, kind, *around, baseline)], began
        )
    each = tuning_of(name, kind, method, quick)
    at = [moves for moves, _ in each]
    best = int(np.argmin(np.where(np.isfinite(at), at, np.inf)))
    structure = EVERYTHING[method][best]
    points = evaluation_of(name, kind, method, structure, each[best][1], quick)
    return row(name, kind, method, structure, each, points, began)


def tuning_of(name: str, kind: str, method: str, quick: bool) -> list[tuple[float, float]]:
    """Moves over plain MPC's of each structure, not-a-number where never within the error, and the knob there."""
    knobs, seeds = (KNOB[::2], TUNING[:1]) if quick else (KNOB, TUNING)
    base = baseline_of(name, kind, seeds)
    each = [measured(cases()[name], kind, method, own, knobs, seeds) for own in EVERYTHING[method]]
    return [(moves_at(points, base, RATIO).value, knob_at(points, base)) for points in each]


def evaluation_of(
    name: str, kind: str, method: str, structure: tuple, knob: float, quick: bool
) -> list[Point]:
    """Plain MPC, and a method about a value of its knob, in other scenarios than those of the tuning."""
    case, about = cases()[name], ABOUT[::4] if quick else ABOUT
    seeds = EVALUATION[:2] if quick else EVALUATION
    baseline = baseline_of(name, kind, seeds)
    points = measured(case, kind, method, structure, knob * about, seeds)
    if not np.isfinite(
        moves_at(points, baseline, RATIO).value
    ):  # what led there in other scenarios was too much here
        points = [*measured(case, kind, method, structure, knob * about * LOWER, seeds), *points]
    return [baseline, *points]


def measure_in_one_setting(method: str, journal: Journal, quick: bool) -> None:
    """The structure of a finished method that is best in the tuning over all cells, measured in every one."""
    rows = [journal.done[str((name, kind))][0] for kind in LOADS for name in cases()
            if str((name, kind)) in journal.done]  # fmt: skip
    if len(rows) < len(LOADS) * len(cases()):
        return
    tuned = np.array([row["tuned to"] for row in rows])[..., 0]  # (cells, structures)
    best = int(np.log(np.where(np.isfinite(tuned), tuned, 1.0)).mean(axis=0).argmin())
    structure = EVERYTHING[method][best]
    for own in rows:
        name, kind = own["plant"], own["load"]
        task = str((name, kind, "in one setting"))
        if task in journal.done:
            continue
        if tuple(own["structure"]) != structure:
            began = time.process_time()
            points = evaluation_of(name, kind, method, structure, own["tuned to"][best][1], quick)
            own = row(name, kind, method, structure, own["tuned to"], points, began)
        journal.add(task, [own])
        print(f"in one setting: {name}, {kind}, {method}", file=sys.stderr)


def row(
    name: str, kind: str, method: str, structure: Any, tuned: Any, points: list[Point], began: float
) -> dict:
    """What is kept of a cell; plain MPC is the first of the points."""
    return {
        "plant": name, "load": kind, "method": method, "structure": structure, "tuned to": tuned,
        "points": [
            {"knob": p.value, "moves": p.moves.tolist(), "error": [float(f"{e:.6g}") for e in p.error]}
            for p in points
        ],
        "seconds": round(time.process_time() - began, 1),
    }  # fmt: skip


def name_of(quick: bool) -> str:
    return "attention-quick" if quick else "attention"


def journals_of(quick: bool, again: list[str]) -> dict[str, Journal]:
    """What is finished of every method, by plant and load."""
    journals = {}
    for method, structures in EVERYTHING.items():
        constants = f"{quick} {TUNING} {EVALUATION} {STEPS} {KNOB} {ABOUT} {RATIO} {method} {structures}"
        path = RESULTS / name_of(quick) / f"{method.replace(', ', '-').replace(' ', '-')}.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
        if method in again:
            path.unlink(missing_ok=True)
        journals[method] = Journal(path, hashlib.sha256(constants.encode()).hexdigest()[:16])
    return journals


def run(
    journals: dict[str, Journal],
    quick: bool,
    jobs: int,
    plants: list[str],
    methods: list[str],
    kinds: Any = LOADS,
) -> None:
    """Whatever is not finished."""
    missing = [
        (name, kind, method)
        for method in EVERYTHING for kind in kinds for name in cases()
        if (not plants or name in plants) and method in (methods or EVERYTHING)
        and str((name, kind)) not in journals[method].done
    ]  # fmt: skip
    began = time.time()
    parallel = Parallel(n_jobs=jobs, return_as="generator_unordered")
    results = parallel(delayed(cell)(*task, quick) for task in missing)
    for number, found in enumerate(results, 1):
        journals[found["method"]].add(str((found["plant"], found["load"])), [found])
        left = (time.time() - began) / number * (len(missing) - number)
        told = ", ".join(found[key] for key in ("plant", "load", "method"))
        print(f"{number} of {len(missing)}, {left / 60:.0f} min left: {told}", file=sys.stderr)
    for method in IN_ONE_SETTING:
        if method in (methods or EVERYTHING):
            measure_in_one_setting(method, journals[method], quick)


def collect(journals: dict[str, Journal], quick: bool) -> None:
    """All that is finished, and what made it, into attention.json."""
    rows, alike = [
        [
            row
            for name in cases() for kind in LOADS for method in EVERYTHING
            for row in journals[method].done.get(str((name, kind, *setting)), [])
        ]
        for setting in ((), ("in one setting",))
    ]  # fmt: skip
    made_by = {
        "command": "python benchmarks/attention.py" + (" --quick" if quick else ""),
        "python": platform.python_version(), "numpy": np.__version__, "mampc": mampc.__version__,
        "machine": platform.machine(), "minutes of one core": round(sum(row["seconds"] for row in rows) / 60, 1),
        "samples": STEPS, "scenarios to tune in": len(TUNING[:1] if quick else TUNING),
        "scenarios to measure in": len(EVALUATION[:2] if quick else EVALUATION),
    }  # fmt: skip
    lines, same = (",\n".join(json.dumps(row) for row in some) for some in (rows, alike))
    text = f'{{"made by": {json.dumps(made_by, indent=1)},\n"cells": [\n{lines}\n],\n"in one setting": [\n{same}\n]}}\n'
    (RESULTS / f"{name_of(quick)}.json").write_text(text, encoding="utf-8")


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer seeds and settings, to see that it runs")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--plants", nargs="*", default=[], help="only these")
    parser.add_argument("--methods", nargs="*", default=[], help="only these")
    parser.add_argument("--loads", nargs="*", default=list(LOADS), help="only these")
    parser.add_argument("--again", nargs="*", default=[], help="methods to run anew")
    parser.add_argument(
        "--draw", action="store_true", help="tables and the heat map from the results there are"
    )
    given = parser.parse_args()
    journals = journals_of(given.quick, given.again)
    if not given.draw:
        run(journals, given.quick, given.jobs, given.plants, given.methods, given.loads)
    if any(journal.done for journal in journals.values()):
        collect(journals, given.quick)
    import attention_report

    results = RESULTS / f"{name_of(given.quick)}.json"
    if given.quick:
        print(attention_report.told(results)[0])
    else:
        attention_report.write(results)


if __name__ == "__main__":
    import attention  # other processes find its functions by this name

    attention.main()
