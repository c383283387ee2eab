"""What tuning found: a table of its front, and a folder with the study, the model, the runs and the front drawn."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

from rich.table import Table

from mampc.base.errors import MampcError
from mampc.base.files import made_folder, written_whole
from mampc.compare.fronts import Estimate
from mampc.compare.tuned_study import MODEL_FILE
from mampc.compare.tuning import Tuned
from mampc.report.columns import numbers
from mampc.report.fronts import front_figure, write_rows
from mampc.report.output import save_figure
from mampc.study.schema import Study
from mampc.study.writing import study_text

STUDY_FILE = "tuned.toml"


def tuning_table(tuned: Tuned) -> Table:
    """The prices of the controller found, with moves and error."""
    headers = ("price", "moves per hour", "error over plain MPC's")
    table = Table(*numbers(*headers), title="The front: means (standard errors)", title_justify="left")
    for point in tuned.front:
        table.add_row(f"{point.price:.4g}", _shown(point.moves_per_hour), _shown(point.error_ratio))
    return table


def _shown(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} ({estimate.standard_error:.2g})"


def told(tuned: Tuned, wanted: str) -> str:
    """The outcome in a few sentences."""
    if tuned.reached:
        return f"Kept: {wanted}. Expected: {tuned.expected}."
    return f"Not reached: {wanted}. The calmest setting instead: {tuned.expected}."


def write_tuning(tuned: Tuned, study: Study, folder: Path, wanted: str, allowed: float | None) -> str | None:
    """Write tuned.toml, its model, the runs as front.csv and the front; returns why there is no figure, if so."""
    tuned.problem.model.save(made_folder(folder) / MODEL_FILE)
    write_rows(tuned.rows, folder / "front.csv")
    comment = (
        f"{told(tuned, wanted)}\nWritten by mampc tune. A larger price makes fewer moves at a larger error."
    )
    with written_whole(folder / STUDY_FILE) as unfinished:
        unfinished.write_text(study_text(study, fill(comment, 110)), encoding="utf-8")
    try:
        save_figure(front_figure(tuned.rows, "tuning", allowed), folder / "front")
    except MampcError as error:
        return f"no figure written; {error}"
    return None
