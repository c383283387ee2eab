"""Models of every kind that a load bank may meet."""

from dataclasses import replace

import numpy as np

import mampc
from builders import random_model
from mampc import LoadBank

LEVEL = mampc.StateSpace([[1.0, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0, [5.0], [3.0])
MODELS = {
    "stable": random_model(1, n=4, m=2, l=2, feedthrough=True),
    "integrating": LEVEL,
    "slow": mampc.StateSpace(np.diag([1 - 1e-6, 0.8]), np.eye(2), [[1, 0.2], [0.3, 1]], None, 1.0),
    "more inputs": random_model(2, n=3, m=3, l=2),
    "more outputs": random_model(3, n=4, m=1, l=3),
    "unstable": mampc.StateSpace([[1.05, 0.3], [0.0, 0.6]], [[0.1], [0.4]], [[1.0, 0.0]], None, 1.0),
    "measured": replace(
        random_model(4, n=3, m=3, l=2, feedthrough=True), u_op=[1.0, 2.0], v_op=[3.0],
        names=mampc.Names(("u1", "u2"), ("y1", "y2"), (), ("load",)),
    ),
}  # fmt: skip


def bank_of(model, **options):
    return LoadBank(model, **({"noise": np.linspace(0.1, 0.3, model.n_outputs)} | options))
