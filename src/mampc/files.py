"""Writing files so that they appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mampc.errors import MampcError

PARTIAL = ".partial-"  # in the names of files not yet whole, before the number of their process


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
        raise MampcError(f"{target}: expected a file that can be written, received: {error}") from None
    finally:
        unfinished.unlink(missing_ok=True)
