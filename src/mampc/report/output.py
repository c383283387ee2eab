"""Running a study and writing its results, each as soon as it is there."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mampc.base.drawing import styled
from mampc.base.errors import MampcError
from mampc.base.files import written_whole
from mampc.loop.run import Run
from mampc.report.figures import study_figures
from mampc.report.folder import ResultFolder
from mampc.report.interactive import interactive_page
from mampc.report.summary import summarise
from mampc.study import Study, StudyResult, run_study
from mampc.study.running import Prepared
from mampc.study.values import file_word

SUMMARY = "summary.json"
PAGE = "report.html"
FIGURE_KINDS = ("png", "svg")


class StudyFiles:
    """Puts the results of one study into a folder.

    Args:
        folder: receives them.
        prefix: of their names, such as "tank/"; default none.
    """

    def __init__(self, folder: ResultFolder, prefix: str = "") -> None:
        self._folder, self._prefix = folder, prefix

    def model(self, prepared: Prepared | StudyResult) -> None:
        """The model that all controllers use, and the record it was identified from."""
        prepared.model.save(self._folder.place(f"{self._prefix}model.json"))
        if prepared.data is not None:
            prepared.data.to_csv(self._folder.place(f"{self._prefix}identification.csv"))

    def trajectory(self, scenario: str, controller: str, run: Run) -> None:
        """One controller's run in one scenario."""
        run.to_csv(self._folder.place(f"{self._prefix}{trajectory_name(scenario, controller)}"))

    def figure(self, name: str, figure: Any) -> str:
        """A figure as PNG and SVG; returns the name of the latter in the folder."""
        stem = f"{self._prefix}figures/{name}"
        for kind in FIGURE_KINDS:
            self._folder.place(f"{stem}.{kind}")
        save_figure(figure, self._folder.path / stem)
        return f"{stem}.svg"

    def page(self, result: StudyResult) -> None:
        """report.html, which needs no other file; `MampcError` where plotly is missing."""
        text = interactive_page(result)
        with self._folder.writing(f"{self._prefix}{PAGE}") as unfinished:
            unfinished.write_text(text, encoding="utf-8")

    def summary(self, result: StudyResult) -> dict[str, Any]:
        """summary.json; returns its content."""
        summary = summarise(result)
        with written_whole(self._folder.place(f"{self._prefix}{SUMMARY}")) as unfinished:
            text = json.dumps(summary, indent=1, allow_nan=False)
            unfinished.write_text(text + "\n", encoding="utf-8")
        return summary


def run_and_write(
    study: Study, directory: Path, on_stage: Callable[[str], None] = lambda stage: None
) -> tuple[StudyResult, dict[str, Any], tuple[str, ...]]:
    """Run a study; each trajectory is written when its run has finished, summary.json when all is there.

    Returns:
        The result, the content of summary.json, and what is not there and why.

    Raises:
        MampcError: values of the study that do not fit its plant or model, or a folder that cannot be written.
    """
    folder = ResultFolder(directory, last=SUMMARY)
    files = StudyFiles(folder)

    def begin(prepared: Prepared) -> None:
        folder.clear()
        files.model(prepared)

    result = run_study(study, on_stage, on_begin=begin, on_run=files.trajectory)
    missing = []
    try:
        for drawing in study_figures(result):
            on_stage(f"figure {drawing.name}")
            files.figure(drawing.name, drawing.figure)
    except MampcError as error:
        missing.append(f"no figures written; {error}")
    on_stage(PAGE)
    try:
        files.page(result)
    except MampcError as error:
        missing.append(f"no {PAGE} written; {error}")
    return result, files.summary(result), tuple(missing)


def trajectory_name(scenario: str, controller: str) -> str:
    """The file of one controller's run in one scenario."""
    return f"{file_word(scenario)}_{file_word(controller)}.csv"


def trajectories(study: Study) -> Iterator[tuple[str, str, str]]:
    """Scenario, controller and file of every run of a study."""
    for scenario in study.scenarios:
        for controller in study.controllers:
            yield scenario.name, controller.name, trajectory_name(scenario.name, controller.name)


def save_figure(figure: Any, stem: Path) -> None:
    """Write a figure as PNG and SVG, each whole, `stem` being the path without its ending."""
    with styled(), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "Glyph .* missing"
        )  # letters that matplotlib's font lacks are boxes
        for kind in FIGURE_KINDS:
            with written_whole(stem.with_name(f"{stem.name}.{kind}")) as unfinished:
                figure.savefig(unfinished, format=kind, metadata={"Date": None} if kind == "svg" else None)
