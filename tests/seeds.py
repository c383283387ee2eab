"""Seeds of random tests: the first ones run always, the deep ones with `make deep`."""

import pytest


def seeds(count, *, quick):
    """0..count-1, those from `quick` on marked slow."""
    return [*range(quick), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(quick, count))]
