"""Exports: what is read of each kind of file, what is told of it, and what is refused with which rows."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

import mampc
from mampc import IOData, MampcError, read_export
from small_exports import U, Y, assert_whole, read, rows, stamps, text, told, write

pd = pytest.importorskip("pandas")


@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
def test_separators_and_encodings(tmp_path, separator, encoding):
    content = text(rows(), separator, ("Zeit (MESZ) °", "u", "y"))
    assert_whole(read(tmp_path, content, encoding))


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas(tmp_path, separator):
    lines = [[time, a.replace(".", ","), b.replace(".", ",")] for time, a, b in rows()]
    assert_whole(read(tmp_path, text(lines, separator)))


def test_quoted_decimal_commas_between_commas(tmp_path):
    lines = [[time, f'"{a}"'.replace(".", ","), f'"{b}"'.replace(".", ",")] for time, a, b in rows()]
    assert_whole(read(tmp_path, text(lines)))


def test_thousands_are_read_where_no_doubt_is_left(tmp_path):
    lines = [
        [str(60 * k), f"{u:,.1f}", f"{y:,.1f}"]
        for k, (u, y) in enumerate(zip(U * 1000, Y * 100, strict=True))
    ]
    [record] = read(tmp_path, text(lines, ";")).records
    np.testing.assert_allclose(record.u[:, 0], U * 1000)
    lines = [[str(60 * k), f"{u:,.0f}", "1"] for k, u in enumerate(U * 1000)]
    with pytest.raises(MampcError, match="may have a decimal comma or grouped thousands; pass decimal"):
        read(tmp_path, text(lines, "\t"))
    for decimal, factor in ((".", 1000), (",", 1)):
        [record] = read(tmp_path, text(lines, "\t"), decimal=decimal).records
        np.testing.assert_allclose(record.u[:, 0], U * factor)


def test_points_that_may_group_thousands_are_refused_where_whole_numbers_stand_beside_them(tmp_path):
    grouped = [f"{1000 * k - 64:,}".replace(",", ".") for k in range(len(U))]
    content = text(rows(u=100 * U, y=grouped), ";")
    with pytest.raises(MampcError, match="may be grouped thousands; pass decimal"):
        read(tmp_path, text(rows(u=["1"] * len(U), y=grouped), ";"))
    assert read(tmp_path, content.replace(".0;", ";"), decimal=",").records[0].y[1, 0] == 936
    whole = text(rows(u=["1"] * len(U), y=[*grouped[:-1], "12345"]), ";")
    assert read(tmp_path, whole).records[0].y[2, 0] == 1.936  # whole numbers are not grouped


def test_two_ways_to_write_decimals_in_one_file_are_refused(tmp_path):
    lines = rows()
    lines[4][2] = "1,5"
    with pytest.raises(MampcError, match="expected a number in row 6, column 'y', received '1,5'"):
        read(tmp_path, text(lines, ";"))


def test_titles_descriptions_units_and_last_lines_are_left_out_and_told(tmp_path):
    content = (
        "Plant 7;exported 2024-04-14\n\n"
        + text([["", "valve of the tank", "level of the tank"], ["", "%", "m"], *rows()], ";")
        + "12 rows exported\n"
    )
    export = read(tmp_path, content)
    assert_whole(export)
    assert told(export, "row 1 before the header", "Plant 7")
    assert told(export, "rows 4 and 5 under the header", "% | m")
    assert told(export, "row 18 after the table", "12 rows exported")


def test_units_behind_names_may_be_left_out(tmp_path):
    export = read(tmp_path, text(rows(), header=("time", "u [%]", "y (m)")))
    assert_whole(export)
    assert export.records[0].names.inputs == ("u",)


MARKS = (
    "Bad", "bad input", "No Data", "I/O Timeout", "", "NaN", "inf", "-Infinity", "1e999", "-9999", "-9999.0", "#N/A",
    "Bad Input", "1.#QNAN", "-1.#IND", "Configure", "Pt Created", "Scan Off", "Arc Off-line", "Calc Failed", "????",
    "---", "(null)", "<null>", "1e38", "#REF!", "ERR 14", "12.3 BAD", "65535", "-999.25", "∞", "нет данных", "不良",
    "1.#IND", "null", "Open", "--", "9.9e37", "[-11059] No Good Data For Calculation", "1e13",
)  # fmt: skip


@pytest.mark.parametrize("mark", MARKS)
@pytest.mark.parametrize("column", [1, 2])
def test_no_mark_is_ever_a_number(tmp_path, mark, column):
    lines = rows()
    lines[5][column] = mark
    export = read(tmp_path, text(lines))
    assert [len(record) for record in export.records] == [5, 6]
    np.testing.assert_array_equal(
        np.concatenate([record.y[:, 0] for record in export.records]), np.delete(Y, 5)
    )
    assert told(export, f"{'uy'[column - 1]}: no number in 1 of 12 rows", "first in row 7")


def test_marks_at_the_ends_are_left_out(tmp_path):
    lines = rows()
    lines[0][1] = lines[1][2] = lines[-1][1] = "Bad"
    with pytest.warns(UserWarning, match="2 rows at the beginning"):
        record = IOData.from_csv(write(tmp_path, text(lines)), inputs="u", outputs="y")
    np.testing.assert_array_equal(record.y[:, 0], Y[2:-1])


def test_a_number_that_may_be_a_mark_is_asked_about(tmp_path):
    y = np.where(np.arange(len(U)) == 5, 9999.0, 9950.0 + 20 * np.arange(len(U)) % 47)
    content = text(rows(y=y))
    with pytest.raises(MampcError, match="y: 9999 in row 7 may be a value or a mark"):
        read(tmp_path, content)
    assert len(read(tmp_path, content, ranges={"y": (0, 1e5)}).records) == 1
    assert len(read(tmp_path, content, bad=[9999]).records) == 2
    inside = np.where(np.arange(len(U)) == 5, 9999.0, 9990.0 + 3 * np.arange(len(U)))
    assert len(read(tmp_path, text(rows(y=inside))).records) == 1


def test_values_out_of_a_stated_range_are_not_used(tmp_path):
    y = Y.copy()
    y[6] = 250.0
    export = read(tmp_path, text(rows(y=y)), ranges={"y": (0.0, 200.0)})
    assert [len(record) for record in export.records] == [6, 5]
    assert told(export, "outside 0 to 200 (1, first in row 8)")


@pytest.mark.parametrize("cell", ["12 bar", "1 234", "0x10", "1_000", "1.2.3", "12%", "١٢", "3/4"])
def test_what_may_be_a_number_is_refused_with_its_row(tmp_path, cell):
    lines = rows()
    lines[3][1] = cell
    lines[8][1] = "7 x"
    with pytest.raises(MampcError, match="2 things") as refusal:
        read(tmp_path, text(lines))
    assert f"expected a number in row 5, column 'u', received {cell!r}" in str(refusal.value)
    assert "row 10, column 'u', received '7 x'" in str(refusal.value)
    assert len(read(tmp_path, text(lines), bad=[cell, "7 x"]).records) == 3


def test_a_column_without_numbers_is_refused(tmp_path):
    with pytest.raises(MampcError, match="expected numbers in column 'u', received only 'High', 'Low'"):
        read(tmp_path, text(rows(u=["High", "Low"] * 6)))


@pytest.mark.parametrize(
    ("header", "good", "bad"),
    [
        (("time", "u", "u.Quality", "y", "y.Quality"), "Good", "Bad"),
        (("time", "u", "u_status", "y", "y_status"), "192", "24"),
        (("time", "u", "Quality", "y", "Quality"), "good", "Uncertain"),
        (("time", "u", "Status", "y", "Status.1"), "OK", ""),
        (("time", "u", "u quality", "y", "y quality"), "", "Questionable"),
        (("time", "u", "q", "y", "q"), "Good", "Bad"),
        (("time", "u", "u_Güte", "y", "y_Güte"), "gut", "schlecht"),
        (("time", "u", "u.flag", "y", "y.flag"), "", "*"),
        (("time", "u", "remark", "y", "remark"), "Good", "Bad [No Data]"),
        (("time", "u", "u.Good", "y", "y.Good"), "True", "False"),
        (("time", "u", "Bad_u", "y", "Bad_y"), "0", "1"),
        (("time", "u", "Questionable", "y", "Questionable"), "False", "True"),
    ],
)
def test_values_of_bad_quality_are_not_used(tmp_path, header, good, bad):
    lines = [[time, u, good, y, bad if k == 5 else good] for k, (time, u, y) in enumerate(rows())]
    export = read(tmp_path, text(lines, header=header))
    assert [len(record) for record in export.records] == [5, 6]
    assert told(export, "taken as the quality of y")


def test_a_quality_that_stands_before_its_value_speaks_of_that(tmp_path):
    lines = [[time, "Good", u, "Bad" if k == 5 else "Good", y] for k, (time, u, y) in enumerate(rows())]
    export = read(tmp_path, text(lines, header=("time", "Quality", "u", "Quality", "y")))
    assert told(export, "y: no number in 1 of 12 rows: quality 'bad'")
    assert not told(export, "u: no number")


def test_remarks_that_begin_late_are_seen(tmp_path):
    lines = [
        [time, "5" if k % 9 else "6", str(0.5 * k), "Bad" if k == 90 else ""]
        for k, time in enumerate(stamps(120))
    ]
    export = read(tmp_path, text(lines, header=("time", "u", "y", "remark")))
    assert [len(record) for record in export.records] == [90, 29]


def test_rows_without_a_remark_are_not_lost_where_one_remark_is_a_good_one(tmp_path):
    lines = [
        [time, "5" if k % 9 else "6", str(0.5 * k), {80: "Good run", 90: "Bad"}.get(k, "")]
        for k, time in enumerate(stamps(120))
    ]
    export = read(tmp_path, text(lines, header=("time", "u", "y", "remark")))
    assert [len(record) for record in export.records] == [90, 29]


@pytest.mark.parametrize("header", ["Good", "Valid"])
def test_one_means_true_where_values_are_said_to_be_good(tmp_path, header):
    lines = [[time, u, y, "0" if k == 5 else "1"] for k, (time, u, y) in enumerate(rows())]
    export = read(tmp_path, text(lines, header=("time", "u", "y", header)))
    assert [len(record) for record in export.records] == [5, 6]


def test_the_measured_quality_of_a_product_says_nothing_of_others(tmp_path):
    lines = [[time, u, y, f"9{k % 3}.5"] for k, (time, u, y) in enumerate(rows())]
    assert_whole(read(tmp_path, text(lines, header=("time", "u", "y", "Quality"))))


def test_value_and_quality_of_one_item_belong_together(tmp_path):
    lines = [
        [time, u, "GOOD", "0" if k == 5 else y, "BAD" if k == 5 else "GOOD"]
        for k, (time, u, y) in enumerate(rows())
    ]
    header = ("time", "F1.MV.Value", "F1.MV.Quality", "T1.PV.Value", "T1.PV.Quality")
    export = read(tmp_path, text(lines, header=header), inputs="F1.MV.Value", outputs="T1.PV.Value")
    assert [len(record) for record in export.records] == [5, 6]


def test_a_number_named_good_is_no_good_byte_of_opc(tmp_path):
    lines = [[time, u, "0", y, "0" if k == 5 else "192"] for k, (time, u, y) in enumerate(rows())]
    export = read(tmp_path, text(lines, header=("time", "u", "u.Status", "y", "y.OPCQuality")), good="0")
    assert [len(record) for record in export.records] == [5, 6]


def test_a_quality_that_says_nothing_known_is_asked_about(tmp_path):
    lines = [[time, u, y, str(k % 2)] for k, (time, u, y) in enumerate(rows())]
    content = text(lines, header=("time", "u", "y", "Quality"))
    with pytest.raises(MampcError, match=r"which values of u, y are good, but not how: '0' \(6\), '1' \(6\)"):
        read(tmp_path, content)
    with pytest.raises(MampcError, match="expected consecutive rows"):
        read(tmp_path, content, good="1")


def test_a_row_of_nothing_is_a_missing_sample(tmp_path):
    lines = [[u, y] for _, u, y in rows()]
    lines[5] = ["", ""]
    export = read(tmp_path, text(lines, header=("u", "y")), dt=60.0)
    assert [len(record) for record in export.records] == [5, 6]


def test_rows_swallowed_by_a_quotation_mark_are_noticed(tmp_path):
    lines = [[*row, '"3/4' if k == 3 else '"' if k == 6 else "ok"] for k, row in enumerate(rows())]
    with pytest.raises(MampcError, match="received a quoted field of several lines in row 8"):
        read(tmp_path, text(lines, header=("time", "u", "y", "remark")))


def test_two_numbers_in_one_cell_are_none(tmp_path):
    lines = [[time, '"1\n2"' if k == 3 else u, y] for k, (time, u, y) in enumerate(rows())]
    with pytest.raises(MampcError, match="received a quoted field of several lines in row 6"):
        read(tmp_path, text(lines))
    frame = pd.DataFrame({"u": [str(u) for u in U], "y": Y})
    frame.loc[3, "u"] = "1\n2"
    with pytest.raises(MampcError, match=r"expected a number in row \d, column 'u', received '1\\n2'"):
        read_export(frame, inputs="u", outputs="y", dt=60.0)


def test_missing_columns_are_all_named_with_a_guess(tmp_path):
    with pytest.raises(MampcError) as refusal:
        read(tmp_path, text(rows(), header=("time", "Valve", "Level")), inputs="valve", outputs="Levl")
    assert "'valve' and one 'Levl', received columns ['time', 'Valve', 'Level']" in str(refusal.value)
    assert "did you mean 'Valve' for 'valve'?; did you mean 'Level' for 'Levl'?" in str(refusal.value)


def test_tags_in_rows_are_told_from_missing_columns(tmp_path):
    lines = [[time, tag, value, value] for time, u, y in rows() for tag, value in (("u", u), ("y", y))]
    with pytest.raises(MampcError, match="they stand in its rows: save one column a signal"):
        read(tmp_path, text(lines, header=("time", "tag", "a", "b")))


def test_a_column_of_times_for_each_signal_counts_only_where_all_are_the_same(tmp_path):
    lines = [[time, u, time, y] for time, u, y in rows()]
    assert_whole(read(tmp_path, text(lines, header=("time", "u", "time", "y"))))
    lines[6][2] = lines[6][2][:-2] + "30"
    with pytest.raises(MampcError, match="expected one column of times"):
        read(tmp_path, text(lines, header=("time", "u", "time", "y")))


def test_a_negative_mark_among_large_positive_values(tmp_path):
    y = np.where(np.arange(len(U)) == 5, -9999.0, 1e4 * np.arange(len(U)))
    assert [len(record) for record in read(tmp_path, text(rows(y=y))).records] == [5, 6]


@pytest.mark.parametrize("column", [1, 2])
def test_short_gaps_are_closed_only_where_asked_and_told(tmp_path, column):
    lines = rows(u=np.arange(12.0), y=2 * np.arange(12.0))
    lines[3][column] = lines[4][column] = "Bad"
    del lines[8]
    assert [len(record) for record in read(tmp_path, text(lines)).records] == [3, 3, 3]
    assert [len(record) for record in read(tmp_path, text(lines), fill=1).records] == [3, 7]
    export = read(tmp_path, text(lines), fill=2)
    [record] = export.records
    np.testing.assert_allclose(record.y[:, 0], 2 * np.arange(12.0))
    held = np.array([0, 1, 2, *((2, 2) if column == 1 else (3, 4)), 5, 6, 7, 7, 9, 10, 11.0])
    np.testing.assert_allclose(record.u[:, 0], held)
    assert told(export, f"{'uy'[column - 1]}: 2 missing values put in")
    assert told(export, "1 gap of up to 2 samples closed, after row 9")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"decimal": ";"}, "decimal: expected"),
        ({"time": "when"}, "time: expected a column of the file, received 'when'"),
        ({"time_unit": "fortnight"}, "time_unit: expected one of"),
        ({"time_zone": "Mars/Olympus"}, "time_zone: expected a name"),
        ({"time_format": "%d.%m.%Y"}, "expected times in column 'time'"),
        ({"ranges": {"z": (0, 1)}}, "ranges: expected names among"),
        ({"ranges": {"u": (1, 0)}}, "expected the lowest value first"),
        ({"fill": -1}, "fill: expected a whole number"),
        ({"ranges": {"u": 5}}, "expected a lowest and a highest value"),
    ],
)
def test_wrong_options_are_refused_by_name(tmp_path, options, message):
    with pytest.raises(MampcError, match=message):
        read(tmp_path, text(rows()), **options)


def test_units_do_not_matter(tmp_path):
    lines = rows()
    lines[5][2] = "-9999"
    export = read(tmp_path, text(lines))
    for scale in (1e-8, 1e8):
        scaled = [
            [time, repr(float(u) * scale), y if y == "-9999" else repr(float(y) * scale)]
            for time, u, y in lines
        ]
        again = read(tmp_path, text(scaled))
        assert [len(record) for record in again.records] == [len(record) for record in export.records]
        for one, other in zip(export.records, again.records, strict=True):
            np.testing.assert_allclose(other.y, scale * one.y)


def test_plain_records_are_read_without_a_warning_and_without_pandas(tmp_path):
    path = tmp_path / "record.csv"
    IOData(U, Y, 60.0).to_csv(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mampc.IOData.from_csv(path, inputs="u1", outputs="y1")
    code = (
        f"import sys, mampc; mampc.IOData.from_csv({str(path)!r}, inputs='u1', outputs='y1'); "
        "sys.exit('pandas' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
