"""The heat map and the tables of docs/comparison.md, from the results of the attention benchmark."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parent.parent / "docs"
RATIO = "1.25"
BEGIN, END = "<!-- attention, by `make attention` -->", "<!-- end of attention -->"
OURS = "exact price"


def write(results: Path) -> None:
    content = json.loads(results.read_text(encoding="utf-8"))
    cells = content["cells"]
    methods = [name for name in cells[0] if name not in ("plant", "load", "moves of MPC")]
    methods.sort(key=lambda name: name != OURS)
    page = DOCS / "comparison.md"
    text = page.read_text(encoding="utf-8")
    start, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    figure = "![Moves of the exact price over those of the best rival](images/attention.svg)"
    body = "\n\n".join(
        [figure, made_by(content["made by"]), by_load(cells, methods), by_cell(cells, methods)]
    )
    page.write_text(f"{text[:start]}\n\n{body}\n\n{text[end:]}", encoding="utf-8")
    draw(cells, methods)


def made_by(how: dict) -> str:
    return (
        f"`{how['command']}`, {how['minutes']:g} minutes; {how['steps']} samples, {how['tuning seeds']} seeds to "
        f"tune on, {how['evaluation seeds']} others to measure on; Python {how['python']}, NumPy {how['numpy']}, "
        f"{how['machine']}."
    )


def share(cell: dict, method: str) -> float:
    """Moves in percent of plain MPC's; infinite where the error is never reached."""
    value = cell[method][RATIO][0]
    return 100 * value if value is not None and np.isfinite(value) else np.inf


def by_load(cells: list[dict], methods: list[str]) -> str:
    """Geometric means over plants, and how often the error is reached."""
    kinds = list(dict.fromkeys(cell["load"] for cell in cells))
    lines = [
        "Moves in percent of plain MPC's at 1.25 times its error, geometric mean over the plants where it is reached "
        "(how many, where not all).",
        "",
        "| method | " + " | ".join(kinds) + " | all |",
        "|---|" + "---|" * (len(kinds) + 1),
    ]
    for method in methods:
        row = [method]
        for kind in [*kinds, None]:
            values = np.array([share(c, method) for c in cells if kind in (None, c["load"])])
            reached = values[np.isfinite(values)]
            mean = f"{np.exp(np.log(reached).mean()):.1f}" if len(reached) else "-"
            row.append(mean if len(reached) == len(values) else f"{mean} ({len(reached)} of {len(values)})")
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def by_cell(cells: list[dict], methods: list[str]) -> str:
    """Every cell, with standard errors, the fewest in bold."""
    lines = [
        "Each plant and load, with the standard error; the fewest moves are in bold.",
        "",
        "| plant | load | " + " | ".join(methods) + " |",
        "|---|---|" + "---|" * len(methods),
    ]
    for cell in cells:
        values = [share(cell, method) for method in methods]
        row = [cell["plant"], cell["load"]]
        for method, value in zip(methods, values, strict=True):
            if not np.isfinite(value):
                row.append("not reached")
                continue
            error = cell[method][RATIO][1]
            shown = f"{value:.1f}" + (f" ± {100 * error:.1f}" if np.isfinite(error) else "")
            row.append(f"**{shown}**" if value == min(values) else shown)
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def draw(cells: list[dict], methods: list[str]) -> None:
    """Ours against the best rival of each cell: below one is fewer moves."""
    from mampc.loop.drawing import new_figure, styled

    plants = list(dict.fromkeys(cell["plant"] for cell in cells))
    kinds = list(dict.fromkeys(cell["load"] for cell in cells))
    ratio = np.full((len(plants), len(kinds)), np.nan)
    for cell in cells:
        best = min(share(cell, method) for method in methods if method != OURS)
        ratio[plants.index(cell["plant"]), kinds.index(cell["load"])] = share(cell, OURS) / best
    with styled():
        figure, [[panel]] = new_figure(height=3.2)
        image = np.log2(np.clip(ratio, 0.25, 4.0))
        panel.imshow(image, cmap="RdYlGn_r", vmin=-2, vmax=2, aspect="auto")
        for (i, j), value in np.ndenumerate(ratio):
            text = "never" if not np.isfinite(value) else f"{value:.2f}"
            panel.text(j, i, text, ha="center", va="center", fontsize=8)
        panel.set_xticks(range(len(kinds)), kinds)
        panel.set_yticks(range(len(plants)), plants)
        panel.set_title(
            "Moves of the exact price over those of the best rival, at 1.25 times plain MPC's error"
        )
        panel.grid(False)
        figure.savefig(DOCS / "images" / "attention.svg", metadata={"Date": None})
