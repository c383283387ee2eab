"""`mampc reproduce`: the paper's tables and figures beside ours, and what can honestly be said of them.

The page is made of blocks (text, tables, figures) from finished runs; every figure and every judgement on
it is computed from them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mampc.base.errors import MampcError
from mampc.base.workers import in_parallel
from mampc.compare.sensitivity import SETTINGS, Point, holding, sensitivity
from mampc.report.figures import sensitivity_figure, study_figures
from mampc.report.folder import ResultFolder
from mampc.report.output import StudyFiles
from mampc.report.page import Page
from mampc.report.summary import summarise
from mampc.report.tables import baseline
from mampc.study import Study, StudyResult, load_study, run_study
from mampc.study.schema import ControllerTable

SIGNIFICANT = 1.25  # an error above this multiple of plain MPC's is a significant loss; the paper names none
FIGURES = ("changes", "error")
SHARED_GRID: dict[str, list[float]] = {
    "move_weight": [0.01, 0.03, 0.1, 0.3, 1.0],
    "penalty": [1.0, 3.0, 10.0, 30.0, 100.0],
    "sparsity_horizon": [1, 3, 5],
    "max_moves": [1, 3, 5],
}
CASES: dict[str, dict[str, list[float]]] = {
    "quadruple-tank": SHARED_GRID
    | {"dt": [8.0, 10.0, 15.0], "noise": [0.0, 0.05, 0.1, 0.2], "reference": [0.25, 1.0, 4.0]},
    "sofc": SHARED_GRID
    | {"dt": [0.25, 0.5, 1.0], "noise": [0.0, 0.1, 0.2, 0.4], "reference": [0.25, 1.0, 2.0]},
}


@dataclass(frozen=True, eq=False)
class Case:
    """One case study: its runs, their summary, and how the last sparse controller's ratios move."""

    result: StudyResult
    summary: dict[str, Any]
    points: list[Point]

    @property
    def study(self) -> Study:
        return self.result.study


def reproduce(directory: Path, on_stage: Callable[[str], None] = lambda stage: None) -> list[Case]:
    """Run both case studies and their sensitivity, and write report.md, report.html and all results.

    Args:
        directory: receives the page and a folder for each case study.
        on_stage: called with a line of text when a stage begins.

    Raises:
        MampcError: the directory cannot be written, or matplotlib is missing.
    """
    from joblib import delayed

    folder = ResultFolder(directory, last="report.html")
    studies = [load_study(name) for name in CASES]
    on_stage("both case studies, noise-free and noisy")
    results = list(in_parallel((delayed(run_study)(study) for study in studies), -1))
    cases = []
    for result in results:
        study: Study = result.study
        points = sensitivity(
            study,
            study.scenarios[-1],
            _papers(study)[-1],
            CASES[study.name],
            on_point=_counted(study, on_stage),
        )
        cases.append(Case(result, summarise(result), points))
    folder.clear()
    page = Page("The paper's results beside ours")
    _introduce(page, cases)
    for case in cases:
        on_stage(f"{case.study.name}: figures")
        _write_case(page, case, folder)
        try:
            StudyFiles(folder, f"{case.study.name}/").page(case.result)
            page.text(
                f"The same runs with a slider along moves against error: {case.study.name}/report.html."
            )
        except MampcError as error:
            on_stage(f"no {case.study.name}/report.html written; {error}")
    _judge(page, cases)
    for ending, text in page.texts(directory):
        with folder.writing(f"report.{ending}") as unfinished:
            unfinished.write_text(text, encoding="utf-8")
    return cases


def _papers(study: Study) -> list[ControllerTable]:
    """The controllers that the paper has figures for."""
    return [table for table in study.controllers if table.published is not None]


def _counted(study: Study, on_stage: Callable[[str], None]) -> Callable[[int, int], None]:
    return lambda done, total: on_stage(f"{study.name}: sensitivity, {done} of {total} runs")


def _introduce(page: Page, cases: list[Case]) -> None:
    lengths = ", ".join(f"{case.study.name} {case.study.steps} x {case.study.dt:g} s" for case in cases)
    page.text(
        "Theertham, Varanasi and Jampana, *Minimum Attention Control (MAC) in a Receding Horizon Framework "
        f"with Applications*: both case studies run again ({lengths}), by the paper's alternating method, on "
        "nonlinear plants and identified models. The paper leaves out its references, lambda, mu, the "
        "stopping tolerance and the sample times; ours are those of the built-in studies. So absolute "
        "figures cannot be matched, and what is compared is each figure's ratio to plain MPC in the same run."
    )


def _write_case(page: Page, case: Case, folder: ResultFolder) -> None:
    name = case.study.name
    files = StudyFiles(folder, f"{name}/")
    files.model(case.result)
    for scenario, runs in case.result.runs.items():
        for controller, run in runs.items():
            files.trajectory(scenario, controller, run)
    files.summary(case.result)
    page.heading(f"Case study: {name}")
    identified = case.result.identified
    assert identified is not None
    fits = ", ".join(f"{fit:.1f} %" for fit in identified.fit)
    page.text(f"Identified model: order {identified.order}, fit {fits} (simulated, own record).")
    for warning in case.result.warnings:
        page.text(f"**Warning:** {warning}.")
    for part, title in _parts(case):
        page.text(
            f"**{title}**: density of changes above {case.study.threshold:g} per input, tracking error, and "
            "the ratios of both to MPC."
        )
        page.table(*_table(case, part))
    for drawing in study_figures(case.result):
        page.figure(files.figure(drawing.name, drawing.figure), drawing.caption)
    page.heading(f"Sensitivity: {name}", 3)
    page.text(
        f"{_papers(case.study)[-1].name} in the {case.study.scenarios[-1].name} scenario, one setting "
        "changed at a time; ratios to MPC with the same setting."
    )
    figure = sensitivity_figure(case.points, SETTINGS)
    page.figure(
        files.figure("sensitivity", figure), "Moves and error as ratios to plain MPC, as one setting changes."
    )
    rows = [
        [SETTINGS[point.setting], f"{point.value:g}", _text(point.changes_ratio), _text(point.error_ratio)]
        for point in case.points
    ]
    page.table(["setting", "value", "changes / MPC", "error / MPC"], rows)


def _parts(case: Case) -> list[tuple[str | None, str]]:
    """Where the figures of the full run and of the run without its transient stand, and what they are."""
    return [(None, "all samples"), ("without_transient", f"without the first {case.study.skip} samples")]


class Figures(NamedTuple):
    """Density per input and tracking error, and the ratios of both to MPC."""

    density: list[float]
    error: float
    changes_ratio: float | None
    error_ratio: float | None

    def ratio(self, figure: str) -> float | None:
        return self.changes_ratio if figure == "changes" else self.error_ratio


def _table(case: Case, part: str | None) -> tuple[list[str], list[list[str]]]:
    scenarios = [scenario.name for scenario in case.study.scenarios]
    header = ["controller"]
    for source in ("paper", *(f"ours, {name}" for name in scenarios)):
        header += [f"{source}: density", "error", "changes / MPC", "error / MPC"]
    rows = []
    for controller in _papers(case.study):
        row = [controller.name]
        for scenario in (None, *scenarios):
            figures = _figures(case, controller, part, scenario)
            row += [" ".join(f"{d:.3f}" for d in figures.density), f"{figures.error:.3f}"]
            row += [_text(figures.changes_ratio), _text(figures.error_ratio)]
        rows.append(row)
    return header, rows


def _figures(case: Case, controller: ControllerTable, part: str | None, scenario: str | None) -> Figures:
    """The figures of the paper (scenario None) or ours."""
    densities, errors = [], []
    for table in (controller, baseline(case.study)):
        if scenario is None:
            published = table.published
            if part is not None and published is not None:
                published = published.without_transient
            assert published is not None
            densities.append(published.sparse_density)
            errors.append(published.tracking_error)
        else:
            entry = _entry(case, table.name, part, scenario)
            densities.append(entry["sparse_density"]["per_input"])
            errors.append(entry["tracking_error"])
    return Figures(
        densities[0], errors[0], _ratio(sum(densities[0]), sum(densities[1])), _ratio(errors[0], errors[1])
    )


def _entry(case: Case, controller: str, part: str | None, scenario: str) -> dict[str, Any]:
    runs = next(entry["controllers"] for entry in case.summary["scenarios"] if entry["name"] == scenario)
    entry: dict[str, Any] = next(entry for entry in runs if entry["name"] == controller)
    return entry if part is None else entry[part]


def _judge(page: Page, cases: list[Case]) -> None:
    page.heading("Where our figures agree with the paper in direction, and where they do not")
    page.text(
        "A ratio agrees in direction if it lies on the same side of 1 as the paper's. Where it does not, the "
        "settings are named at which the sensitivity run crosses over."
    )
    rows, agreed, total = [], 0, 0
    for case in cases:
        for (part, samples), controller, figure in product(_parts(case), _papers(case.study), FIGURES):
            if controller == baseline(case.study):
                continue
            paper = _figures(case, controller, part, None).ratio(figure)
            ours = [_figures(case, controller, part, s.name).ratio(figure) for s in case.study.scenarios]
            same = [_same_side(paper, ratio) for ratio in ours]
            agreed, total = agreed + sum(same), total + len(same)
            judgement = "agrees" if all(same) else _disagreement(case, figure, paper, same)
            both = " / ".join(_text(ratio) for ratio in ours)
            rows.append([case.study.name, samples, controller.name, figure, _text(paper), both, judgement])
    names = " / ".join(scenario.name for scenario in cases[0].study.scenarios)
    page.text(f"{agreed} of {total} ratios agree in direction (ours: {names}).")
    page.table(["case", "samples", "controller", "figure", "paper", "ours", "judgement"], rows)

    page.heading("Where the paper's claim holds")
    page.text(
        "The claim is fewer moves without significant loss in tracking. The paper gives no limit of "
        f"significance; here a loss is significant if the error is above {SIGNIFICANT:g} times plain MPC's."
    )
    regions = [row for case in cases for row in _region(case)]
    page.table(["case", "setting", "holds at", "does not hold at"], regions)
    for case in cases:
        kept = list(holding(case.points, SIGNIFICANT))
        changes = _span([point.changes_ratio for point in case.points])
        errors = _span([point.error_ratio for point in case.points])
        page.text(
            f"**{case.study.name}**: the claim holds at {len(kept)} of {len(case.points)} settings tried; "
            f"over all of them changes are {changes} and errors {errors} times those of MPC."
        )


def _same_side(paper: float | None, ratio: float | None) -> bool:
    """Whether a ratio lies on the same side of 1 as the paper's."""
    return paper is not None and ratio is not None and (ratio < 1) == (paper < 1)


def _disagreement(case: Case, figure: str, paper: float | None, same: list[bool]) -> str:
    """Which scenario does not agree, and which settings would turn the sparse controller's ratio over."""
    names = [s.name for s, agrees in zip(case.study.scenarios, same, strict=True) if not agrees]
    crossing = [
        f"{SETTINGS[point.setting]} = {point.value:g}"
        for point in case.points
        if _same_side(paper, point.changes_ratio if figure == "changes" else point.error_ratio)
    ]
    cause = f"crosses over at {', '.join(crossing)}" if crossing else "no setting tried crosses over"
    return f"does not agree ({', '.join(names)}); {cause}"


def _region(case: Case) -> list[list[str]]:
    kept = set(holding(case.points, SIGNIFICANT))
    rows = []
    for setting in dict.fromkeys(point.setting for point in case.points):
        own = [point for point in case.points if point.setting == setting]
        inside = [f"{p.value:g}" for p in own if p in kept]
        outside = [f"{p.value:g}" for p in own if p not in kept]
        rows.append([case.study.name, SETTINGS[setting], ", ".join(inside) or "-", ", ".join(outside) or "-"])
    return rows


def _ratio(value: float, base: float) -> float | None:
    return value / base if base > 0 else None


def _text(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio:.2f}"


def _span(ratios: list[float | None]) -> str:
    numbers = [ratio for ratio in ratios if ratio is not None]
    return f"{np.min(numbers):.2f} to {np.max(numbers):.2f}" if numbers else "not known"
