"""Data frames, and the files that are read as frames."""

import numpy as np
import pytest

from mampc import IOData, MampcError, read_export
from small_exports import U, Y, assert_whole, stamps, told

pd = pytest.importorskip("pandas")


def frame():
    return pd.DataFrame({"when": pd.to_datetime(stamps()), "u": U, "y": Y})


def test_frames_are_read_as_files_are():
    whole = frame()
    for variant in (
        whole,
        whole.set_index("when"),
        pd.DataFrame({"u": U, "y": Y}, index=pd.DatetimeIndex(stamps())),
        whole.assign(when=whole["when"].dt.tz_localize("Europe/Berlin")),
        whole.assign(when=stamps()),
        whole.astype({"u": "Int64", "y": "object"}),
    ):
        assert_whole(read_export(variant, inputs="u", outputs="y"))
    record = IOData.from_frame(whole[["u", "y"]], inputs="u", outputs="y", dt=60.0)
    np.testing.assert_array_equal(record.y[:, 0], Y)


def test_gaps_and_marks_in_frames():
    data = frame()
    data["y"] = data["y"].astype(object)
    data.loc[4, "y"] = "Bad"
    data.loc[8, "u"] = np.nan
    export = read_export(data, inputs="u", outputs="y")
    assert [len(record) for record in export.records] == [4, 3, 3]
    data["u"] = data["u"] > 5
    export = read_export(data, inputs="u", outputs="y")
    assert np.array_equal(export.records[0].u[:, 0], U[:4] > 5)
    with pytest.raises(MampcError, match="expected numbers in column 'u'"):
        read_export(data, inputs="y", outputs="u")


@pytest.mark.parametrize("wrong", [None, 5, [[1, 2]], pd.Series([1.0, 2.0]), pd.DataFrame()])
def test_what_is_no_frame_is_refused(wrong):
    with pytest.raises(MampcError, match="expected"):
        IOData.from_frame(wrong, inputs="u", outputs="y")


def test_excel_files(tmp_path):
    pytest.importorskip("openpyxl")
    data = frame()
    data["y"] = data["y"].astype(object)
    data.loc[5, "y"] = "No Data"
    path = tmp_path / "export.xlsx"
    data.to_excel(path, index=False, startrow=2)
    export = read_export(path, inputs="u", outputs="y")
    assert [len(record) for record in export.records] == [5, 6]
    assert told(export, "first in row 9")
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(MampcError, match="expected a readable"):
        read_export(path, inputs="u", outputs="y")


def test_parquet_files(tmp_path):
    pytest.importorskip("pyarrow")
    path = tmp_path / "export.parquet"
    frame().set_index("when").to_parquet(path)
    assert_whole(read_export(path, inputs="u", outputs="y"))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(MampcError, match="expected a readable Parquet file"):
        read_export(path, inputs="u", outputs="y")
