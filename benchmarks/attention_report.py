"""The heat map and the tables of docs/comparison.md, from the results of the attention benchmark."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mampc.compare.fronts import Point, moves_at

DOCS = Path(__file__).parent.parent / "docs"
RATIO, RATIOS = 1.25, (1.05, 1.1, 1.25, 1.5)
BEGIN, END = "<!-- attention, by `make attention` -->", "<!-- end of attention -->"
OURS = ("exact price, load bank", "exact price")
UNDER_RULES = ("dead-band, load bank", "rounding, hysteresis, load bank")  # our estimator without our plans
LIMITS = ("non-anticipative", "clairvoyant")
SURE = 2.0  # standard errors


class Moves(NamedTuple):
    """Moves in percent of plain MPC's, with the standard error; infinite where the error is never reached."""

    value: float
    error: float

    def __str__(self) -> str:
        spread = f" ± {self.error:.1f}" if np.isfinite(self.error) else ""
        return f"{self.value:.1f}{spread}" if np.isfinite(self.value) else "not reached"


Cells = dict[tuple[str, str], dict[str, dict[float, Moves]]]  # plant and load -> method -> ratio of errors


def write(results: Path) -> None:
    """Put the results into docs/comparison.md, and draw the heat map."""
    body, cells, methods = told(results)
    page = DOCS / "comparison.md"
    text = page.read_text(encoding="utf-8")
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    page.write_text(f"{text[:start]}\n\n{body}\n\n{text[end:]}", encoding="utf-8")
    draw(cells, methods)


def told(results: Path) -> tuple[str, Cells, list[str]]:
    """The results in words and tables; by plant and load; and the methods in them."""
    content = json.loads(results.read_text(encoding="utf-8"))
    cells = cells_of(content["cells"])
    methods = list(dict.fromkeys(name for cell in cells.values() for name in cell if name not in LIMITS))
    figure = "![Moves of the exact price over those of the best rival](images/attention.svg)"
    parts = [
        made_by(content["made by"]),
        *unmeasured(cells, methods),
        figure,
        standing(cells, methods),
        *under_rules(cells),
        by_load(cells, methods),
    ]
    parts += [by_ratio(cells, methods), *in_one_setting(cells, cells_of(content["in one setting"]))]
    parts += [losses(cells, methods), by_cell(cells, methods)]
    if any(name in cell for cell in cells.values() for name in LIMITS):
        parts.append(limits(cells))
    return "\n\n".join(parts), cells, methods


def cells_of(rows: list[dict[str, Any]]) -> Cells:
    """The moves of every row; a limit is what the search found or a controller reached in the same scenarios."""
    cells: Cells = {}
    curves: dict[tuple[str, str], dict[str, list[Point]]] = {}
    for row in rows:
        points = [
            Point(row["method"], p["knob"], np.array(p["moves"]), np.array(p["error"])) for p in row["points"]
        ]
        where = row["plant"], row["load"]
        curves.setdefault(where, {})[row["method"]] = points
        cells.setdefault(where, {})[row["method"]] = {ratio: at(points, ratio) for ratio in RATIOS}
    for where, cell in cells.items():
        for limit in [name for name in LIMITS if name in cell]:
            count = len(curves[where][limit][0].moves)
            fewest = [
                {ratio: at([first(p, count) for p in points], ratio) for ratio in RATIOS}
                for name, points in curves[where].items() if name not in LIMITS
            ]  # fmt: skip
            if limit == LIMITS[1] and LIMITS[0] in cell:
                fewest.append(cell[LIMITS[0]])
            for ratio in RATIOS:
                found = [cell[limit][ratio], *(one[ratio] for one in fewest)]
                cell[limit][ratio] = min(found, key=lambda moves: moves.value)
    return cells


def at(points: list[Point], ratio: float) -> Moves:
    """Moves of the points but the first, which is plain MPC, at a ratio of errors."""
    value, error = moves_at(points[1:], points[0], ratio)
    return Moves(100 * value if np.isfinite(value) else np.inf, 100 * error)


def first(point: Point, count: int) -> Point:
    """A point in so many scenarios only."""
    return Point(point.method, point.value, point.moves[:count], point.error[:count])


def made_by(how: dict[str, Any]) -> str:
    return (
        f"`{how['command']}`, about {how['minutes of one core']:.0f} minutes of one core; {how['samples']} samples, "
        f"{how['scenarios to tune in']} scenarios to tune in, {how['scenarios to measure in']} others to measure in; "
        f"Python {how['python']}, NumPy {how['numpy']}, {how['machine']}."
    )


def unmeasured(cells: Cells, methods: list[str]) -> list[str]:
    """What a run that was cut short has not come to."""
    missing = {name: sum(name not in cell for cell in cells.values()) for name in methods}
    told = ", ".join(f"{name} in {count} of {len(cells)} cells" for name, count in missing.items() if count)
    return [f"Not measured: {told}."] if told else []


def best_rival(cell: dict[str, dict[float, Moves]], ratio: float = RATIO) -> tuple[str, Moves]:
    rivals = {
        name: found[ratio] for name, found in cell.items() if name not in (*OURS, *UNDER_RULES, *LIMITS)
    }
    name = min(rivals, key=lambda name: rivals[name].value)
    return name, rivals[name]


def factor(own: Moves, other: Moves) -> tuple[float, float]:
    """One over the other, and the standard error of its logarithm."""
    if not np.isfinite(own.value):
        return np.inf, 0.0
    return own.value / other.value, float(np.hypot(own.error / own.value, other.error / other.value))


def mean(values: list[float]) -> str:
    reached = [value for value in values if np.isfinite(value)]
    number = f"{np.exp(np.log(reached).mean()):.1f}" if reached else "-"
    return number if len(reached) == len(values) else f"{number} ({len(reached)} of {len(values)})"


def standing(cells: Cells, methods: list[str]) -> str:
    """Wins, ties and losses of ours, in words."""
    lines = []
    for name in [name for name in OURS if name in methods]:
        factors = [factor(cell[name][RATIO], best_rival(cell)[1]) for cell in cells.values() if name in cell]
        fewer = sum(f < 1 and np.log(f) < -SURE * e for f, e in factors)
        more = sum(f > 1 and (np.isinf(f) or np.log(f) > SURE * e) for f, e in factors)
        never = sum(np.isinf(f) for f, _ in factors)
        reached = [f for f, _ in factors if np.isfinite(f)]
        text = (
            f"**{name}**: {np.exp(np.log(reached).mean()):.2f} times the moves of the best rival of each cell, "
            f"geometric mean over {len(reached)} cells; fewer moves in {fewer}, more in {more}, and "
            f"{len(factors) - fewer - more} that are closer than {SURE:g} standard errors."
        )
        lines.append(text + (f" Never within the error in {never}." if never else ""))
    return "\n\n".join([f"At {RATIO:g} times plain MPC's error:", *lines])


def under_rules(cells: Cells) -> list[str]:
    """What the load bank gives under simple rules, and what plans add to that."""
    whole = [cell for cell in cells.values() if all(name in cell for name in (*UNDER_RULES, OURS[0]))]
    if not whole:
        return []
    alone = []
    for name in UNDER_RULES:
        usual = name.removesuffix(", load bank")
        ratio = [factor(cell[name][RATIO], cell[usual][RATIO])[0] for cell in whole if usual in cell]
        alone.append(
            f"{np.exp(np.log(ratio).mean()):.2f} times the moves of {usual} with the best of three filters"
        )
    best = [min((cell[name][RATIO] for name in UNDER_RULES), key=lambda moves: moves.value) for cell in whole]
    factors = [factor(cell[OURS[0]][RATIO], rule) for cell, rule in zip(whole, best, strict=True)]
    fewer = sum(np.log(f) < -SURE * e for f, e in factors)
    more = sum(np.isinf(f) or np.log(f) > SURE * e for f, e in factors)
    mean = np.exp(np.mean([np.log(f) for f, _ in factors if np.isfinite(f)]))
    return [
        f"**The load bank under simple rules**, around plain MPC: {' and '.join(alone)}. {OURS[0]} makes {mean:.2f} "
        f"times the moves of the better of these two in each cell: fewer in {fewer} and more in {more} of "
        f"{len(factors)}, beyond {SURE:g} standard errors."
    ]


def by_load(cells: Cells, methods: list[str]) -> str:
    kinds = list(dict.fromkeys(load for _, load in cells))
    lines = [
        f"Moves in percent of plain MPC's at {RATIO:g} times its error, geometric mean over the plants where it is "
        "reached (how many, where not all).",
        "",
        "| method | " + " | ".join(kinds) + " | all |",
        "|---|" + "---|" * (len(kinds) + 1),
    ]
    for method in methods:
        groups = [[c for (_, load), c in cells.items() if kind in (None, load)] for kind in [*kinds, None]]
        row = [
            mean([c[method][RATIO].value for c in group]) if all(method in c for c in group) else ""
            for group in groups
        ]
        if any(row):
            lines.append("| " + " | ".join([method, *row]) + " |")
    return "\n".join(lines)


def by_ratio(cells: Cells, methods: list[str]) -> str:
    """At other errors, over all plants and loads."""
    lines = [
        "The same over all plants and loads, at other errors. The values of the knobs lie about those for "
        f"{RATIO:g} times plain MPC's error, so that smaller errors may lie outside (in how many cells they do not).",
        "",
        "| method | " + " | ".join(f"{ratio:g} x MPC's error" for ratio in RATIOS) + " |",
        "|---|" + "---|" * len(RATIOS),
    ]
    for method in [name for name in methods if all(name in cell for cell in cells.values())]:
        row = [mean([c[method][ratio].value for c in cells.values()]) for ratio in RATIOS]
        lines.append("| " + " | ".join([method, *row]) + " |")
    return "\n".join(lines)


def in_one_setting(cells: Cells, alike: Cells) -> list[str]:
    """Ours with one structure everywhere over rivals with one everywhere, and over the best tuned per cell."""
    methods = [
        name for name in alike.get(next(iter(cells)), {}) if all(name in alike.get(w, {}) for w in cells)
    ]
    if OURS[0] not in methods:
        return []
    kinds = list(dict.fromkeys(load for _, load in cells))

    def row(name: str, other: Callable[[tuple[str, str]], Moves]) -> str:
        own = {where: factor(alike[where][OURS[0]][RATIO], other(where)) for where in cells}
        texts = []
        for kind in [*kinds, None]:
            factors = [f for (_, load), (f, _) in own.items() if kind in (None, load)]
            reached = [f for f in factors if 0 < f < np.inf]
            text = f"{np.exp(np.log(reached).mean()):.2f}" if reached else "-"
            texts.append(
                text if len(reached) == len(factors) else f"{text} ({len(reached)} of {len(factors)})"
            )
        fewer = sum(f < 1 and np.log(max(f, 1e-9)) < -SURE * e for f, e in own.values())
        more = sum(np.isinf(f) or (f > 1 and np.log(f) > SURE * e) for f, e in own.values())
        return "| " + " | ".join([name, *texts, f"{fewer} / {more}"]) + " |"

    rows = [row(f"{name}, in one setting", lambda w, n=name: alike[w][n][RATIO]) for name in methods[1:]]
    return ["\n".join([
        f"**In one setting.** Here every method has the one structure that moved least in the tuning over all plants "
        f"and loads, and only the knob is found for each. Moves of {OURS[0]} at {RATIO:g} times plain MPC's error over "
        f"those of others, geometric mean over the plants, and in how many cells they are fewer / more by more than "
        f"{SURE:g} standard errors:",
        "",
        "| over | " + " | ".join(kinds) + " | all | fewer / more |",
        "|---|" + "---|" * (len(kinds) + 2),
        *rows,
        row("the best rival of each cell, its structure tuned there", lambda w: best_rival(cells[w])[1]),
    ])]  # fmt: skip


def losses(cells: Cells, methods: list[str]) -> str:
    """Where ours makes more moves than a rival, and than which."""
    ours = next(name for name in OURS if name in methods)
    found, closer = [], []
    for (plant, load), cell in cells.items():
        if ours not in cell:
            continue
        rival, moves = best_rival(cell)
        ratio, error = factor(cell[ours][RATIO], moves)
        if np.isinf(ratio):
            found.append(
                (ratio, f"- {plant}, {load}: never within the error, which {rival} is with {moves} %")
            )
        elif np.log(ratio) > SURE * error:
            found.append((ratio, f"- {plant}, {load}: {ratio:.2f} times the moves of {rival}"))
        elif ratio > 1:
            closer.append(f"{plant}, {load} ({ratio:.2f}, {rival})")
    found.sort(key=lambda one: -one[0])
    if not found:
        return f"In no cell does a rival make fewer moves than {ours} by more than {SURE:g} standard errors."
    head = f"Where we lose, {ours} against the best rival, by more than {SURE:g} standard errors:"
    lines = [head, "", *(line for _, line in found)]
    if closer:
        lines += ["", f"A rival is ahead by less than that, and may not be, in {'; '.join(closer)}."]
    return "\n".join(lines)


def by_cell(cells: Cells, methods: list[str]) -> str:
    lines = [
        f"Each plant and load at {RATIO:g} times plain MPC's error, in percent of its moves, with the standard error; "
        "the fewest moves are in bold.",
        "",
        "| plant | load | " + " | ".join(methods) + " |",
        "|---|---|" + "---|" * len(methods),
    ]
    for (plant, load), cell in cells.items():
        least = min(cell[method][RATIO].value for method in methods if method in cell)
        row = [plant, load]
        for method in methods:
            moves = cell[method][RATIO] if method in cell else None
            text = "" if moves is None else str(moves)
            row.append(f"**{text}**" if moves is not None and moves.value == least < np.inf else text)
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def limits(cells: Cells) -> str:
    """What no controller can have, beside ours."""
    ours = next(name for name in OURS if any(name in cell for cell in cells.values()))
    names = (ours, *LIMITS)
    both = [cell for cell in cells.values() if all(name in cell for name in names[:2])]
    pairs = [(cell[ours][RATIO].value, cell[LIMITS[0]][RATIO].value) for cell in both]
    pairs = [pair for pair in pairs if np.isfinite(sum(pair))]
    ratio = np.exp(np.mean([np.log(own / limit) for own, limit in pairs]))
    lines = [
        f"{ours} makes {ratio:.1f} times the moves of the non-anticipative, geometric mean over {len(pairs)} cells.",
        "",
        f"The two limits at {RATIO:g} times plain MPC's error, in percent of its moves, in four scenarios. Where a "
        "controller made fewer moves in these than the search found, its moves are the limit.",
        "",
        "| plant | load | " + " | ".join(names) + " |",
        "|---|---|" + "---|" * len(names),
    ]
    for (plant, load), cell in cells.items():
        if any(name in cell for name in LIMITS):
            row = [str(cell[name][RATIO]) if name in cell else "" for name in names]
            lines.append("| " + " | ".join([plant, load, *row]) + " |")
    return "\n".join(lines)


def draw(cells: Cells, methods: list[str]) -> None:
    """Ours against the best rival of each cell: below one is fewer moves."""
    from matplotlib.figure import Figure

    from mampc.base.drawing import styled

    plants = list(dict.fromkeys(plant for plant, _ in cells))
    kinds = list(dict.fromkeys(load for _, load in cells))
    shown = [name for name in OURS if name in methods]
    with styled():
        figure = Figure(figsize=(9.0, 3.6), layout="constrained")
        panels = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
        for panel, name in zip(panels, shown, strict=True):
            ratio = np.full((len(plants), len(kinds)), np.nan)
            for (plant, load), cell in cells.items():
                if name in cell:
                    value, _ = factor(cell[name][RATIO], best_rival(cell)[1])
                    ratio[plants.index(plant), kinds.index(load)] = value
            image = np.log2(np.clip(ratio, 0.25, 4.0))
            panel.imshow(image, cmap="PuOr_r", vmin=-2, vmax=2, aspect="auto")
            for (i, j), value in np.ndenumerate(ratio):
                text = "" if np.isnan(value) else "never" if np.isinf(value) else f"{value:.2f}"
                dark = not -1.0 < image[i, j] < 1.6
                panel.text(
                    j, i, text, ha="center", va="center", fontsize=8, color="white" if dark else "black"
                )
            panel.set_xticks(range(len(kinds)), kinds, rotation=20)
            panel.set_yticks(range(len(plants)), plants)
            panel.tick_params(length=0)
            panel.set_title(name, fontsize=9)
            panel.grid(False)
            for side in panel.spines.values():
                side.set_visible(False)
        figure.suptitle(
            f"Moves over those of the best rival at {RATIO:g} times plain MPC's error: violet is fewer, orange is more",
            fontsize=9,
        )
        figure.savefig(DOCS / "images" / "attention.svg", metadata={"Date": None})
