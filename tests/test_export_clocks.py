"""Clocks that are put forward and back, zones and offsets."""

import pytest

from mampc import MampcError
from small_exports import U, assert_whole, read, rows, stamps, text, told

pd = pytest.importorskip("pandas")


def test_a_clock_put_back_while_samples_are_missing_is_told(tmp_path):
    moments = pd.date_range("2024-10-26 22:30", periods=400, freq="1min", tz="UTC").tz_convert(
        "Europe/Berlin"
    )
    lines = [
        [f"{t:%Y-%m-%d %H:%M:%S}", f"{k % 7}", f"{k}"] for k, t in enumerate(moments) if not 145 <= k < 160
    ]
    export = read(tmp_path, text(lines))
    assert [len(record) for record in export.records] == [145, 240]
    assert told(export, "the clock goes back an hour after 2024-10-27 02:54:00")
    assert told(export, "samples missing: 15 after")
    swapped = [*lines[:30], *lines[31:60], lines[30], *lines[60:]]  # one row that comes half an hour late
    assert not told(read(tmp_path, text(swapped[:140])), "the clock goes back")


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


def test_the_first_and_the_last_year_have_no_time_zone(tmp_path):
    lines = rows([f"0001-01-01 00:{k:02d}:00" for k in range(len(U))])
    with pytest.raises(MampcError, match="expected times in column 'time'"):
        read(tmp_path, text(lines), time_zone="Pacific/Auckland")
