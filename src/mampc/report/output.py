"""Writing a study's results: everything is made ready beside the target, then put in place at once."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mampc.errors import MampcError
from mampc.report.figures import study_figures
from mampc.report.summary import summarise
from mampc.study import StudyResult
from mampc.study.schema import file_word

SUMMARY = "summary.json"


@contextmanager
def published_together(directory: Path) -> Iterator[Path]:
    """A folder to write into; on success its files appear in `directory`, on failure nothing changes.

    A new directory appears in one rename. In an existing one each file is replaced whole and
    summary.json goes away first and comes back last: where it stands, the files around it belong to it.
    Files of others stay.

    Raises:
        MampcError: the directory cannot be written.
    """
    try:
        directory.parent.mkdir(parents=True, exist_ok=True)
        if directory.exists() and not directory.is_dir():
            raise MampcError(f"--out: expected a directory, received the file {directory}")
        staging = Path(tempfile.mkdtemp(prefix=f".{directory.name}.partial-", dir=directory.parent))
    except OSError as error:
        raise MampcError(f"--out: expected a directory that can be written, received: {error}") from None
    try:
        yield staging
        staging.chmod(0o755)
        if not directory.exists():
            staging.rename(directory)
            return
        (directory / SUMMARY).unlink(missing_ok=True)
        files = sorted(
            (path for path in staging.rglob("*") if path.is_file()), key=lambda path: path.name == SUMMARY
        )
        for path in files:
            target = directory / path.relative_to(staging)
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
    except OSError as error:
        raise MampcError(f"{directory}: expected to write the results, received: {error}") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def write_study(
    result: StudyResult, directory: Path, on_stage: Callable[[str], None] = lambda stage: None
) -> tuple[dict[str, Any], str | None]:
    """Write summary.json, trajectories, the model, the record and figures into `directory`.

    Returns:
        The content of summary.json, and why there are no figures, if so.
    """
    missing = None
    with published_together(directory) as folder:
        try:
            for name, figure in study_figures(result):
                on_stage(f"figure {name}")
                save_figure(figure, folder / "figures" / name)
        except MampcError as error:
            missing = str(error)
        summary = write_files(result, folder)
    return summary, missing


def write_files(result: StudyResult, folder: Path) -> dict[str, Any]:
    """Write everything but the figures into a folder; returns the content of summary.json."""
    result.model.save(folder / "model.json")
    if result.data is not None:
        result.data.to_csv(folder / "identification.csv")
    for scenario, runs in result.runs.items():
        for controller, run in runs.items():
            run.to_csv(folder / f"{file_word(scenario)}-{file_word(controller)}.csv")
    summary = summarise(result)
    (folder / SUMMARY).write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return summary


def save_figure(figure: Any, stem: Path) -> None:
    """Write a figure as PNG and SVG, `stem` being the path without its ending, and close it."""
    import matplotlib.pyplot

    stem.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(stem.with_name(stem.name + ".png"))
    figure.savefig(stem.with_name(stem.name + ".svg"), metadata={"Date": None})
    matplotlib.pyplot.close(figure)
