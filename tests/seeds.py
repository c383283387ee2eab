"""How deep random tests go: the first seeds and a few examples always, all of them with `make deep`."""

import os

import pytest

DEEP = bool(os.environ.get("MAMPC_DEEP"))  # set by `make deep`


def seeds(count, *, quick):
    """0..count-1, those from `quick` on marked slow."""
    return [*range(quick), *deep(*range(quick, count))]


def deep(*values):
    """Values of a parameter that are marked slow: others show the property as well."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def examples(count, *, quick):
    """So many for tests by property, and for those that need many seeds in one."""
    return count if DEEP else quick
