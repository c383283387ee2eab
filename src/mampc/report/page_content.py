"""What the script of report.html shows: moves, errors and trajectories of every controller, as plain data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mampc.base.checks import Array
from mampc.base.drawing import time_scale
from mampc.loop.drawing import near_limits
from mampc.loop.metrics import Metrics
from mampc.loop.run import Run
from mampc.report.figures import result_looks
from mampc.report.tables import baseline, error_label, has_zones
from mampc.study import StudyResult
from mampc.study.schema import Study
from mampc.systems.properties import time_in_words

DAY = 86400.0  # seconds
MOST_NUMBERS = 100_000  # in the trajectories of a page, which keeps it below 6 MB


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


def page_content(result: StudyResult, means: Means | None) -> tuple[dict[str, Any], int]:
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
        "y": error_label(has_zones(study), study.error_weight),
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
    metrics = {
        controller: run.metrics(threshold=study.threshold, output_weight=study.error_weight)
        for controller, run in runs.items()
    }
    points: Mapping[str, tuple[float, float]] = {
        c: (float(_a_day(m, study.dt).sum()), m.weighted_error) for c, m in metrics.items()
    }
    if means is not None:
        points = means.points[name]
    order = sorted(runs, key=lambda controller: (points[controller], controller))
    base = baseline(study).name
    time = runs[base].t / scale
    kept = time if step == 1 else np.repeat(time[::step], 2)
    choices = [
        {
            "name": controller, "x": points[controller][0], "y": points[controller][1],
            "best": _is_best(points[controller], points.values()),
            "group": "" if means is None else means.group.get(controller, ""),
            "sentence": _sentence(points, controller, base),
            "short": _short(*points[controller]),
            "wear": list(_wear(runs[controller], metrics[controller], study.dt)),
            "signals": [_thinned(column, step) for column in np.hstack([runs[controller].y, runs[controller].u]).T],
        }
        for controller in order
    ]  # fmt: skip
    panels = [
        _panel(study, runs, base, output, i, step)
        for output, count in ((True, len(runs[base].names.outputs)), (False, len(runs[base].names.inputs)))
        for i in range(count)
    ]
    return {
        "name": name, "base": order.index(base),
        "first": order.index(favourite) if favourite in order else order.index(base),
        "time": [float(f"{t:.8g}") for t in kept], "panels": panels, "choices": choices,
    }  # fmt: skip


def _is_best(point: tuple[float, float], points: Iterable[tuple[float, float]]) -> bool:
    """Whether no other has as few moves and as small an error."""
    x, y = point
    return not any(a <= x and b <= y and (a, b) != point for a, b in points)


def _panel(
    study: Study, runs: Mapping[str, Run], base: str, output: bool, i: int, step: int
) -> dict[str, Any]:
    """One signal's axis, with its limits, and the reference or the zone of an output."""
    first = runs[base]
    name = (first.names.outputs if output else first.names.inputs)[i]
    zone = _ends(first, i) if output else None
    reference = first.r[:, i] if output and zone is None else None
    data = [run.y[:, i] if output else run.u[:, i] for run in runs.values()]
    data += [] if reference is None else [reference]
    low, high = min(float(d.min()) for d in data), max(float(d.max()) for d in data)
    margin = 0.06 * (high - low) or 0.01 * abs(high) or 1.0
    limits, told = near_limits(study.problem.limits, output, i, low - margin, high + margin)
    # Ends of a zone that are far away would flatten the data.
    near = [] if zone is None else zone[np.abs(zone - (low + high) / 2) <= high - low + 2 * margin]
    ends = [value + side for value in (low, high, *limits, *near) for side in (-margin, margin)]
    bottom, top = min(ends), max(ends)
    cut = None if zone is None else np.clip(zone, bottom - margin, top + margin)
    return {
        "title": first.names.with_unit(name) + told, "staircase": not output, "limits": limits,
        "range": [bottom, top],
        "reference": None if reference is None else _thinned(reference, step),
        "zone": None if cut is None else [_thinned(end, step) for end in cut],
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


def _short(moves: float, error: float) -> str:
    return f"{number(moves)} moves a day, error {number(error, 3)}"


def _sentence(points: Mapping[str, tuple[float, float]], controller: str, base: str) -> str:
    """What a controller saves, and at what error."""
    (moves, own), (usual, other) = points[controller], points[base]
    if controller == base:
        return (
            f"{base}, which the others are compared with: {number(usual)} moves a day, "
            f"tracking error {number(own, 3)}."
        )
    error = (
        f"{own / other:.2f} times the tracking error of {base}"
        if other > 0
        else f"a tracking error of {number(own, 3)}"
    )
    return f"{controller}: from {number(usual)} moves a day to {number(moves)}, with {error}."


def _a_day(metrics: Metrics, dt: float) -> Array:
    """Moves above the threshold per day and input."""
    moves: Array = metrics.sparse_density * (DAY / dt)
    return moves


def _wear(run: Run, metrics: Metrics, dt: float) -> Iterator[list[str]]:
    days = metrics.steps * dt / DAY
    for i, name in enumerate(run.names.inputs):
        yield [
            run.names.with_unit(name),
            number(float(_a_day(metrics, dt)[i])),
            time_in_words(metrics.steps * dt / (round(float(metrics.sparse_density[i] * metrics.steps)) + 1)),
            number(float(metrics.travel[i]) / days),
        ]


def number(value: float, digits: int = 2) -> str:
    """A number to so many digits, with thin spaces between thousands."""
    if not np.isfinite(value) or 0 < abs(value) < 1e-3:
        return f"{value:.{digits}g}"
    rounded = float(f"{value:.{digits}g}")
    decimals = digits - 1 - int(np.floor(np.log10(abs(rounded)))) if rounded else 0
    return f"{rounded:,.{max(decimals, 0)}f}".replace(",", "\u202f")
