"""What tuning found in words: a table of its front; and a folder with the study, the model, the runs, the front."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

from rich.table import Table

from mampc.base.errors import MampcError
from mampc.base.files import made_folder, written_whole
from mampc.compare.fronts import Estimate
from mampc.compare.promise import ratio_over_kinds
from mampc.compare.tuned import Tuned
from mampc.compare.tuned_study import MODEL_FILE
from mampc.report.columns import numbers
from mampc.report.fronts import WIDEST, front_figure, write_rows
from mampc.report.output import save_figure
from mampc.study.schema import Study
from mampc.study.writing import study_text

STUDY_FILE = "tuned.toml"
BEYOND = 1.2  # times the error at the price chosen: what figures show at least


def tuning_table(tuned: Tuned) -> Table:
    """The prices of the controller found, with moves and error."""
    headers = ("price", "moves per hour", f"error / {tuned.expected.beside}", "")
    loops = len({row["seed"] for row in tuned.rows})
    title = f"The front, in {loops} scenarios of the search: means (standard errors)"
    table = Table(*numbers(*headers), title=title, title_justify="left")
    for point in tuned.front:
        mark = "chosen" if point.price == tuned.rules.price else ""
        table.add_row(f"{point.price:.4g}", _shown(point.moves_per_hour), _shown(point.error_ratio), mark)
    return table


def widest(tuned: Tuned) -> float:
    """The largest error, over that of the baseline, that is drawn: beyond the price chosen."""
    chosen = [point.error_ratio.value for point in tuned.front if point.price == tuned.rules.price]
    return float(max(WIDEST, *(BEYOND * ratio for ratio in chosen))) if chosen else WIDEST


def _shown(estimate: Estimate) -> str:
    return f"{estimate.value:.3g} ({estimate.standard_error:.2g})"


def told(tuned: Tuned, wanted: str) -> str:
    """The outcome in a few sentences."""
    beside = tuned.expected.beside
    found = (
        f"{beside[0].upper()}{beside[1:]}"
        if tuned.is_plain
        else f"Price {tuned.rules.price:.4g}, {tuned.setting}"
    )
    if tuned.reached:
        return f"Kept: {wanted}. {found}. Expected: {tuned.expected}."
    if not tuned.is_plain:
        return (
            f"Not reached: {wanted}. The calmest setting tried instead. {found}. Expected: {tuned.expected}."
        )
    return (
        f"Not reached: {wanted}, by fewer moves. No price keeps it on plants that are off the model; allow more, or "
        f"tell what your plant has (noise, loads, set-point changes). {found} instead. Expected: {tuned.expected}."
    )


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
        kinds = len(tuned.loads)
        figure = front_figure(
            tuned.rows, "tuning", allowed, beside=tuned.expected.beside, widest=widest(tuned),
            ratio=lambda point, base: ratio_over_kinds(point, base, kinds).value,
        )  # fmt: skip
        save_figure(figure, folder / "front")
    except MampcError as error:
        return f"no figure written; {error}"
    return None
