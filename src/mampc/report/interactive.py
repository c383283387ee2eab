"""report.html of a study: one page that can be mailed, with its script, its data and no need of a network.

The page says in words what a controller saves, and its trajectories change with a slider along the trade-off.
All numbers and sentences are made here; the script in `web/` only shows them.
"""

from __future__ import annotations

import html
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.drawing import time_scale
from mampc.base.errors import MampcError, listed
from mampc.loop.drawing import near_limits
from mampc.loop.metrics import Metrics
from mampc.loop.run import Run
from mampc.report.figures import result_looks
from mampc.report.tables import baseline, has_zones
from mampc.study import StudyResult
from mampc.study.schema import Study

DAY = 86400.0  # seconds
MOST_NUMBERS = 100_000  # in the trajectories of a page, which keeps it below 6 MB
_WEAR = ("input", "moves a day", "held for, on average", "travel a day")
_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:">
<title>{title}</title>
<style>
{style}
</style>
</head>
<body>
<h1>{title}</h1>
<p class="note">{subtitle}</p>
{warnings}
<h2>Moves against error</h2>
<fieldset id="scenarios"></fieldset>
<p id="sentence" aria-live="polite">{sentence}</p>
<div id="tradeoff"></div>
<p class="note">{means}</p>
<div class="slider"><span>fewest moves</span>
<input id="slider" type="range" min="0" max="0" step="1" aria-label="controller, from fewest moves to most">
<span>most moves</span></div>
<p class="note screen">Move the slider, or click a point: everything below changes with it. The best points are
joined; to the left are fewer moves, further down is a smaller error.</p>
<h2>Outputs and inputs</h2>
<div id="signals"></div>
<p class="note">{shown}<span class="screen"> Drag to zoom, double click to zoom out.</span></p>
<h2>What it means for the actuators</h2>
<div class="wide"><table id="wear"><thead><tr>{wear}</tr></thead><tbody></tbody></table></div>
<p class="note">{rate}</p>
<h2>All controllers</h2>
{tables}
{statuses}
<h2>Settings</h2>
<p class="note">What the study's file says; everything else has its default.</p>
<pre>{settings}</pre>
<noscript><p class="warnings">The figures need JavaScript.</p></noscript>
<script id="content" type="application/json">{content}</script>
<script>{plotly}</script>
<script>{script}</script>
</body>
</html>
"""


@dataclass(frozen=True)
class Means:
    """What a page says of moves and error where single runs would mislead: means over runs under many seeds.

    Attributes:
        study: whose settings the page tells.
        points: scenario -> controller -> moves a day and tracking error.
        group: controller -> what it is a setting of; none for the baseline.
        first: scenario -> the controller that is shown first.
        told: what they are means over, a sentence.
        note: on controllers without a setting on the page, sentences.
    """

    study: Study
    points: Mapping[str, Mapping[str, tuple[float, float]]]
    group: Mapping[str, str]
    first: Mapping[str, str]
    told: str
    note: str = ""


def interactive_page(result: StudyResult, means: Means | None = None) -> str:
    """The text of report.html, of single runs, or of settings with the means of many.

    Raises:
        MampcError: plotly is missing.
    """
    study, web = result.study, files("mampc.report").joinpath("web")
    kind = "controllers" if means is None else "settings"
    plotly = _plotly()
    content, step = _content(result, means)
    seconds = study.steps * study.dt
    first = content["scenarios"][0]
    identified = result.identified
    names = next(iter(next(iter(result.runs.values())).values())).names
    fits = [] if identified is None else zip(identified.fit, names.outputs, strict=True)
    fit = " and ".join(f"{share:.0f} % of {name}" for share, name in fits)
    shown = "Outputs are the true ones, without measurement noise."
    if any(panel["limits"] for scenario in content["scenarios"] for panel in scenario["panels"]):
        shown += " Dotted lines are limits."
    if any(zone for scenario in content["scenarios"] for zone in scenario["zones"]):
        shown += " Grey bands are zones, within which an output costs nothing."
    if step > 1:
        shown += f" Of every {step} samples the smallest and the largest value are shown."
    parts = {
        "title": f"{study.name}: fewer moves, and what they cost",
        "means": "" if means is None else f"{means.told} {means.note}".strip(),
        "subtitle": f"{len(study.controllers)} {kind} on {listed(names.inputs)} and {listed(names.outputs)}, "
        f"{study.steps} samples of {_duration(study.dt)}. The model has {result.model.n_states} states"
        + (f" and explains {fit} in the record it comes from." if fit else "."),
        "sentence": first["choices"][first["first"]]["sentence"],
        "shown": shown,
        "rate": f"Moves above {study.threshold:g}, but all of them in the travel. The run lasts {_duration(seconds)}; "
        "a day is counted at its rate, steps of the reference included."
        + (" Errors are squared distances from the zones." if has_zones(study) else ""),
    }
    text = {name: html.escape(part) for name, part in parts.items()}
    return _PAGE.format(
        **text,
        style=web.joinpath("report.css").read_text(encoding="utf-8"),
        script=web.joinpath("report.js").read_text(encoding="utf-8"),
        plotly=plotly,
        content=json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        warnings=_warnings(result),
        wear="".join(f"<th>{cell}</th>" for cell in _WEAR),
        tables=_tables(result, content),
        statuses=_statuses(result),
        settings=html.escape("\n".join(_settings(study if means is None else means.study))),
    )


def _plotly() -> str:
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise MampcError("it needs plotly: pip install 'mampc[report]'") from None
    script: str = get_plotlyjs()
    return script.replace("</script", "<\\/script")


def _content(result: StudyResult, means: Means | None) -> tuple[dict[str, Any], int]:
    """What the script shows, and how many samples stand behind each one shown."""
    study = result.study
    first = next(iter(next(iter(result.runs.values())).values()))
    scale, unit = time_scale(first.t)
    signals = len(first.names.outputs + first.names.inputs)
    lines = sum(signals * len(runs) + 2 * len(first.names.outputs) for runs in result.runs.values())
    step = -(-len(first.t) // max(MOST_NUMBERS // lines // 2, 1))
    step = 1 if step <= 2 else step
    favourite = [*result_looks(result), ""][1] if means is None else ""
    scenarios = [
        _scenario(study, name, runs, means.first[name] if means else favourite, scale, step, means)
        for name, runs in result.runs.items()
    ]
    content = {
        "x": f"moves a day above {study.threshold:g}" if means is None else "moves a day",
        "log": means is not None
        and all(x > 0 for points in means.points.values() for x, _ in points.values()),
        "y": f"{'squared distance outside, mean' if has_zones(study) else 'tracking error, mean |y − r|²'}",
        "unit": unit,
        "scenarios": scenarios,
    }
    return content, step


def _scenario(
    study: Study,
    name: str,
    runs: dict[str, Run],
    favourite: str,
    scale: float,
    step: int,
    means: Means | None,
) -> dict[str, Any]:
    metrics = {controller: run.metrics(threshold=study.threshold) for controller, run in runs.items()}
    points: Mapping[str, tuple[float, float]] = {
        c: (float(_a_day(m, study.dt).sum()), m.tracking_error) for c, m in metrics.items()
    }
    if means is not None:
        points = means.points[name]
    order = sorted(runs, key=lambda controller: (points[controller], controller))
    base = baseline(study).name
    first = runs[base]
    names = first.names
    panels, reference, zones = [], [], []
    for output, group in ((True, names.outputs), (False, names.inputs)):
        for i, signal in enumerate(group):
            data = [run.y[:, i] if output else run.u[:, i] for run in runs.values()]
            zone = _ends(first, i) if output else None
            asked = first.r[:, i] if output and zone is None else None
            data += [] if asked is None else [asked]
            low, high = min(float(d.min()) for d in data), max(float(d.max()) for d in data)
            margin = 0.06 * (high - low) or 0.01 * abs(high) or 1.0
            limits, told = near_limits(study.problem.limits, output, i, low - margin, high + margin)
            # Ends of a zone that are far away would flatten the data.
            near = [] if zone is None else zone[np.abs(zone - (low + high) / 2) <= high - low + 2 * margin]
            ends = [value + side for value in (low, high, *limits, *near) for side in (-margin, margin)]
            panels.append({
                "title": names.with_unit(signal) + told, "staircase": not output, "limits": limits,
                "range": [min(ends), max(ends)],
            })  # fmt: skip
            reference.append(None if asked is None else _thinned(asked, step))
            cut = None if zone is None else np.clip(zone, min(ends) - margin, max(ends) + margin)
            zones.append(None if cut is None else [_thinned(end, step) for end in cut])
    choices = []
    for controller in order:
        x, y = points[controller]
        better = any(a <= x and b <= y and (a, b) != (x, y) for a, b in points.values())
        run = runs[controller]
        choices.append({
            "name": controller, "x": x, "y": y, "best": not better,
            "group": "" if means is None else means.group.get(controller, ""),
            "sentence": _sentence(points, controller, base),
            "short": f"{_number(x)} moves a day, error {_number(y, 3)}",
            "wear": list(_wear(run, metrics[controller], study.dt)),
            "signals": [_thinned(column, step) for column in np.hstack([run.y, run.u]).T],
        })  # fmt: skip
    time = first.t / scale
    kept = time if step == 1 else np.repeat(time[::step], 2)
    return {
        "name": name, "base": order.index(base),
        "first": order.index(favourite) if favourite in order else order.index(base),
        "time": [float(f"{t:.8g}") for t in kept], "reference": reference, "zones": zones, "panels": panels,
        "choices": choices,
    }  # fmt: skip


def _ends(run: Run, i: int) -> Array | None:
    """The ends of an output's zone, shape (2, T); None where it has a set point."""
    zone = run.zone
    if zone is None or not (zone.high[:, i] > zone.low[:, i]).any():
        return None
    return np.array([zone.low[:, i], zone.high[:, i]])


def _thinned(values: Array, step: int) -> list[float]:
    """A signal as it is drawn: the smallest and largest of every `step` samples, to a ten-thousandth of its range."""
    if step > 1:
        rows = [values[i : i + step] for i in range(0, len(values), step)]
        values = np.array([end for row in rows for end in (row.min(), row.max())])
    spread = float(np.ptp(values)) or abs(float(values[0])) or 1.0
    return [round(float(value), 4 - int(np.floor(np.log10(spread)))) for value in values]


def _sentence(points: Mapping[str, tuple[float, float]], controller: str, base: str) -> str:
    """What a controller saves, and at what error."""
    (moves, own), (usual, other) = points[controller], points[base]
    if controller == base:
        return (
            f"{base}, which the others are compared with: {_number(usual)} moves a day, "
            f"tracking error {_number(own, 3)}."
        )
    error = (
        f"{own / other:.2f} times the tracking error of {base}"
        if other > 0
        else f"a tracking error of {_number(own, 3)}"
    )
    return f"{controller}: from {_number(usual)} moves a day to {_number(moves)}, with {error}."


def _a_day(metrics: Metrics, dt: float) -> Array:
    """Moves above the threshold per day and input."""
    moves: Array = metrics.sparse_density * (DAY / dt)
    return moves


def _wear(run: Run, metrics: Metrics, dt: float) -> Iterator[list[str]]:
    days = metrics.steps * dt / DAY
    for i, name in enumerate(run.names.inputs):
        yield [
            run.names.with_unit(name),
            _number(float(_a_day(metrics, dt)[i])),
            _duration(metrics.steps * dt / (round(float(metrics.sparse_density[i] * metrics.steps)) + 1)),
            _number(float(metrics.travel[i]) / days),
        ]


def _tables(result: StudyResult, content: dict[str, Any]) -> str:
    """A table a scenario: every controller, in the order of the slider."""
    base = baseline(result.study).name
    zones = has_zones(result.study)
    header = (
        "controller", "moves a day", "distance² outside" if zones else "tracking error", f"error / {base}",
        *(("time outside",) if zones else ()), "step, median", "proven best",
    )  # fmt: skip
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in header)
    tables = []
    for number, (scenario, runs) in enumerate(result.runs.items()):
        choices = content["scenarios"][number]["choices"]
        error = {choice["name"]: choice["y"] for choice in choices}
        rows = []
        for choice in choices:
            run = runs[choice["name"]]
            cells = (
                choice["name"], _number(choice["x"]), _number(choice["y"], 3),
                f"{choice['y'] / error[base]:.2f}" if error[base] > 0 else "-", *((_outside(run),) if zones else ()),
                f"{np.median(run.solve_times) * 1e6:.0f} µs", f"{100 * (run.gaps == 0).mean():.0f} %",
            )  # fmt: skip
            rows.append(f"<tr>{''.join(f'<td>{html.escape(cell)}</td>' for cell in cells)}</tr>")
        caption = f"<p class='note'>Scenario {html.escape(scenario)}</p>"
        table = f"<table data-scenario='{number}'><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
        tables.append(f"<div class='wide'>{caption}{table}</div>")
    return "\n".join(tables)


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


def _settings(study: Study) -> Iterator[str]:
    """What the study's file says, one key or one entry of a list a line."""
    for key, value in study.model_dump(exclude_unset=True, exclude={"place"}).items():
        if isinstance(value, list):
            yield from (f"{key}: {_inline(entry)}" for entry in value)
        else:
            yield f"{key}: {_inline(value)}"


def _inline(value: Any) -> str:
    """A value as it could stand in a study file."""
    if isinstance(value, dict):
        return ", ".join(f"{k} = {_nested(v)}" for k, v in value.items() if k != "published")
    return _nested(value)


def _nested(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{k} = {_nested(v)}' for k, v in value.items())} }}"
    if isinstance(value, list):
        return f"[{', '.join(map(_nested, value))}]"
    return json.dumps(value, ensure_ascii=False, default=str)


def _number(value: float, digits: int = 2) -> str:
    """A number to so many digits, with thin spaces between thousands."""
    if not np.isfinite(value) or 0 < abs(value) < 1e-3:
        return f"{value:.{digits}g}"
    rounded = float(f"{value:.{digits}g}")
    decimals = digits - 1 - int(np.floor(np.log10(abs(rounded)))) if rounded else 0
    return f"{rounded:,.{max(decimals, 0)}f}".replace(",", "\u202f")


def _duration(seconds: float) -> str:
    for unit, size in (("days", DAY), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{_number(seconds / size)}\u00a0{unit}"
    return f"{_number(seconds)}\u00a0s"
