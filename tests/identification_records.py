"""The measured plant records beside the checkout, with the reference results that go with them."""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from mampc import IOData

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "identification"


@dataclass(frozen=True)
class Record:
    """One record, split as the reference was, and what GNU Octave's `n4sid` found on it."""

    estimation: IOData
    validation: IOData
    order: int
    block_rows: int
    singular_values: np.ndarray
    poles: np.ndarray
    fit: np.ndarray


@lru_cache
def _load(name):
    reference = json.loads((FOLDER / f"{name}.octave.json").read_text())
    data = IOData.from_csv(FOLDER / f"{name}.csv", inputs=reference["inputs"], outputs=reference["outputs"])
    return Record(
        estimation=data[slice(*reference["split"]["estimation_rows"])],
        validation=data[slice(*reference["split"]["validation_rows"])],
        order=reference["options"]["n"],
        block_rows=reference["options"]["s"],
        singular_values=np.array(reference["singular_values"]),
        poles=np.array([complex(*pole) for pole in reference["eigenvalues_A"]]),
        fit=np.array(reference["validation"]["fit_percent"]),
    )


def load_record(name):
    """A plant record, or a skipped test where the records are not there."""
    if not (FOLDER / f"{name}.csv").exists():
        pytest.skip(f"the plant records are not beside the checkout: {FOLDER / name}.csv is missing")
    return _load(name)
