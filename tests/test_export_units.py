"""Units of times, counts of programs, and clocks that were set."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from mampc import MampcError, read_export
from small_exports import U, assert_whole, read, rows, stamps, text, told

pd = pytest.importorskip("pandas")


@pytest.mark.parametrize(
    ("header", "scale"),
    [("time [us]", 1e5), ("time (µs)", 1e5), ("time_us", 1e5), ("time_ns", 1e8), ("t/us", 1e5)],
)
def test_units_below_a_millisecond_are_read(tmp_path, header, scale):
    times = [round(scale * k) for k in range(len(U))]
    assert_whole(read(tmp_path, text(rows(times), ";", (header, "u", "y"))), dt=0.1)


@pytest.mark.parametrize("unit", ["0.1 s", "weeks", "ticks"])
def test_times_in_a_unit_nobody_knows_are_not_taken_as_seconds(tmp_path, unit):
    content = text(rows(range(len(U))), ";", (f"time [{unit}]", "u", "y"))
    with pytest.raises(MampcError, match=f"are in '{unit}'; expected one of ns, us, ms, s, min, h, d"):
        read(tmp_path, content)
    assert_whole(read(tmp_path, content, time_unit="min"))


@pytest.mark.parametrize(
    ("name", "since", "a_second"),
    [
        ("Windows", "1601-01-01", 10**7),
        (".NET", "0001-01-01", 10**7),
        ("WinCC", "1899-12-30", 1e6 / 86400),
        ("nanoseconds", "1970-01-01", 10**9),
    ],
)
@pytest.mark.parametrize("start", ["1995-01-01 00:00:00", "2025-03-12 22:50:00", "2095-06-01 00:00:00"])
def test_counts_of_programs_since_their_year_are_known_by_their_size(tmp_path, name, since, a_second, start):
    first = (datetime.fromisoformat(start) - datetime.fromisoformat(since)) // timedelta(seconds=1)
    times = [
        f"{(first + 60 * k) * a_second:.3f}" if a_second < 12 else (first + 60 * k) * a_second
        for k in range(len(U))
    ]
    export = read(tmp_path, text(rows(times)))
    assert told(export, name)
    assert_whole(export)


@pytest.mark.parametrize(
    "form", ["%G-W%V-%u %H:%M:%S", "%y/%m/%d %H:%M:%S", "%d/%m/%Y %H:%M:%S:%f", "%m/%d/%Y %I:%M:%S %p +0200"]
)
def test_weeks_short_years_first_and_parts_of_seconds_behind_colons_are_read(tmp_path, form):
    assert_whole(read(tmp_path, text(rows(stamps(start="2025-03-12 23:55:00", form=form)))))


def test_a_clock_that_is_set_once_does_not_change_the_sample_time(tmp_path):
    seconds = np.arange(300.0) * 60 + 27.0 * (np.arange(300) >= 100)
    frame = pd.DataFrame({"time": seconds, "u": np.arange(300) % 2, "y": np.arange(300) * 0.1})
    assert read_export(frame, inputs=["u"], outputs=["y"]).records[0].dt == 60.0
