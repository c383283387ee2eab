"""A folder of results: every file appears whole, and the last one only when all others are there."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mampc.base.errors import MampcError
from mampc.base.files import PARTIAL, read_text, written_whole

MANIFEST = ".mampc-files"  # what a run wrote, so that the next can clear it away
MANIFEST_LIMIT = 2**24  # bytes
LONGEST_NAME = 200  # bytes; file systems allow 255, and the name of a file not yet whole is longer


class ResultFolder:
    """Receives the files of one run, each whole under its final name or not at all.

    A killed run leaves what it had finished. `last` is written at the end and removed before anything else
    changes: where it stands, the files around it belong to it. Files of others stay.

    Args:
        path: the folder; made if it is not there.
        last: name of the file that says that all are there.

    Raises:
        MampcError: the folder cannot be written.
    """

    def __init__(self, path: Path, last: str) -> None:
        self.path, self._last, self._names = path, last, list[str]()
        try:
            if path.exists() and not path.is_dir():
                raise MampcError(f"--out: expected a directory, received the file {path}")
            path.mkdir(parents=True, exist_ok=True)
            for name in {*self._of_last_run(), MANIFEST, last}:
                place = path / name
                for left in place.parent.glob(f".{glob.escape(place.name)}{PARTIAL}*"):
                    if not _running(left.name.rpartition(PARTIAL)[2]):
                        left.unlink(missing_ok=True)
            with written_whole(path / ".mampc-writable") as probe:
                probe.write_text("")
            (path / ".mampc-writable").unlink()
        except OSError as error:
            raise MampcError(f"--out: expected a directory that can be written, received: {error}") from None

    def clear(self) -> None:
        """Remove what the last run left here, the file that vouches for the others first."""
        (self.path / self._last).unlink(missing_ok=True)
        for name in self._of_last_run():
            with suppress(NotADirectoryError):
                (self.path / name).unlink(missing_ok=True)
        self._names = []

    def place(self, name: str) -> Path:
        """Where the file `name` goes; it is listed, so that the next run can clear it away."""
        if len(os.fsencode(Path(name).name)) > LONGEST_NAME:
            raise MampcError(
                f"{name}: expected a file name of at most {LONGEST_NAME} bytes; "
                "shorten the names of scenarios and signals"
            )
        if name not in self._names:
            self._names.append(name)
            with written_whole(self.path / MANIFEST) as unfinished:
                unfinished.write_text("\n".join(self._names) + "\n", encoding="utf-8")
        place = self.path / name
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise MampcError(f"{place}: expected a file that can be written, received: {error}") from None
        return place

    @contextmanager
    def writing(self, name: str) -> Iterator[Path]:
        """A path to write the file `name` to; it appears on success."""
        with written_whole(self.place(name)) as unfinished:
            yield unfinished

    def _of_last_run(self) -> set[str]:
        """The files that the last run put here, as far as its list can be believed."""
        try:
            names = read_text(self.path / MANIFEST, MANIFEST_LIMIT, "list of files").splitlines()
        except MampcError:
            return set()
        root = self.path.resolve()
        return {name for name in names if name and (self.path / name).resolve().is_relative_to(root)}


def _running(process: str) -> bool:
    """Whether there may be a process of this number; what is no number belongs to somebody else."""
    try:
        os.kill(int(process), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except (ValueError, OSError):
        return True
    return True
