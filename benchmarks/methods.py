"""How the methods compare, on random instances of three sizes.

    OMP_NUM_THREADS=1 python benchmarks/methods.py [--markdown]

Every sample is one sample of a random stable model: random state, reference and past inputs. One group of
instances shares model, limits and rules, and so a controller of each method; in every second group the input
limits are narrow, so that plain MPC runs into them. Rules go round: a budget, a price, both. All methods
answer one sample after the other, in one thread; the first sample of a group is answered but not counted.
With `--markdown` the table replaces the one in docs/methods.md.
"""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterable, Iterator
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import mampc

PAGE = Path(__file__).parent.parent / "docs" / "methods.md"
BEGIN, END = "<!-- methods table -->\n", "<!-- end of methods table -->"
GROUP = 20  # instances that share a model
PLAIN = "plain MPC"
OPTIMAL = 1e-7  # relative gap that counts as none


class Size(NamedTuple):
    """One column of sizes: inputs and outputs m, horizons, budget, and how many instances are measured."""

    name: str
    m: int
    control_horizon: int
    prediction_horizon: int
    max_moves: int
    instances: int


SIZES = (Size("A", 2, 5, 10, 3, 500), Size("B", 2, 20, 50, 6, 500), Size("C", 4, 30, 60, 6, 500))


class Sample(NamedTuple):
    """What a controller is asked: the inputs applied so far, the state, and the reference."""

    inputs: np.ndarray
    x: np.ndarray
    reference: np.ndarray


class Answer(NamedTuple):
    """One method's answer to one sample."""

    objective: float
    lower_bound: float
    moves: int
    seconds: float


Answers = dict[str, Answer]  # by method


def methods() -> dict[str, mampc.controllers.mampc.Method]:
    """All methods, by the name in the table; for one sample there is nothing to warm up with."""
    settings = {"alternating": {"polish": True, "warm_up": 0}}
    return {name: method(**settings.get(name, {})) for name, method in mampc.METHODS.items()}


def random_model(rng: np.random.Generator, m: int) -> mampc.StateSpace:
    """A stable model of order 2 m with m inputs and outputs."""
    n = 2 * m
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.7, 0.97) / np.abs(np.linalg.eigvals(A)).max()
    return mampc.StateSpace(A, rng.standard_normal((n, m)), rng.standard_normal((m, n)), None, 1.0)


def random_samples(rng: np.random.Generator, model: mampc.StateSpace, count: int) -> list[Sample]:
    """Random states and references; each input has moved at each of the last two samples once in eight."""
    m, n = model.n_inputs, model.n_states
    samples = []
    for _ in range(count):
        past = np.where(rng.random((3, m)) < 0.125, 0.3 * rng.standard_normal((3, m)), 0.0)
        inputs = 0.5 * rng.standard_normal(m) + past.cumsum(axis=0)
        samples.append(Sample(inputs, rng.standard_normal(n), 2 * rng.standard_normal(model.n_outputs)))
    return samples


def group(size: Size, seed: int) -> tuple[mampc.TrackingProblem, mampc.MoveRules, list[Sample]]:
    """A problem, its rules and what is asked; odd seeds have narrow input limits."""
    rng = np.random.default_rng([seed, size.control_horizon])
    model = random_model(rng, size.m)
    samples = random_samples(rng, model, GROUP + 1)

    def problem(**limits) -> mampc.TrackingProblem:
        return mampc.TrackingProblem(
            model, prediction_horizon=size.prediction_horizon, control_horizon=size.control_horizon,
            move_weight=0.1, limits=mampc.Limits(**limits),
        )  # fmt: skip

    plain = mampc.MPC(problem())
    decisions = [answer(plain, sample) for sample in samples]
    reach = np.median([np.abs(d.plan).max(axis=0) for d in decisions], axis=0)
    limit = (0.5 if seed % 2 else 100.0) * reach
    samples = [sample._replace(inputs=np.clip(sample.inputs, -limit, limit)) for sample in samples]
    held = [answer(mampc.MAMPC(problem(), mampc.MoveRules(max_moves=0)), s) for s in samples]
    benefit = np.median([h.objective - d.objective for h, d in zip(held, decisions, strict=True)])
    budget = {"max_moves": size.max_moves, "sparsity_horizon": 3}
    price = {"price": 0.02 * benefit}
    rules = mampc.MoveRules(**(budget, price, budget | price)[seed // 2 % 3])
    return problem(u_min=-limit, u_max=limit), rules, samples


def answer(controller, sample: Sample) -> mampc.Decision:
    return controller.step(controller.initial_state(sample.inputs), sample.x, sample.reference)


def measured(controller, sample: Sample) -> Answer:
    start = perf_counter()
    decision = answer(controller, sample)
    seconds = perf_counter() - start
    return Answer(decision.objective, decision.lower_bound, int(decision.moves.sum()), seconds)


def answers_of(size: Size, seed: int) -> Iterator[tuple[Answers, bool]]:
    """The answers of all methods to a group's instances, and whether plain MPC runs into a limit."""
    problem, rules, samples = group(size, seed)
    controllers = {PLAIN: mampc.MPC(problem)}
    controllers |= {name: mampc.MAMPC(problem, rules, method=method) for name, method in methods().items()}
    for number, sample in enumerate(samples):
        answers = {name: measured(controller, sample) for name, controller in controllers.items()}
        plan = answer(controllers[PLAIN], sample).plan
        if number:
            yield answers, bool((np.abs(plan) >= problem.limits.u_max - 1e-9).any())


class Figures(NamedTuple):
    """What the table says of one method at one size."""

    median_gap: float
    high_gap: float
    optimal: float
    moves: float
    seconds: float
    ratio: float


def figures(name: str, all_answers: list[Answers]) -> Figures:
    """One method's figures; gaps are relative to the exact optimum, or to its bound where that is unproven."""
    mine = [answers[name] for answers in all_answers]
    bounds = np.array([answers["exact"].lower_bound for answers in all_answers])
    gaps = np.maximum(np.array([a.objective for a in mine]) - bounds, 0.0) / np.maximum(bounds, 1e-9)
    seconds = np.array([a.seconds for a in mine])
    plain = np.array([answers[PLAIN].seconds for answers in all_answers])
    return Figures(
        float(np.median(gaps)), float(np.percentile(gaps, 95)), float(np.mean(gaps <= OPTIMAL)),
        float(np.mean([a.moves for a in mine])), float(np.median(seconds)), float(np.median(seconds / plain)),
    )  # fmt: skip


HEADINGS = (
    "size", "method", "gap, median", "gap, 95 %", "optimal", "moves", "time per step", "times plain MPC",
)  # fmt: skip


def rows_of(size: Size, all_answers: list[Answers]) -> list[tuple[str, ...]]:
    rows = []
    for name in all_answers[0]:
        f = figures(name, all_answers)
        gaps = (
            ("", "", "")
            if name == PLAIN
            else (percent(f.median_gap), percent(f.high_gap), f"{f.optimal:.0%}")
        )
        rows.append((size.name, name, *gaps, f"{f.moves:.1f}", readable(f.seconds), rounded(f.ratio)))
    return rows


def percent(share: float) -> str:
    return "0" if share <= OPTIMAL else f"{rounded(100 * share)} %"


def rounded(number: float) -> str:
    """Two digits, without an exponent."""
    return f"{number:.2g}" if number < 10 else f"{float(f'{number:.2g}'):.0f}"


def readable(seconds: float) -> str:
    return f"{rounded(seconds * 1e6)} us" if seconds < 1e-3 else f"{rounded(seconds * 1e3)} ms"


def said_of(size: Size, all_answers: list[Answers], limited: list[bool]) -> str:
    """One sentence on the instances of one size."""
    proven = np.mean([a["exact"].objective - a["exact"].lower_bound <= 0 for a in all_answers])
    return (
        f"{size.name}: {len(all_answers)} instances of {size.m} inputs and outputs, control horizon "
        f"{size.control_horizon}, prediction horizon {size.prediction_horizon}, budget {size.max_moves}; limits "
        f"active in {np.mean(limited):.0%}; optimum proven within a second in {proven:.0%}"
    )


def markdown(rows: list[tuple[str, ...]], said: list[str], verdict: str) -> str:
    lines = ["| " + " | ".join(HEADINGS) + " |", "|" + "---|" * len(HEADINGS)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    measured = (
        "Measured by `make methods`, on random stable models, states, references and past moves under a budget, a "
        "price or both. Gaps are relative to the exact optimum, or to its lower bound where it is unproven; "
        "`alternating` polishes, and starts from v = 0."
    )
    text = textwrap.fill(f"{verdict} {measured}", 115)
    notes = [textwrap.fill(f"- {sentence}.", 115, subsequent_indent="  ") for sentence in said]
    return "\n".join([text, "", *lines, "", *notes, ""])


def verdict_on(found: dict[str, list[Figures]]) -> str:
    """What the table says, in two sentences; figures are per size, in order."""
    exact, others = found["exact"], [name for name in found if name not in ("exact", PLAIN)]
    best = max(others, key=lambda name: np.mean([f.optimal for f in found[name]]))
    return (
        f"The exact method takes {listed(rounded(f.ratio) for f in exact)} times as long as plain MPC at sizes "
        f"{listed(size.name for size in SIZES)}. Of the others `{best}` finds the optimum most often, in "
        f"{listed(f'{f.optimal:.0%}' for f in found[best])} of the instances, and takes "
        f"{listed(rounded(f.ratio) for f in found[best])} times as long."
    )


def listed(items: Iterable[str]) -> str:
    *first, last = items
    return f"{', '.join(first)} and {last}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--markdown", action="store_true", help="put the table into docs/methods.md")
    parser.add_argument("--share", type=float, default=1.0, help="share of the instances to measure")
    options = parser.parse_args()
    console = Console()
    if not console.is_terminal:
        console = Console(width=140)
    table = Table(*HEADINGS, title="methods of mampc")
    rows, said, found = [], [], {}
    with Progress(console=console) as progress:
        for size in SIZES:
            groups = max(1, round(options.share * size.instances / GROUP))
            all_answers, limited = [], []
            for seed in progress.track(range(groups), description=f"size {size.name}"):
                for answers, active in answers_of(size, seed):
                    all_answers.append(answers)
                    limited.append(active)
            for name in all_answers[0]:
                found.setdefault(name, []).append(figures(name, all_answers))
            rows += rows_of(size, all_answers)
            said.append(said_of(size, all_answers, limited))
    for row in rows:
        table.add_row(*row, end_section=row[1] == list(mampc.METHODS)[-1])
    console.print(table)
    verdict = verdict_on(found)
    for sentence in (*said, verdict):
        console.print(sentence)
    if options.markdown:
        page = PAGE.read_text()
        before, _, rest = page.partition(BEGIN)
        PAGE.write_text(before + BEGIN + markdown(rows, said, verdict) + END + rest.partition(END)[2])


if __name__ == "__main__":
    main()
