"""What gains learnt while the loop runs are worth: error, moves and cost in the end, beside the same loop without.

    python benchmarks/learnt_online.py [--seeds 5] [--only off]

800 samples under wandering loads or random steps, and set-point changes every 100 samples; the last quarter counts. The
exact price with a load bank, at one price, with and without `learn_gains=True`. Plants:

off: each gain 0.8 or 1.2 times the model's, drawn; right: the model itself; nonlinear: the quadruple tank and the van
de Vusse reactor, with models linearised at their operating points; wrong: gains, lags and dead times off the model, as
in benchmarks/wrong_models.py, without those that integrate or grow.

Ratios are geometric means over plants, loads and seeds, with their standard errors; then the largest ratio of costs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import mampc
import wrong_models
from attention_cases import Case, cases, load_of, problem_of
from mampc.loop.corrected_gains import with_gains
from measuring import options

OFF, PRICE, SAMPLES = 0.2, 30.0, 800
KINDS = "off", "right", "nonlinear", "wrong"
LINEAR = "Wood-Berry", "3 x 3 column"
FADING = "lag", "two lags", "inverse response", "resonant", "two by two"


def plants(kind: str, seed: int) -> Iterator[tuple[str, Case]]:
    """The cases of a kind, by name."""
    rng = np.random.default_rng(seed)
    if kind == "wrong":
        name = FADING[seed % len(FADING)]
        model, plant = wrong_models.pair(name, rng, 1.0)
        change = 0.35 * np.abs(model.step_response(31)).max(axis=0).sum(axis=1)
        limits = mampc.Limits(u_min=-np.ones(model.n_inputs), u_max=np.ones(model.n_inputs))
        yield name, Case(plant, model, change / 30, change, limits, 30)
        return
    for name in LINEAR if kind != "nonlinear" else ("tank", "van de Vusse"):
        case = cases()[name]
        if kind == "off":
            factors = 1 + OFF * rng.choice([-1.0, 1.0], (case.model.n_outputs, case.model.n_inputs))
            case = replace(case, plant=with_gains(case.model, factors))
        elif kind == "right":
            case = replace(case, plant=case.model)
        yield name, case


def loops(case: Case) -> tuple[mampc.Regulator, mampc.Regulator]:
    """Without and with learning."""
    controller = mampc.MAMPC(problem_of(case, lighter=0.3, moves=3), mampc.MoveRules(price=PRICE))
    bank = mampc.LoadBank(case.model, noise=case.noise)
    return mampc.Regulator(controller, bank), mampc.Regulator(controller, bank, learn_gains=True)


def ends(case: Case, load: str, seed: int) -> tuple[np.ndarray, list[int]]:
    """Error, moves and cost of the last quarter, a row for each loop, and when gains changed."""
    rng, rows = np.random.default_rng(seed), []
    towards = rng.uniform(-1, 1, (SAMPLES // 100, case.model.n_outputs))
    reference = np.repeat(case.model.y_op + case.changes * towards, 100, axis=0)
    for loop in loops(case):
        run = mampc.simulate(
            case.plant,
            loop,
            reference,
            noise=case.noise,
            loads=load_of(load, case),
            seed=seed,
            progress=False,
        )
        last = slice(3 * SAMPLES // 4, None)
        error = np.square((run.y - reference) / case.noise)[last].sum()
        moves = np.count_nonzero(np.abs(np.diff(run.u, axis=0)) > 1e-9, axis=1)[last].sum()
        rows.append([error, moves + 1, error + PRICE * moves])
        changed = [
            k for k, decision in enumerate(run.decisions) if mampc.Remark.GAINS_CORRECTED in decision.remarks
        ]
    return np.array(rows), changed


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", choices=KINDS, help="of the plants; default all")
    parser.add_argument("--verbose", action="store_true", help="every run")
    given = parser.parse_args()
    for kind in KINDS if given.only is None else (given.only,):
        logs, counts = [], []
        for seed in range(given.seeds):
            for name, case in plants(kind, seed):
                for load in ("wandering", "steps"):
                    rows, changed = ends(case, load, seed)
                    logs.append(np.log(rows[1] / rows[0]))
                    counts.append(len(changed))
                    if given.verbose:
                        print(
                            f"  {name}, {load}, {seed}: {np.exp(logs[-1]).round(3)} changed at {changed}",
                            flush=True,
                        )
        mean, spread = np.mean(logs, axis=0), np.std(logs, axis=0, ddof=1) / np.sqrt(len(logs))
        words = ", ".join(
            f"{what} {np.exp(m):.3f} ± {s:.3f}"
            for what, m, s in zip(("error", "moves", "cost"), mean, spread, strict=True)
        )
        most = np.exp(np.max(logs, axis=0)[2])
        print(f"{kind}: {words}; cost at most {most:.2f}; {np.mean(counts):.1f} changes", flush=True)


if __name__ == "__main__":
    main()
