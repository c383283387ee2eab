"""Figures for a paper or a report: staircase inputs, outputs with references, excitation, validation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from mampc.base.checks import Array
from mampc.compare.sweep import Point
from mampc.identification import IOData, Validation
from mampc.loop.drawing import COLOURS, WIDE, label, new_figure, styled, time_scale
from mampc.loop.run import Run
from mampc.study import StudyResult
from mampc.study.schema import file_word

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_OF_EXCITATION = 400  # samples


def study_figures(result: StudyResult) -> Iterator[tuple[str, Figure]]:
    """File name and figure, one at a time, for everything a study has to show."""
    names = result.model.names
    if result.data is not None:
        yield "prbs-inputs", _record_figure(result.data, names.inputs, result.data.u, staircase=True)
        yield "prbs-outputs", _record_figure(result.data, names.outputs, result.data.y, staircase=False)
    for scenario, runs in result.runs.items():
        for i, name in enumerate(names.inputs):
            yield f"{file_word(scenario)}_{file_word(name)}", _comparison(runs, i, name, "input")
        for i, name in enumerate(names.outputs):
            yield f"{file_word(scenario)}_{file_word(name)}", _comparison(runs, i, name, "output")
        yield f"{file_word(scenario)}_moves-against-error", moves_against_error(runs, result.study.threshold)


def validation_figure(data: IOData, validation: Validation) -> Figure:
    """Measured and simulated outputs of a record the model has not seen."""
    l = data.y.shape[1]
    with styled():
        figure, axes = new_figure(l, 1, figsize=(6.5, 1.0 + 1.6 * l), sharex=True)
        time = np.arange(len(data)) * data.dt
        scale, unit = time_scale(time)
        for i, panel in enumerate(axes[:, 0]):
            panel.plot(time / scale, data.y[:, i], color=COLOURS[0], label="measured")
            panel.plot(time / scale, validation.y_hat[:, i], color=COLOURS[1], label="simulated by the model")
            panel.set_ylabel(label(data.names.outputs[i]))
            panel.set_title(f"fit {validation.fit[i]:.1f} %", loc="right")
        axes[0, 0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
        axes[-1, 0].set_xlabel(f"time ({unit}), hold-out part of the record")
    return figure


def _comparison(runs: dict[str, Run], i: int, name: str, kind: str) -> Figure:
    """One signal of several runs."""
    with styled():
        figure, [[panel]] = new_figure(figsize=WIDE)
        first = next(iter(runs.values()))
        scale, unit = time_scale(first.t)
        if kind == "output":
            panel.step(
                first.t / scale, first.r[:, i], where="post", color="black", linestyle="--", linewidth=1.0,
                label="reference",
            )  # fmt: skip
        for (controller, run), colour in zip(runs.items(), _colours(), strict=False):
            if kind == "input":
                panel.step(run.t / scale, run.u[:, i], where="post", color=colour, label=label(controller))
            else:
                panel.plot(run.t / scale, run.y[:, i], color=colour, label=label(controller))
        _label(panel, name, unit)
    return figure


def moves_against_error(runs: dict[str, Run], threshold: float) -> Figure:
    """Each controller as a point: how often its inputs change, and how well its outputs follow."""
    with styled():
        figure, [[panel]] = new_figure(figsize=(4.2, 3.2))
        for (controller, run), colour in zip(runs.items(), _colours(), strict=False):
            metrics = run.metrics(threshold=threshold)
            share = 100 * float(np.mean(metrics.sparse_density))
            panel.plot(share, metrics.tracking_error, "o", color=colour, markersize=7)
            panel.annotate(
                label(controller),
                (share, metrics.tracking_error),
                xytext=(6, 5),
                textcoords="offset points",
                fontsize=8,
            )
        panel.set_xlabel(f"samples at which an input changes by more than {threshold:g} (%)")
        panel.set_ylabel("tracking error")
        panel.margins(x=0.25, y=0.25)
        panel.set_xlim(left=0)
        panel.set_ylim(bottom=0)
    return figure


def sensitivity_figure(points: list[Point], settings: dict[str, str]) -> Figure:
    """Ratios to plain MPC as one setting changes at a time, a panel a setting."""
    shown = [setting for setting in settings if any(point.setting == setting for point in points)]
    columns = 4
    with styled():
        rows = -(-len(shown) // columns)
        figure, axes = new_figure(rows, columns, figsize=(9.0, 2.3 * rows), sharey=True)
        for panel in axes.flat[len(shown) :]:
            panel.set_visible(False)
        for setting, panel in zip(shown, axes.flat, strict=False):
            own = [point for point in points if point.setting == setting]
            values = [point.value for point in own]
            for ratios, name, colour in (
                ([point.changes_ratio for point in own], "changes / MPC", COLOURS[1]),
                ([point.error_ratio for point in own], "error / MPC", COLOURS[2]),
            ):
                heights = [np.nan if ratio is None else ratio for ratio in ratios]
                panel.plot(values, heights, "o-", color=colour, label=name)
            panel.axhline(1.0, color="black", linewidth=0.8, linestyle="--")
            if min(values) > 0 and max(values) / min(values) >= 50:
                panel.set_xscale("log")
            panel.set_xlabel(settings[setting])
        axes[0, 0].legend(loc="best")
    return figure


def _record_figure(data: IOData, names: tuple[str, ...], signals: Array, staircase: bool) -> Figure:
    """The first part of the record, one panel a signal."""
    shown = slice(0, SHOWN_OF_EXCITATION)
    time = np.arange(len(data))[shown] * data.dt
    scale, unit = time_scale(time)
    with styled():
        figure, axes = new_figure(len(names), 1, figsize=(6.5, 1.0 + 1.3 * len(names)), sharex=True)
        for i, panel in enumerate(axes[:, 0]):
            if staircase:
                panel.step(time / scale, signals[shown, i], where="post", color=COLOURS[1], linewidth=1.0)
            else:
                panel.plot(time / scale, signals[shown, i], color=COLOURS[1], linewidth=1.0)
            panel.set_ylabel(label(names[i]))
        axes[-1, 0].set_xlabel(f"time ({unit})")
    return figure


def _label(panel: Axes, name: str, unit: str) -> None:
    panel.set_xlabel(f"time ({unit})")
    panel.set_ylabel(label(name))
    panel.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, borderaxespad=0.2)


def _colours() -> Iterator[str]:
    while True:
        yield from COLOURS
