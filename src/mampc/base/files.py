"""Files: read only where they are what they should be, written so that they appear whole or not at all."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mampc.base.errors import MampcError

PARTIAL = ".partial-"  # in the names of files not yet whole, before the number of their process


def read_bounded(path: str | Path, limit: int, kind: str) -> bytes:
    """The content of a regular file; `kind` is how messages call what was expected.

    Raises:
        MampcError: a file that cannot be read or is a pipe, device or folder, or has more than `limit` bytes.
    """
    try:
        # Looked at first, since to open a pipe is to wait for its writer.
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise OSError("it is no regular file")
        with open(path, "rb") as file:
            content = file.read(limit + 1)  # sizes are not believed: some files grow, some say 0
    except (OSError, ValueError) as error:  # ValueError: no file has such a name
        raise MampcError(f"{path}: expected a readable {kind}, received: {error}") from None
    if len(content) > limit:
        raise MampcError(f"{path}: expected a {kind} of at most {limit / 2**20:g} MiB, received more")
    return content


def read_text(path: str | Path, limit: int, kind: str) -> str:
    """The text of a regular file in UTF-8, with or without a byte order mark; raises as `read_bounded` does."""
    try:
        return read_bounded(path, limit, kind).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MampcError(f"{path}: expected a readable {kind}, received: {error}") from None


def made_folder(path: Path) -> Path:
    """The folder for results, made where it is not there; `MampcError` where it cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MampcError(f"--out: expected a folder that can be written, received: {error}") from None
    if not os.access(path, os.W_OK):
        raise MampcError(f"--out: expected a folder that can be written, received {path}")
    return path


@contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """A path to write to beside `path`, renamed to it on success and removed on failure.

    Raises:
        MampcError: the file cannot be written.
    """
    target = Path(path)
    unfinished = target.with_name(f".{target.name}{PARTIAL}{os.getpid()}")
    try:
        yield unfinished
        unfinished.replace(target)
    except OSError as error:
        why = error.strerror or error
        raise MampcError(f"{target}: expected a file that can be written, received: {why}") from None
    finally:
        with suppress(OSError):  # as where the name is too long to be a file's
            unfinished.unlink(missing_ok=True)
