"""Exports: what is read of each kind of file, what is told of it, and what is refused with which rows."""

import datetime
import subprocess
import sys
import warnings

import numpy as np
import pytest

import mampc
from mampc import IOData, MampcError, read_export

pd = pytest.importorskip("pandas")
U = np.array([5, 5, 5, 8, 8, 8, 8, 5, 5, 8, 8, 5.0])
Y = np.round(20 + np.cumsum(U - 6.5) / 8, 3)


def stamps(samples=12, dt=60.0, start="2024-04-13 09:58:00", form="%Y-%m-%d %H:%M:%S"):
    first = datetime.datetime.fromisoformat(start)
    return [(first + datetime.timedelta(seconds=k * dt)).strftime(form) for k in range(samples)]


def rows(times=None, u=U, y=Y):
    return [
        [str(time), str(a), str(b)]
        for time, a, b in zip(stamps() if times is None else times, u, y, strict=True)
    ]


def text(lines, separator=",", header=("time", "u", "y")):
    return "\n".join(separator.join(line) for line in [header, *lines]) + "\n"


def write(folder, content, encoding="utf-8"):
    path = folder / "export.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def read(folder, content, encoding="utf-8", inputs="u", outputs="y", **options):
    return read_export(write(folder, content, encoding), inputs=inputs, outputs=outputs, **options)


def told(export, *words):
    """Whether one note has all the words."""
    return any(all(word in note for word in words) for note in export.notes)


def assert_whole(export, dt=60.0):
    [record] = export.records
    assert record.dt == dt
    assert np.array_equal(record.u[:, 0], U)
    assert np.array_equal(record.y[:, 0], Y)


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


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%d %H:%M:%S+02:00", "%Y/%m/%d %H:%M",
        "%d.%m.%Y %H:%M:%S", "%d/%m/%Y %H:%M", "%m/%d/%Y %I:%M:%S %p", "%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S.%f",
        "%d.%m.%y %H:%M", "%b %d %Y %H:%M:%S", "%H:%M:%S", "%Y%m%dT%H%M%S",
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["time", "Zeitstempel", "when"])
def test_time_stamps_under_any_name(tmp_path, form, name):
    assert_whole(read(tmp_path, text(rows(stamps(form=form)), ";", (name, "u", "y"))))


def test_dates_and_times_in_two_columns(tmp_path):
    lines = [[*time.split(" "), u, y] for time, u, y in rows(stamps(dt=7200.0))]
    assert_whole(read(tmp_path, text(lines, header=("Date", "Time", "u", "y"))), dt=7200.0)


def test_times_of_the_day_that_run_past_midnight_are_refused(tmp_path):
    with pytest.raises(MampcError, match="have no date and run past midnight"):
        read(tmp_path, text(rows(stamps(start="2024-04-13 23:55:00", form="%H:%M:%S"))))


@pytest.mark.parametrize(
    ("header", "scale", "options"),
    [
        ("time", 1.0, {}),
        ("elapsed", 1.0, {}),
        ("Laufzeit", 1.0, {}),
        ("time [min]", 1 / 60, {}),
        ("time_ms", 1000.0, {}),
        ("time", 1 / 3600, {"time_unit": "h"}),
        ("wann", 1.0, {"time": "wann"}),
    ],
)
def test_numeric_times(tmp_path, header, scale, options):
    times = [repr(60.0 * k * scale) for k in range(len(U))]
    assert_whole(read(tmp_path, text(rows(times), header=(header, "u", "y")), **options))


def test_unix_times_in_milliseconds_are_known_and_other_large_numbers_refused(tmp_path):
    assert_whole(read(tmp_path, text(rows([1.7e12 + 60_000 * k for k in range(len(U))]))))
    compact = stamps(form="%Y%m%d%H%M%S")
    with pytest.raises(MampcError, match=r"numbers as large as 2024\d+; .*--time-format"):
        read(tmp_path, text(rows(compact)))
    assert_whole(read(tmp_path, text(rows(compact)), time_format="%Y%m%d%H%M%S"))
    days = [repr(45000 + k / 1440) for k in range(len(U))]
    with pytest.raises(MampcError, match="seconds or days of a spreadsheet"):
        read(tmp_path, text(rows(days)))
    assert_whole(read(tmp_path, text(rows(days)), time_unit="d"))


def test_a_count_of_rows_is_no_time(tmp_path):
    with pytest.raises(MampcError, match="expected a column of times"):
        read(tmp_path, text(rows(range(len(U))), header=("nr", "u", "y")))
    assert_whole(read(tmp_path, text(rows(range(len(U))), header=("nr", "u", "y")), dt=60.0))


def test_day_and_month_are_told_apart_by_even_steps(tmp_path):
    export = read(tmp_path, text(rows(stamps(dt=86400.0, start="2024-04-01", form="%d/%m/%Y"))))
    assert_whole(export, 86400.0)
    assert told(export, "day first: only so are they even")
    assert told(
        read(tmp_path, text(rows(stamps(form="%m/%d/%Y %H:%M", start="2024-04-05")))),
        "the steps are the same",
    )


def local(samples, zone="Europe/Berlin", start="2024-10-27 01:30:00", dt=600.0):
    times = pd.date_range(start, periods=samples, freq=f"{dt:g}s", tz=zone)
    return times.strftime("%d.%m.%Y %H:%M:%S").tolist()


@pytest.mark.parametrize("newest_first", [False, True])
@pytest.mark.parametrize("options", [{}, {"time_zone": "Europe/Berlin"}])
def test_the_doubled_hour_in_autumn(tmp_path, options, newest_first):
    lines = rows(local(len(U)))
    export = read(tmp_path, text(lines[::-1] if newest_first else lines), **options)
    assert_whole(export, 600.0)
    assert bool(options) or told(export, "the clock goes back an hour", "end of summer time")


@pytest.mark.parametrize("twice", [3, 4])
def test_an_hourly_row_that_stands_twice_on_a_sunday_night_is_not_the_doubled_hour(tmp_path, twice):
    lines = rows(stamps(dt=3600.0, start="2024-04-13 22:00:00"))
    export = read(tmp_path, text(lines[: twice + 1] + lines[twice:]))
    assert_whole(export, 3600.0)
    assert told(export, f"times stand more than once in row {twice + 3}")


def test_the_doubled_hour_of_hourly_rows(tmp_path):
    times = pd.date_range("2024-10-26 22:00", periods=len(U), freq="h", tz="Europe/Berlin")
    export = read(tmp_path, text(rows(times.strftime("%d.%m.%Y %H:%M").tolist())))
    assert_whole(export, 3600.0)


def test_the_missing_hour_in_spring_is_a_gap_unless_the_zone_is_known(tmp_path):
    content = text(rows(local(len(U), start="2024-03-31 01:00:00")))
    assert len(read(tmp_path, content).records) == 2
    assert_whole(read(tmp_path, content, time_zone="Europe/Berlin"), 600.0)


def test_doubled_times_that_nothing_tells_apart_are_not_used(tmp_path):
    lines = sorted(rows(local(len(U))))
    with pytest.raises(MampcError, match=r"received \d+ of \d+ times more than once"):
        read(tmp_path, text(lines))
    with pytest.raises(MampcError, match="doubled hour at the end of summer time"):
        read(tmp_path, text(lines), time_zone="Europe/Berlin")


def test_offsets_from_utc_count(tmp_path):
    times = pd.date_range("2024-10-27 01:30", periods=len(U), freq="600s", tz="Europe/Berlin")
    assert_whole(read(tmp_path, text(rows([time.isoformat() for time in times]))), 600.0)
    mixed = [
        time.isoformat() if k % 2 else time.strftime("%Y-%m-%d %H:%M:%S") for k, time in enumerate(times)
    ]
    with pytest.raises(MampcError, match="have an offset from UTC"):
        read(tmp_path, text(rows(mixed)))


def test_a_sample_time_that_contradicts_the_times_is_refused(tmp_path):
    with pytest.raises(MampcError, match="dt: expected 60 s, the step of column 'time', received 10 s"):
        read(tmp_path, text(rows()), dt=10.0)
    assert_whole(read(tmp_path, text(rows()), dt=60.0))


def test_gaps_split_the_record_and_are_told(tmp_path):
    lines = rows()
    export = read(tmp_path, text(lines[:5] + lines[7:]))
    assert [len(record) for record in export.records] == [5, 5]
    assert export.starts == ("2024-04-13 09:58:00", "2024-04-13 10:05:00")
    assert told(export, "1 gap", "2 after row 6 (2024-04-13 10:02:00)")
    np.testing.assert_array_equal(export.records[1].y[:, 0], Y[7:])


def test_one_record_is_asked_for_and_several_are_there(tmp_path):
    lines = rows()
    path = write(tmp_path, text(lines[:5] + lines[7:]))
    with pytest.raises(
        MampcError, match=r"received 2 pieces of 5, 5 samples .*read_export\(\.\.\.\)\.records"
    ):
        IOData.from_csv(path, inputs="u", outputs="y")


MARKS = (
    "Bad", "bad input", "No Data", "I/O Timeout", "", "NaN", "inf", "-Infinity", "1e999", "-9999", "-9999.0", "#N/A",
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
    ],
)
def test_values_of_bad_quality_are_not_used(tmp_path, header, good, bad):
    lines = [[time, u, good, y, bad if k == 5 else good] for k, (time, u, y) in enumerate(rows())]
    export = read(tmp_path, text(lines, header=header))
    assert [len(record) for record in export.records] == [5, 6]
    assert told(export, "taken as the quality of y")


def test_a_quality_that_says_nothing_known_is_asked_about(tmp_path):
    lines = [[time, u, y, str(k % 2)] for k, (time, u, y) in enumerate(rows())]
    content = text(lines, header=("time", "u", "y", "Quality"))
    with pytest.raises(MampcError, match=r"which values of u, y are good, but not how: '0' \(6\), '1' \(6\)"):
        read(tmp_path, content)
    with pytest.raises(MampcError, match="expected consecutive rows"):
        read(tmp_path, content, good="1")


@pytest.mark.parametrize("order", ["backwards", "mixed"])
def test_rows_out_of_order_are_put_in_order_and_told(tmp_path, order):
    lines = rows()
    if order == "backwards":
        lines = lines[::-1]
    else:
        lines[2], lines[7] = lines[7], lines[2]
    export = read(tmp_path, text(lines))
    assert_whole(export)
    assert told(export, "put in order")


def test_rows_that_stand_twice_count_once_and_contradictions_not_at_all(tmp_path):
    lines = rows()
    export = read(tmp_path, text([*lines[:4], lines[3], *lines[4:]]))
    assert_whole(export)
    assert told(export, "times stand more than once in row 6")
    export = read(tmp_path, text([*lines[:4], [lines[3][0], "5.0", "77"], *lines[4:]]))
    assert [len(record) for record in export.records] == [3, 8]
    assert told(export, "row 6 contradict")
    export = read(tmp_path, text([*lines[:4], [lines[3][0], "Bad", ""], *lines[4:]]))
    assert_whole(export)


def test_jitter_is_resampled_and_told(tmp_path):
    rng = np.random.default_rng(0)
    n = 400
    times = 60.0 * np.arange(n) + rng.uniform(-12, 12, n)
    u = np.repeat(rng.integers(0, 2, n // 8), 8).astype(float)

    def level(t):
        return 20 + 3 * np.sin(t / 700)

    export = read(
        tmp_path,
        text([[repr(float(t)), str(a), repr(float(level(t)))] for t, a in zip(times, u, strict=True)]),
    )
    [record] = export.records
    assert record.dt == 60.0
    assert told(export, "stray by up to", "resampled")
    at = times[0] + 60.0 * np.arange(len(record))
    np.testing.assert_allclose(record.y[:, 0], level(at), atol=0.01)
    assert np.mean(record.u[: n - 5, 0] == u[: n - 5]) > 0.97


def test_next_to_no_jitter_leaves_the_values(tmp_path):
    export = read(tmp_path, text(rows([60 * k + 0.003 * (k % 3) for k in range(len(U))])))
    assert_whole(export)
    assert told(export, "taken as even")


def test_a_clock_that_is_a_little_slow_keeps_its_own_step(tmp_path):
    n = 3000
    content = text([[repr(10.02 * k), str(k % 7), str(k % 5)] for k in range(n)])
    export = read(tmp_path, content)
    assert export.records[0].dt == 10.02
    [record] = read(tmp_path, content, dt=10.0).records
    assert (record.dt, len(record)) == (10.0, 3006)


def test_uneven_times_are_refused(tmp_path):
    rng = np.random.default_rng(1)
    lines = rows(np.cumsum(rng.exponential(60.0, len(U))))
    with pytest.raises(
        MampcError, match=r"evenly increasing time column, received in 'time' steps of .* before row"
    ):
        read(tmp_path, text(lines))


def test_two_columns_of_times_are_asked_about(tmp_path):
    lines = [[time, other, u, y] for (time, u, y), other in zip(rows(), stamps(dt=61.0), strict=True)]
    content = text(lines, header=("measured", "stored", "u", "y"))
    with pytest.raises(MampcError, match="expected one column of times, received 'measured', 'stored'"):
        read(tmp_path, content)
    assert_whole(read(tmp_path, content, time="measured"))


def test_rows_without_a_time_are_left_out_and_told(tmp_path):
    lines = rows()
    lines[4][0] = ""
    export = read(tmp_path, text(lines))
    assert [len(record) for record in export.records] == [4, 7]
    assert told(export, "no time can be read in row 6")


def test_a_row_of_nothing_is_a_missing_sample(tmp_path):
    lines = [[u, y] for _, u, y in rows()]
    lines[5] = ["", ""]
    export = read(tmp_path, text(lines, header=("u", "y")), dt=60.0)
    assert [len(record) for record in export.records] == [5, 6]


def test_rows_swallowed_by_a_quotation_mark_are_noticed(tmp_path):
    lines = [[*row, '"3/4' if k == 3 else '"' if k == 6 else "ok"] for k, row in enumerate(rows())]
    with pytest.raises(MampcError, match="received a quoted field of several lines in row 8"):
        read(tmp_path, text(lines, header=("time", "u", "y", "remark")))


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
        ({"time_unit": "week"}, "time_unit: expected one of"),
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
    with pytest.raises(MampcError, match="expected a readable Excel file"):
        read_export(path, inputs="u", outputs="y")


def test_parquet_files(tmp_path):
    pytest.importorskip("pyarrow")
    path = tmp_path / "export.parquet"
    frame().set_index("when").to_parquet(path)
    assert_whole(read_export(path, inputs="u", outputs="y"))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(MampcError, match="expected a readable Parquet file"):
        read_export(path, inputs="u", outputs="y")


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


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M", "%Y-%m-%d %H:%M:%S.%f"])
def test_plain_stamps_need_no_pandas_and_say_what_others_say(tmp_path, form):
    path = write(tmp_path, text(rows(stamps(form=form))))
    code = (
        f"import sys, mampc; record = mampc.IOData.from_csv({str(path)!r}, inputs='u', outputs='y'); "
        "sys.exit('pandas' in sys.modules or record.dt != 60.0)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
    assert_whole(read_export(path, inputs="u", outputs="y", time_format=form))


@pytest.mark.parametrize("wrong", ["2024-02-30 10:00:00", "2024-04-13 25:00:00", "", "Total"])
def test_a_stamp_that_is_none_is_left_out_and_told(tmp_path, wrong):
    times = stamps()
    times[11] = wrong
    export = read(tmp_path, text(rows(times)))
    assert [len(record) for record in export.records] == [11]
    assert told(export, "no time can be read in row 13")
