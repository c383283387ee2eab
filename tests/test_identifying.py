"""Several exports become one model."""

from pathlib import Path

import numpy as np
import pytest

from mampc import IOData, MampcError, Names
from mampc.identification.export.together import like_the_others, read_together
from small_exports import U, Y, rows, stamps, text


def test_exports_of_one_plant_are_alike():
    def record(dt=10.0, unit="%"):
        return IOData(
            np.zeros((3, 1)), np.zeros((3, 1)), dt, Names(("u",), ("y",), units={"u": unit} if unit else {})
        )

    june = Path("june.csv")
    [added] = like_the_others(june, [record(unit="")], [record()])
    assert added.names == record().names
    with pytest.raises(MampcError, match=r"june\.csv: expected u in % as before, received m3/h"):
        like_the_others(june, [record(unit="m3/h")], [record()])
    with pytest.raises(MampcError, match=r"june\.csv: expected samples every 10 s as before, received 20 s"):
        like_the_others(june, [record(dt=20.0)], [record()])


def test_no_sample_of_several_exports_counts_twice(tmp_path):
    may, june = tmp_path / "may.csv", tmp_path / "june.csv"
    may.write_text(text(rows()))
    june.write_text(text(rows(stamps(start="2024-04-13 10:05:00"))))  # from the eighth sample on
    records, notes = read_together([may, june], inputs="u", outputs="y")
    assert [len(record) for record in records] == [12, 7]
    assert np.array_equal(records[1].y[:, 0], Y[5:])
    assert any("5 samples at times that the files before tell left out" in note for note in notes)
    with pytest.raises(MampcError, match="expected other times than in the files before"):
        read_together([may, may], inputs="u", outputs="y")


def test_exports_without_dates_are_all_taken(tmp_path):
    runs = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for path in runs:
        path.write_text(
            text([[str(60 * k), str(u), str(y)] for k, (u, y) in enumerate(zip(U, Y, strict=True))])
        )
    records, _ = read_together(runs, inputs="u", outputs="y")
    assert [len(record) for record in records] == [12, 12]
