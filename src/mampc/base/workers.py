"""Calls spread over worker processes, which leave Ctrl-C to the process that started them."""

from __future__ import annotations

import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any


def in_parallel(calls: Iterable[Any], jobs: int, *, ordered: bool = True, **options: Any) -> Iterator[Any]:
    """What each call gives, as they finish, or in their order.

    Args:
        calls: made by `joblib.delayed`.
        jobs: processes; -1 for one a core.
        ordered: whether results come in the order of the calls.
        options: further ones of `joblib.Parallel`.
    """
    kind = "generator" if ordered else "generator_unordered"
    with _interrupts_held():
        from joblib import Parallel

        results: Iterator[Any] = Parallel(n_jobs=jobs, return_as=kind, **options)(calls)  # workers start here
    return results


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Interrupts wait until this ends; processes that start meanwhile inherit that, and never see one."""
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # which would let them in again when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
