"""Progress of long loops, on standard error of a terminal."""

from __future__ import annotations

import time
from typing import Any


def watched(steps: int, progress: bool | None) -> Any:
    """0..steps-1, with a progress bar that shows itself once the run has taken two seconds."""
    if progress is False:
        return range(steps)
    return _with_bar(steps, 0.0 if progress else 2.0)


def _with_bar(steps: int, patience: float) -> Any:
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    began, bar, task = time.perf_counter(), None, None
    try:
        for k in range(steps):
            if bar is None and console.is_terminal and time.perf_counter() - began >= patience:
                bar = Progress(console=console, transient=True)
                bar.start()
                task = bar.add_task("closed loop", total=steps, completed=k)
            yield k
            if bar is not None and task is not None:
                bar.update(task, completed=k + 1)
    finally:
        if bar is not None:
            bar.stop()
