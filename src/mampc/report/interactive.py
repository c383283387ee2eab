"""report.html of a study: one page that can be mailed, with its script, its data and no need of a network.

The page says in words what a controller saves, and its trajectories change with a slider along the trade-off.
All numbers and sentences are made here; the script in `web/` only shows them.
"""

from __future__ import annotations

import html
import json
from collections import Counter
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from mampc.base.errors import MampcError, listed
from mampc.loop.run import Run
from mampc.report.page_content import Means, number, page_content
from mampc.report.tables import baseline, error_label, has_zones
from mampc.study import StudyResult
from mampc.study.schema import Study
from mampc.study.writing import study_text
from mampc.systems.properties import time_in_words

_WEAR = ("input", "moves a day", "held for, on average", "travel a day")


def interactive_page(result: StudyResult, means: Means | None = None) -> str:
    """The text of report.html, of single runs, or of settings with the means of many.

    Raises:
        MampcError: plotly is missing.
    """
    web = files("mampc.report").joinpath("web")
    template, style, script = (
        web.joinpath(f"report.{ending}").read_text(encoding="utf-8") for ending in ("html", "css", "js")
    )
    plotly = _plotly()
    content, step = page_content(result, means)
    first = content["scenarios"][0]
    texts = {
        "title": f"{result.study.name}: fewer moves, and what they cost",
        "subtitle": _subtitle(result, "controllers" if means is None else "settings"),
        "means": "" if means is None else f"{means.told} {means.note}".strip(),
        "sentence": first["choices"][first["first"]]["sentence"],
        "shown": _shown(content, step),
        "rate": _rate(result.study),
        "settings": study_text(result.study if means is None else means.study),
    }
    return template.format(
        **{name: html.escape(text) for name, text in texts.items()},
        style=style,
        script=script,
        plotly=plotly,
        content=json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        warnings=_warnings(result),
        wear="".join(f"<th>{cell}</th>" for cell in _WEAR),
        tables=_tables(result, content),
        statuses=_statuses(result),
    )


def _subtitle(result: StudyResult, kind: str) -> str:
    """What was run, and how good the model is."""
    study, identified = result.study, result.identified
    names = next(iter(next(iter(result.runs.values())).values())).names
    fits = [] if identified is None else zip(identified.fit, names.outputs, strict=True)
    fit = " and ".join(f"{share:.0f}\u00a0% of {name}" for share, name in fits)
    return (
        f"{len(study.controllers)} {kind} on {listed(names.inputs)} and {listed(names.outputs)}, "
        f"{study.steps} samples of {time_in_words(study.dt)}. The model has {result.model.n_states} states"
        + (f" and explains {fit} in the record it comes from." if fit else ".")
    )


def _shown(content: dict[str, Any], step: int) -> str:
    """What the trajectories are."""
    panels = [panel for scenario in content["scenarios"] for panel in scenario["panels"]]
    shown = "Outputs are the true ones, without measurement noise."
    if any(panel["limits"] for panel in panels):
        shown += " Dotted lines are limits."
    if any(panel["zone"] for panel in panels):
        shown += " Grey bands are zones, within which an output costs nothing."
    if step > 1:
        shown += f" Of every {step} samples the smallest and the largest value are shown."
    return shown


def _rate(study: Study) -> str:
    """How moves a day are counted."""
    return (
        f"Moves above {study.threshold:g}, but all of them in the travel. The run lasts "
        f"{time_in_words(study.steps * study.dt)}; a day is counted at its rate, steps of the reference included."
        + (" Errors are squared distances from the zones." if has_zones(study) else "")
    )


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise MampcError("it needs plotly: pip install 'mampc[report]'") from None
    script: str = get_plotlyjs()
    return script.replace("</script", "<\\/script")


def _tables(result: StudyResult, content: dict[str, Any]) -> str:
    """A table a scenario: every controller, in the order of the slider."""
    base = baseline(result.study).name
    zones = has_zones(result.study)
    header = (
        "controller", "moves a day", error_label(zones, result.study.error_weight).split(",")[0], f"error / {base}",
        *(("time outside",) if zones else ()), "step, median", "proven best",
    )  # fmt: skip
    tables = []
    for place, (scenario, runs) in enumerate(result.runs.items()):
        choices = content["scenarios"][place]["choices"]
        error = {choice["name"]: choice["y"] for choice in choices}
        rows = []
        for choice in choices:
            run = runs[choice["name"]]
            cells = (
                choice["name"], number(choice["x"]), number(choice["y"], 3),
                f"{choice['y'] / error[base]:.2f}" if error[base] > 0 else "-", *((_outside(run),) if zones else ()),
                f"{np.median(run.solve_times) * 1e6:.0f} µs", f"{100 * (run.gaps == 0).mean():.0f} %",
            )  # fmt: skip
            rows.append(_row("td", cells))
        caption = f"<p class='note'>Scenario {html.escape(scenario)}</p>"
        body = f"<thead>{_row('th', header)}</thead><tbody>{''.join(rows)}</tbody>"
        tables.append(f"<div class='wide'>{caption}<table data-scenario='{place}'>{body}</table></div>")
    return "\n".join(tables)


def _row(kind: str, cells: Sequence[str]) -> str:
    """A row of the table of controllers; a telephone has no room for its last two columns."""
    marked = [" class='more'" if i >= len(cells) - 2 else "" for i in range(len(cells))]
    row = "".join(
        f"<{kind}{mark}>{html.escape(cell)}</{kind}>" for cell, mark in zip(cells, marked, strict=True)
    )
    return f"<tr>{row}</tr>"


def _outside(run: Run) -> str:
    """Shares of time outside its zone, one an output, a dash for set points."""
    shares = run.metrics().time_outside.tolist()
    return " ".join("-" if share != share else f"{100 * share:.0f} %" for share in shares)


def _statuses(result: StudyResult) -> str:
    """What the decisions said of themselves, in words."""
    counts = Counter(
        decision.status
        for runs in result.runs.values()
        for run in runs.values()
        for decision in run.decisions
    )
    lines = [f"{count} decisions: {status.sentence}" for status, count in counts.most_common()]
    return f"<ul class='note'>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>"


def _warnings(result: StudyResult) -> str:
    if not result.warnings:
        return ""
    lines = "".join(f"<li>{html.escape(warning)}</li>" for warning in result.warnings)
    return f"<div class='warnings'><strong>Warnings</strong><ul>{lines}</ul></div>"
