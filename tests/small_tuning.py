"""Tuning of a size for tests."""

from contextlib import contextmanager

import pytest

import mampc
from mampc.compare import candidates, scenarios, tuning
from mampc.compare.rounds import Rounds

SMALL = Rounds(3, 3, 4, 4, 8)


@contextmanager
def few_and_short():
    """Rounds, candidates and scenarios of a size for tests."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("ROUNDS", "DEAR_ROUNDS"):
            patch.setattr(tuning, name, SMALL)
        patch.setattr(candidates, "MOVE_WEIGHTS", (0.1,))
        patch.setattr(scenarios, "LENGTHS", (60, 60))
        yield


def lag(**changes):
    settings = {"gain": [[2.0]], "time_constant": 50.0, "dt": 10.0}
    return mampc.StateSpace.from_first_order(**(settings | changes))
