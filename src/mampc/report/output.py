"""Writing a study's results: everything is made ready beside the target, then put in place at once."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mampc.drawing import styled
from mampc.errors import MampcError
from mampc.report.figures import study_figures
from mampc.report.summary import summarise
from mampc.study import StudyResult
from mampc.study.schema import file_word

SUMMARY = "summary.json"
MANIFEST = ".mampc-files"  # what a run wrote, so that the next can clear it away


def require_writable(directory: Path) -> None:
    """Find out before a long run whether its results can be written; raises `MampcError`."""
    shutil.rmtree(_staging(directory), ignore_errors=True)


@contextmanager
def published_together(directory: Path) -> Iterator[Path]:
    """A folder to write into; on success its files appear in `directory`, on failure nothing changes.

    A new directory appears in one rename. In an existing one each file is replaced whole, files of the
    last run that this one does not have go away, and summary.json goes first and comes back last: where it
    stands, the files around it belong to it. Files of others stay.

    Raises:
        MampcError: the directory cannot be written.
    """
    staging = _staging(directory)
    try:
        yield staging
        files = [path for path in staging.rglob("*") if path.is_file()]
        names = sorted(path.relative_to(staging).as_posix() for path in files)
        (staging / MANIFEST).write_text("\n".join(names) + "\n", encoding="utf-8")
        if not directory.exists():
            staging.chmod(0o755)
            staging.rename(directory)
            return
        (directory / SUMMARY).unlink(missing_ok=True)
        for name in _last_run(directory) - set(names):
            (directory / name).unlink(missing_ok=True)
        for name in sorted([*names, MANIFEST], key=lambda name: name == SUMMARY):
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            (staging / name).replace(directory / name)
    except OSError as error:
        raise MampcError(f"{directory}: expected to write the results, received: {error}") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _staging(directory: Path) -> Path:
    """A new folder on the same disk as `directory`; what killed runs left behind is cleared away."""
    try:
        if directory.exists() and not directory.is_dir():
            raise MampcError(f"--out: expected a directory, received the file {directory}")
        parent, prefix = (
            (directory, ".partial-")
            if directory.exists()
            else (directory.parent, f".{directory.name}.partial-")
        )
        parent.mkdir(parents=True, exist_ok=True)
        for left in parent.glob(f"{prefix}*"):
            if not _running(left.name.removeprefix(prefix).split("-")[0]):
                shutil.rmtree(left, ignore_errors=True)
        return Path(tempfile.mkdtemp(prefix=f"{prefix}{os.getpid()}-", dir=parent))
    except OSError as error:
        raise MampcError(f"--out: expected a directory that can be written, received: {error}") from None


def _running(process: str) -> bool:
    try:
        os.kill(int(process), 0)
    except (ValueError, ProcessLookupError):
        return False
    except OSError:
        return True
    return True


def _last_run(directory: Path) -> set[str]:
    """The files that the last run put into the directory, as far as its list can be believed."""
    try:
        names = (directory / MANIFEST).read_text(encoding="utf-8").splitlines()
    except OSError:
        return set()
    return {
        name for name in names if name and (directory / name).resolve().is_relative_to(directory.resolve())
    }


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
            run.to_csv(folder / f"{file_word(scenario)}_{file_word(controller)}.csv")
    summary = summarise(result)
    (folder / SUMMARY).write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return summary


def save_figure(figure: Any, stem: Path) -> None:
    """Write a figure as PNG and SVG, `stem` being the path without its ending."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    with styled():
        try:
            figure.savefig(stem.with_name(stem.name + ".png"))
            figure.savefig(stem.with_name(stem.name + ".svg"), metadata={"Date": None})
        except OSError as error:
            raise MampcError(f"{stem}: expected figures that can be written, received: {error}") from None
