"""What commands say: results on standard output, progress and complaints on standard error."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console

_NARROW = 125  # columns of a table that is not on a terminal


def console_for_tables() -> Console:
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=max(_NARROW, console.width))
    return console


def complain(message: str) -> None:
    Console(stderr=True, highlight=False, markup=False, soft_wrap=True).print(message)


def print_list(console: Console, title: str, sentences: Sequence[str]) -> None:
    if sentences:
        console.print(f"{title}:", markup=False)
        for sentence in sentences:
            console.print(f"  - {sentence}", soft_wrap=True, markup=False)


@contextmanager
def progress() -> Iterator[Any]:
    """A function that shows the current stage: with the time gone on a terminal, a line each elsewhere."""
    console = Console(stderr=True, highlight=False, markup=False)
    if not console.is_terminal:
        yield lambda stage: None if stage.startswith(("figure", "report.html")) else complain(f"{stage} ...")
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task("")
        yield lambda stage: shown.update(task, description=f"{stage} ...")


@contextmanager
def bar(title: str, unit: str = "settings") -> Iterator[Any]:
    """A function that shows how many of all tasks are done, with the time left; a line now and then elsewhere."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, highlight=False, markup=False)
    if not console.is_terminal:
        shown, began = [0], time.perf_counter()

        def tell(done: int, total: int) -> None:
            if done >= shown[0] or done == total:
                complain(f"{done} of {total} {unit} done{_left(time.perf_counter() - began, done, total)}")
                shown[0] = done + max(1, total // 5)

        yield tell
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(title)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def _left(seconds: float, done: int, total: int) -> str:
    """The time left, once it can be told."""
    if seconds < 2 or not 0 < done < total:
        return ""
    return f", about {seconds * (total - done) / done:.0f} s left"
