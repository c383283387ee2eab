"""Model files: JSON with the matrices, the operating point, the names, and what the record said."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from mampc.base.errors import MampcError
from mampc.base.files import read_text, written_whole
from mampc.base.names import Names
from mampc.systems.evidence import Evidence
from mampc.systems.noise import Noise
from mampc.systems.state_space import StateSpace

MODEL_FILE_LIMIT = 16 * 2**20  # bytes; the largest model fits with room to spare
MOST_STATES = 500  # of a model in a file; far beyond it, a controller takes minutes to build
MOST_SIGNALS = 200  # inputs of a model in a file, and outputs; far beyond it, a study takes hours


def write(model: StateSpace, path: str | Path) -> None:
    """See `StateSpace.save`."""
    _require_moderate(model, path)
    arrays = ("A", "B", "C", "D", "u_op", "y_op", "v_op")
    content = {
        "format": "mampc-model-1",
        "dt": model.dt,
        **{k: np.asarray(getattr(model, k)).tolist() for k in arrays},
        "names": {k: list(names) for k, names in asdict(model.names).items()},
    }
    for key, said in (("noise", model.noise), ("evidence", model.evidence)):
        if said is not None:
            content[key] = {k: v.tolist() for k, v in asdict(said).items() if v is not None}
    with written_whole(path) as unfinished:
        unfinished.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read(path: str | Path) -> StateSpace:
    """Read a model written by `save`; raises `MampcError` for anything else."""
    try:
        content = json.loads(read_text(path, MODEL_FILE_LIMIT, "mampc model file"))
    except MampcError:
        raise
    except (ValueError, RecursionError) as error:
        raise MampcError(f"{path}: expected a mampc model file, received: {error}") from None
    if not isinstance(content, dict) or content.get("format") != "mampc-model-1":
        raise MampcError(f"{path}: expected a model file with format 'mampc-model-1'")
    try:
        names = Names(**{k: tuple(v) for k, v in content["names"].items()})
        matrices = {k: content[k] for k in ("A", "B", "C", "D", "dt", "u_op", "y_op")}
        if matrices["A"] == []:  # no states: JSON keeps no empty rows
            matrices |= {"A": np.zeros((0, 0)), "B": np.zeros((0, np.shape(matrices["D"])[-1]))}
        noise = Noise(**content["noise"]) if "noise" in content else None
        evidence = Evidence(**content["evidence"]) if "evidence" in content else None
        v_op = content.get("v_op", 0.0)
        model = StateSpace(**matrices, names=names, v_op=v_op, noise=noise, evidence=evidence)
    except (KeyError, TypeError, AttributeError) as error:
        raise MampcError(f"{path}: expected A, B, C, D, dt, u_op, y_op, names; {error!r}") from None
    except MampcError as error:
        raise MampcError(f"{path}: {error}") from None
    _require_moderate(model, path)
    return model


def _require_moderate(model: StateSpace, path: str | Path) -> None:
    if model.n_states > MOST_STATES or max(model.D.shape) > MOST_SIGNALS:
        raise MampcError(
            f"{path}: expected a model of at most {MOST_STATES} states and {MOST_SIGNALS} inputs and outputs each, "
            f"received {model.n_states}, {model.B.shape[1]} and {model.n_outputs}; reduce its order"
        )
