"""Figures for a paper or a report: closed loops, moves against error, excitation, validation, sensitivity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mampc.base.checks import Array
from mampc.base.drawing import (
    BLACK,
    BLUE,
    GREY,
    VERMILION,
    legend_above,
    new_figure,
    outline,
    plain,
    styled,
    time_scale,
)
from mampc.compare.sensitivity import Point
from mampc.identification import IOData, Validation
from mampc.loop.drawing import Look, looks, signals_figure
from mampc.loop.run import Run
from mampc.report.labels import label_points
from mampc.report.tables import baseline, error_label
from mampc.study import StudyResult
from mampc.study.values import file_word

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN_OF_EXCITATION = 400  # samples
OVERVIEW, TRADE = "overview", "moves-against-error"  # in names of files


class Drawing(NamedTuple):
    """A figure, the name of its file without ending, and what it shows in a sentence."""

    name: str
    caption: str
    figure: Figure


def study_figures(result: StudyResult) -> Iterator[Drawing]:
    """Everything a study has to show, one figure at a time."""
    if result.data is not None:
        yield from _excitation(result.data)
    look = result_looks(result)
    limits = result.study.problem.limits
    length = f"{result.study.steps} samples of {result.study.dt:g} s"
    for scenario, runs in result.runs.items():
        names = next(iter(runs.values())).names
        word, where = file_word(scenario), f"scenario {scenario}, {length}"
        of_signals = iter(file_words(names.outputs + names.inputs))
        yield Drawing(
            f"{word}_{OVERVIEW}",
            f"All outputs and inputs, {where}.",
            signals_figure(runs, look=look, limits=limits),
        )
        for kind, signals in (("Output", names.outputs), ("Input", names.inputs)):
            for name in signals:
                yield Drawing(
                    f"{word}_{next(of_signals)}",
                    f"{kind} {names.with_unit(name)}, {where}.",
                    signals_figure(runs, [name], look=look, limits=limits, height=1.9),
                )
        yield Drawing(
            f"{word}_{TRADE}",
            f"How often inputs move against how well outputs follow, {where}; best is down to the left.",
            moves_against_error(runs, result.study.threshold, look, result.study.error_weight),
        )


def file_words(names: Sequence[str]) -> list[str]:
    """Signals as they stand in the names of their figures, each once: a number tells those apart that look alike."""
    taken = Counter((OVERVIEW, TRADE))
    words = []
    for name in names:
        word = file_word(name)
        while taken[word]:
            taken[word] += 1
            word = f"{word}-{taken[word]}"
        taken[word] += 1
        words.append(word)
    return words


def result_looks(result: StudyResult) -> dict[str, Look]:
    """The look of each controller, the same in all figures: the baseline and the two best of the others stand out.

    The best have the smallest sum of moves and error, both as shares of the baseline's, over all scenarios.
    """
    base = baseline(result.study).name
    merit = dict.fromkeys(next(iter(result.runs.values())), 0.0)
    for runs in result.runs.values():
        metrics = {
            name: run.metrics(threshold=result.study.threshold, output_weight=result.study.error_weight)
            for name, run in runs.items()
        }
        for figures in (
            {name: float(m.sparse_density.sum()) for name, m in metrics.items()},
            {name: m.weighted_error for name, m in metrics.items()},
        ):
            unit = figures[base] or max(figures.values()) or 1.0
            for name in merit:
                merit[name] += figures[name] / unit
    others = sorted((name for name in merit if name != base), key=lambda name: merit[name])
    return looks(list(merit), [base, *others[:2]])


def moves_against_error(
    runs: Mapping[str, Run],
    threshold: float,
    look: Mapping[str, Look] | None = None,
    output_weight: Any = None,
) -> Figure:
    """Each controller as a point: how often its inputs move, and how well its outputs follow.

    The points bear names, or numbers and a legend where there is no room for names.

    Args:
        runs: controller -> run.
        threshold: changes above it count, in input units.
        look: controller -> how it is drawn; default by their order.
        output_weight: Q of the errors, where outputs weigh differently.
    """
    look = looks(list(runs), list(runs)[:3]) if look is None else look
    with styled():
        figure, [[panel]] = new_figure(height=2.8)
        points, markers = [], []
        for controller, run in runs.items():
            metrics = run.metrics(threshold=threshold, output_weight=output_weight)
            points.append((100 * float(np.mean(metrics.sparse_density)), metrics.weighted_error))
            style = look[controller]
            markers += panel.plot(*points[-1], "o", color=style.colour, markersize=7, zorder=style.order)
        panel.set_xlabel(f"samples with a move above {threshold:g}, mean of all inputs (%)")
        zones = any(run.zone is not None for run in runs.values())
        panel.set_ylabel(error_label(zones, output_weight))
        right, top = np.max(points, axis=0)
        panel.set_xlim(0, 1.2 * right or 1.0)
        panel.set_ylim(0, 1.2 * top or 1.0)
        front = [look[controller].order > 3 for controller in runs]
        if not label_points(panel, points, [plain(name, 28) for name in runs], front):
            numbers = [str(i + 1) for i in range(len(runs))]
            for marker, number, name in zip(markers, numbers, runs, strict=True):
                marker.set_label(plain(f"{number}  {name}"))
            legend_above(figure)
            label_points(panel, points, numbers, front)
    return figure


def validation_figure(data: IOData, validation: Validation) -> Figure:
    """Measured and simulated outputs of a record the model has not seen."""
    time = np.arange(len(data)) * data.dt
    scale, unit = time_scale(time)
    with styled():
        figure, axes = new_figure(data.y.shape[1], sharex=True)
        for i, panel in enumerate(axes[:, 0]):
            panel.plot(*outline(time / scale, data.y[:, i]), color=GREY, label="measured")
            simulated = outline(time / scale, validation.y_hat[:, i])
            panel.plot(*simulated, color=BLUE, label="simulated by the model")
            name = data.names.with_unit(data.names.outputs[i])
            panel.set_title(plain(f"{name}, fit {validation.fit[i]:.1f} %"))
        axes[-1, 0].set_xlabel(f"time ({unit}), hold-out part of the record")
        axes[-1, 0].set_xlim(0, time[-1] / scale or None)
        legend_above(figure)
    return figure


def sensitivity_figure(points: list[Point], settings: Mapping[str, str]) -> Figure:
    """Ratios to plain MPC as one setting changes at a time, a panel a setting."""
    shown = [setting for setting in settings if any(point.setting == setting for point in points)]
    columns = min(3, len(shown))
    with styled():
        figure, axes = new_figure(-(-len(shown) // columns), columns, sharey=True)
        for panel in axes.flat[len(shown) :]:
            panel.set_visible(False)
        for setting, panel in zip(shown, axes.flat, strict=False):
            own = [point for point in points if point.setting == setting]
            values = [point.value for point in own]
            for ratios, name, colour in (
                ([point.changes_ratio for point in own], "changes / MPC", BLUE),
                ([point.error_ratio for point in own], "error / MPC", VERMILION),
            ):
                heights = [np.nan if ratio is None else ratio for ratio in ratios]
                panel.plot(values, heights, "o-", color=colour, markersize=4, label=name)
            panel.axhline(1.0, color=BLACK, linewidth=0.8, linestyle="--", label="plain MPC")
            if min(values) > 0 and max(values) / min(values) >= 50:
                panel.set_xscale("log")
            panel.set_xticks(values, [f"{value:g}" for value in values])
            panel.minorticks_off()
            panel.set_title(plain(settings[setting], 28))
        legend_above(figure)
    return figure


def _excitation(data: IOData) -> Iterator[Drawing]:
    """The first part of the record that a model was identified from."""
    names = data.names
    for kind, signals, values in (
        ("inputs", names.inputs + names.disturbances, data.u),
        ("outputs", names.outputs, data.y),
    ):
        what = f"the first {SHOWN_OF_EXCITATION}" if len(data) > SHOWN_OF_EXCITATION else "all"
        yield Drawing(
            f"prbs-{kind}",
            f"The {kind} of the record that the model was identified from, {what} of its {len(data)} samples.",
            _record_figure(data, signals, values[:SHOWN_OF_EXCITATION], kind == "inputs"),
        )


def _record_figure(data: IOData, signals: tuple[str, ...], values: Array, staircase: bool) -> Figure:
    time = np.arange(len(values)) * data.dt
    scale, unit = time_scale(time)
    with styled():
        figure, axes = new_figure(len(signals), height=1.2, sharex=True)
        for name, column, panel in zip(signals, values.T, axes[:, 0], strict=True):
            panel.plot(
                time / scale,
                column,
                drawstyle="steps-post" if staircase else "default",
                color=BLUE,
                linewidth=1.0,
            )
            panel.set_title(plain(data.names.with_unit(name)))
        axes[-1, 0].set_xlabel(f"time ({unit})")
        axes[-1, 0].set_xlim(0, time[-1] / scale or None)
    return figure
