"""Times in exports: forms, zones, gaps, jitter, order."""

import subprocess
import sys

import numpy as np
import pytest

from mampc import IOData, MampcError, read_export
from seeds import deep
from small_exports import U, Y, assert_whole, read, rows, stamps, text, told, write

pd = pytest.importorskip("pandas")


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S", "%Y-%m-%dT%H:%M:%S.%fZ", "%Y-%m-%d %H:%M:%S+02:00", "%Y/%m/%d %H:%M",
        "%d.%m.%Y %H:%M:%S", "%d/%m/%Y %H:%M", "%m/%d/%Y %I:%M:%S %p", "%d-%b-%y %H:%M:%S", "%d-%b-%Y %H:%M:%S.%f",
        "%d.%m.%y %H:%M", "%b %d %Y %H:%M:%S", "%H:%M:%S", "%Y%m%dT%H%M%S",
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["Zeitstempel", *deep("time", "when")])
def test_time_stamps_under_any_name(tmp_path, form, name):
    assert_whole(read(tmp_path, text(rows(stamps(form=form)), ";", (name, "u", "y"))))


def test_dates_and_times_in_two_columns(tmp_path):
    lines = [[*time.split(" "), u, y] for time, u, y in rows(stamps(dt=7200.0))]
    assert_whole(read(tmp_path, text(lines, header=("Date", "Time", "u", "y"))), dt=7200.0)


@pytest.mark.parametrize(
    "form", ["%Y-%jT%H:%M:%S", "%Y-%j %H:%M:%S", "%Y/%j %H:%M", "%Y:%j:%H:%M:%S", "%Y-%jT%H:%M:%SZ"]
)
def test_days_of_the_year_go_on_over_its_end(tmp_path, form):
    export = read(tmp_path, text(rows(stamps(start="2024-12-31 23:55:00", form=form))))
    assert_whole(export)
    assert export.starts[0].startswith("2024-12-31 23:55:00")
    with pytest.raises(MampcError, match="expected times in column 'time'"):
        read(tmp_path, text(rows([f"2023-366T00:{k:02d}:00" for k in range(len(U))])))


@pytest.mark.parametrize(
    ("form", "header"),
    [
        ("%m/%d/%Y %H %M", ("Date", "Hour", "Minute")),
        ("%Y-%m-%d %H %M %S", ("DATE", "HH", "min", "Sec [s]")),
        ("%Y %m %d %H %M", ("Year", "Month", "Day", "Hour", "Minute")),
        ("%Y %j %H %M", ("YEAR", "DOY", "HOUR", "MINUTE")),
    ],
)
@pytest.mark.parametrize("zeros", [True, False])
def test_hours_and_minutes_in_columns_of_their_own(tmp_path, form, header, zeros):
    times = stamps(start="2024-02-29 22:40:00", form=form)
    cells = [
        [part if zeros or "/" in part or "-" in part else str(int(part)) for part in t.split()] for t in times
    ]
    export = read(
        tmp_path,
        text([[*c, *r[1:]] for c, r in zip(cells, rows(times), strict=True)], header=(*header, "u", "y")),
    )
    assert_whole(export)
    assert export.starts[0].startswith("2024-02-29 22:40:00")


def test_a_column_called_hour_beside_stamps_or_with_other_numbers_is_no_time(tmp_path):
    lines = [[time, "1.5", "3", *rest] for time, *rest in rows(stamps())]
    assert_whole(read(tmp_path, text(lines, header=("time", "hour", "minute", "u", "y"))))
    lines = [[time, "30.5", *rest] for time, *rest in rows(stamps(dt=86400.0, form="%Y-%m-%d"))]
    assert_whole(read(tmp_path, text(lines, header=("date", "hour", "u", "y"))), dt=86400.0)


@pytest.mark.parametrize("form", ["%H:%M:%S", "%H:%M", "%I:%M:%S %p"])
@pytest.mark.parametrize("newest_first", [False, True])
def test_times_without_a_date_go_on_the_next_day_past_midnight_and_that_is_told(tmp_path, form, newest_first):
    lines = rows(stamps(start="2024-04-13 23:55:00", form=form))
    export = read(tmp_path, text(lines[::-1] if newest_first else lines))
    assert_whole(export)
    assert told(export, "have no date", "next day" if not newest_first else "previous day")
    assert told(export, "are hours and minutes") == (form == "%H:%M")


def test_a_gap_past_midnight_stays_a_gap_and_times_that_go_back_by_day_are_refused(tmp_path):
    lines = rows(stamps(start="2024-04-13 23:55:00", form="%H:%M:%S"))
    assert [len(record) for record in read(tmp_path, text(lines[:4] + lines[8:])).records] == [4, 4]
    lines = rows(stamps(form="%H:%M:%S"))
    with pytest.raises(MampcError, match="have no date and go back in row 8; add a date"):
        read(tmp_path, text(lines[6:] + lines[:6]))


@pytest.mark.parametrize(
    ("start", "form", "name"),
    [
        ("09:30:00", "%M:%S", "time"),
        ("09:05:00", "%M:%S.0", "time"),
        ("09:00:00", "%M:%S", "elapsed (mm:ss)"),
    ],
)
def test_minutes_and_seconds_are_known_by_their_size_their_parts_or_their_name(tmp_path, start, form, name):
    times = stamps(dt=10.0, start=f"2024-04-13 {start}", form=form)
    export = read(tmp_path, text(rows(times), header=(name, "u", "y")))
    assert_whole(export, dt=10.0)
    assert told(export, f"times such as {times[0]!r}", "are minutes and seconds")


@pytest.mark.parametrize("options", [{}, {"time_format": "%M:%S"}])
def test_minutes_that_begin_again_are_refused(tmp_path, options):
    with pytest.raises(
        MampcError, match="have no hour and no date, and begin again in row 4; save them with both"
    ):
        read(tmp_path, text(rows(stamps(form="%M:%S"))), **options)


@pytest.mark.parametrize("form", ["%Y-%m-%d %H:%M:%S", "%d.%m.%Y %H:%M", "%H:%M:%S"])
def test_a_day_may_end_at_24(tmp_path, form):
    times = stamps(start="2024-04-13 23:55:00", form=form)
    times[5] = times[4].replace("23:59", "24:00")
    assert_whole(read(tmp_path, text(rows(times))))


@pytest.mark.parametrize(
    ("am", "pm"), [("a.m.", "p.m."), ("a. m.", "p.\u00a0m."), ("上午", "下午"), ("πμ", "μμ")]
)
def test_halves_of_days_in_other_words(tmp_path, am, pm):
    times = stamps(start="2024-04-13 11:55:00", form="%d/%m/%Y %I:%M:%S %p")
    times = [time.replace("AM", am).replace("PM", pm) for time in times]
    assert_whole(read(tmp_path, text(rows(times))))
    front = [" ".join([time.split(" ")[0], time.split(" ", 2)[2], time.split(" ")[1]]) for time in times]
    assert_whole(read(tmp_path, text(rows(front))))


def test_halves_of_days_that_are_not_told_apart_are_refused(tmp_path):
    times = stamps(start="2024-04-13 12:55:00", form="%d/%m/%Y %I:%M:%S")
    with pytest.raises(MampcError, match="go back twelve hours before row 7; save them with 24 hours"):
        read(tmp_path, text(rows(times)))


@pytest.mark.parametrize(
    "header", ["elapsed minutes", "Time in min", "t/min", "Zeit, min", "Zeit in Minuten"]
)
def test_a_unit_in_words_of_the_name_counts_and_is_told(tmp_path, header):
    export = read(tmp_path, text(rows(range(len(U))), ";", (header, "u", "y")))
    assert_whole(export)
    assert told(export, "are in min")


@pytest.mark.parametrize(
    ("start", "form", "scale", "hint"),
    [
        ("2024-04-13 09:55:00", "%H%M%S", 1, "digits seem to be those of a clock"),
        ("2024-04-13 09:55:00", "%y%m%d%H%M", 1, "digits seem to be those of a clock"),
        ("2024-04-13 09:55:00", "%H.%M", 1, "digits seem to be those of a clock"),
        (None, 45000.0, 1 / 24, "seconds or days of a spreadsheet"),
        (None, 45000, 1, "seconds or days of a spreadsheet"),
        (None, 0.0, 1 / 1440, "parts of a second, an hour or a day"),
        (None, 0.4, 1 / 60, "parts of a second, an hour or a day"),
    ],
)
def test_numbers_that_may_be_days_hours_or_digits_of_a_clock_are_asked_about(
    tmp_path, start, form, scale, hint
):
    times = stamps(start=start, form=form) if start else [f"{form + scale * k:.8g}" for k in range(len(U))]
    with pytest.raises(MampcError, match=hint):
        read(tmp_path, text(rows(times)))
    read(tmp_path, text(rows(times)), time_unit="s")


def test_even_seconds_are_no_digits_of_a_clock(tmp_path):
    assert_whole(read(tmp_path, text(rows([50 * k for k in range(len(U))]))), dt=50.0)
    assert len(read(tmp_path, text(rows([50 * k + 200 * (k > 4) for k in range(len(U))]))).records) == 2


def test_dates_that_stand_only_where_they_change_hold(tmp_path):
    times = stamps(start="2024-04-13 23:55:00", form="%H:%M:%S")
    dates = {0: "2024-04-13", 5: "2024-04-14"}
    lines = [[dates.get(k, ""), *row] for k, row in enumerate(rows(times))]
    export = read(tmp_path, text(lines, header=("date", "hour", "u", "y")))
    assert_whole(export)
    assert told(export, "dates in column 'date' held in 10 rows")


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


def test_dates_of_which_a_spreadsheet_exchanged_day_and_month_are_refused(tmp_path):
    times = stamps(dt=6 * 3600.0, start="2024-04-11 12:00:00", form="%d/%m/%Y %H:%M")
    times = [f"{t[3:5]}/{t[:2]}{t[5:]}" if int(t[:2]) <= 12 else t for t in times]
    with pytest.raises(
        MampcError, match="have the day first, and are even only if some have the month first"
    ):
        read(tmp_path, text(rows(times)))


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


def test_plain_stamps_need_no_pandas_and_say_what_others_say(tmp_path):
    code = ["import sys, mampc"]
    for number, form in enumerate(("%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M", "%Y-%m-%d %H:%M:%S.%f")):
        path = write(tmp_path, text(rows(stamps(form=form)))).rename(tmp_path / f"{number}.csv")
        assert_whole(read_export(path, inputs="u", outputs="y", time_format=form))
        code.append(f"assert mampc.IOData.from_csv({str(path)!r}, inputs='u', outputs='y').dt == 60.0")
    code.append("assert 'pandas' not in sys.modules")
    subprocess.run([sys.executable, "-c", "; ".join(code)], check=True, timeout=60)


@pytest.mark.parametrize("wrong", ["2024-02-30 10:00:00", "2024-04-13 25:00:00", "", "Total"])
def test_a_stamp_that_is_none_is_left_out_and_told(tmp_path, wrong):
    times = stamps()
    times[11] = wrong
    export = read(tmp_path, text(rows(times)))
    assert [len(record) for record in export.records] == [11]
    assert told(export, "no time can be read in row 13")


def test_times_of_their_own_for_each_column_are_refused(tmp_path):
    lines = [[time, u, time.replace(":00", ":07"), y] for time, u, y in rows()]
    with pytest.raises(
        MampcError, match="received 2 called 'time' with different times; export all columns at the same"
    ):
        read(tmp_path, text(lines, header=("time", "u", "time", "y")))


@pytest.mark.parametrize(
    "stamp",
    [
        "0001-01-01T00:{:02d}:00+05:00",  # in UTC a year before the first
        "9999-12-31 24:{:02d}:00",
        "0000-04-13 09:{:02d}:00",
    ],
)
def test_times_that_no_date_has_are_told(tmp_path, stamp):
    lines = rows([stamp.format(k if "24:" not in stamp else 0) for k in range(len(U))])
    with pytest.raises(MampcError, match="expected times in column 'time'"):
        read(tmp_path, text(lines))


def test_a_format_with_a_field_twice_is_refused(tmp_path):
    with pytest.raises(MampcError, match="time_format: expected a format as strptime has it"):
        read(tmp_path, text(rows(stamps())), time_format="%Y-%m-%d %H:%M:%S %H")
