"""Model files: models come back as they were saved, and anything else is refused."""

import json

import numpy as np
import pytest

from builders import random_model
from mampc import MampcError, StateSpace
from mampc.systems.model_file import MODEL_FILE_LIMIT

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_saving_and_loading_gives_the_same_numbers(tmp_path, seed):
    model = random_model(seed, feedthrough=True)
    model.save(tmp_path / "model.json")
    loaded = StateSpace.load(tmp_path / "model.json")
    for name in ("A", "B", "C", "D", "u_op", "y_op"):
        assert np.array_equal(getattr(loaded, name), getattr(model, name))
    assert (loaded.dt, loaded.names) == (model.dt, model.names)
    assert [path.name for path in tmp_path.iterdir()] == ["model.json"]


@pytest.mark.parametrize(
    "content",
    [b"", b"a,b\n1,2\n", b"[1, 2]", b"[" * 100_000, b'{"dt": ' + b"9" * 5000 + b"}", b"\xff\xfe\x00"],
    ids=lambda content: repr(content[:10]),
)
def test_loading_anything_else_names_the_file(tmp_path, content):
    (tmp_path / "model.json").write_bytes(content)
    with pytest.raises(MampcError, match=r"model\.json: expected"):
        StateSpace.load(tmp_path / "model.json")


@pytest.mark.parametrize("key", ["format", "A", "D", "dt", "u_op", "names"])
def test_a_model_file_with_a_part_missing_is_refused(tmp_path, key):
    path = tmp_path / "model.json"
    random_model(0).save(path)
    content = json.loads(path.read_text())
    del content[key]
    path.write_text(json.dumps(content))
    with pytest.raises(MampcError, match=r"model\.json: expected"):
        StateSpace.load(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "mampc-model-9"},
        {"names": 5},
        {"names": {"inputs": [["u"], ["v"]], "outputs": ["y", "z"]}},
        {"names": {"inputs": ["u", "v"], "outputs": ["y", "z"], "colours": ["red"]}},
        {"A": [[0.5, 1.0]]},
        {"A": [[float("nan")] * 3] * 3},
        {"A": [[10**400] * 3] * 3},
        {"B": "one"},
        {"dt": -1.0},
        {"dt": 10**400},
        {"dt": None},
    ],
    ids=lambda changes: str(changes)[:30],
)
def test_a_model_file_with_a_part_that_does_not_fit_is_refused(tmp_path, changes):
    path = tmp_path / "model.json"
    random_model(0).save(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(MampcError, match=r"model\.json: .*expected"):
        StateSpace.load(path)


def test_missing_files_directories_and_huge_files_are_refused(tmp_path):
    huge = tmp_path / "huge.json"
    with huge.open("wb") as file:
        file.truncate(MODEL_FILE_LIMIT + 1)
    with pytest.raises(MampcError, match="at most 16 MiB"):
        StateSpace.load(huge)
    for path in (tmp_path, tmp_path / "missing.json"):
        with pytest.raises(MampcError, match="expected a readable mampc model file"):
            StateSpace.load(path)
