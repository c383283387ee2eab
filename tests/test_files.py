"""Files from elsewhere, whatever they are: refused with a clear message, in bounded time and memory."""

import json
import os
import tracemalloc

import numpy as np
import pytest

import mampc
from mampc.base.csv_table import CSV_FILE_LIMIT, CSVTable
from mampc.base.files import written_whole
from mampc.report.folder import MANIFEST, ResultFolder
from mampc.systems.model_file import MOST_STATES

READERS = {
    "model": mampc.StateSpace.load,
    "record": lambda path: mampc.IOData.from_csv(path, inputs=["u"], outputs=["y"]),
    "run": lambda path: mampc.Recording.from_csv(path, mampc.Names(("u",), ("y",))),
}


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_pipes_devices_folders_and_impossible_names_are_not_read(read, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe", tmp_path / "endless", tmp_path):
        with pytest.raises(mampc.MampcError, match=r"expected a readable .* no regular file"):
            read(path)
    for name in ("a\0b", "a" * 300):
        with pytest.raises(mampc.MampcError, match="expected a readable"):
            read(tmp_path / name)


def test_a_pipe_in_the_place_of_a_list_of_files_stops_nothing(tmp_path):
    os.mkfifo(tmp_path / MANIFEST)
    ResultFolder(tmp_path, last="summary.json").place("a.csv")
    assert (tmp_path / MANIFEST).read_text() == "a.csv\n"


def test_names_too_long_for_a_file_are_refused_and_not_listed(tmp_path):
    folder = ResultFolder(tmp_path, last="summary.json")
    with pytest.raises(mampc.MampcError, match="at most 200 bytes"):
        folder.place(f"figures/{'a' * 201}.svg")
    assert not (tmp_path / MANIFEST).exists()
    with (
        pytest.raises(mampc.MampcError, match="can be written"),
        written_whole(tmp_path / ("a" * 300)) as file,
    ):
        file.write_text("")


def test_a_record_is_bounded_and_takes_little_more_memory_than_its_file(tmp_path, monkeypatch):
    path = tmp_path / "record.csv"
    with path.open("wb") as file:
        file.truncate(CSV_FILE_LIMIT + 1)
    with pytest.raises(mampc.MampcError, match="at most 64 MiB"):
        CSVTable(path)
    path.write_text("u,y\n" + "1,2\n" * 100_000)
    monkeypatch.setattr("mampc.base.csv_table.CSV_FILE_LIMIT", 2**20)  # what is read into is as long at first
    tracemalloc.start()
    assert len(CSVTable(path).numbers("u")) == 100_000
    assert tracemalloc.get_traced_memory()[1] < 2**20 + 4 * path.stat().st_size
    tracemalloc.stop()


def test_a_model_file_has_a_bounded_order_both_ways(tmp_path):
    n = MOST_STATES + 1
    large = mampc.StateSpace(np.zeros((n, n)), np.zeros((n, 1)), np.zeros((1, n)), None, 1.0)
    with pytest.raises(mampc.MampcError, match=r"at most 500 states.*received 501, 1 and 1"):
        large.save(tmp_path / "large.json")
    mampc.StateSpace([[0.5]], [[1.0]], [[1.0]], None, 1.0).save(tmp_path / "model.json")
    content = json.loads((tmp_path / "model.json").read_text())
    content |= {name: getattr(large, name).tolist() for name in "ABC"}
    content["names"]["states"] = []
    (tmp_path / "model.json").write_text(json.dumps(content))
    with pytest.raises(mampc.MampcError, match=r"at most 500 states.*received 501, 1 and 1"):
        mampc.StateSpace.load(tmp_path / "model.json")
