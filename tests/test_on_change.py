"""Tags that are stored only when they change: their last value holds, where the user says so."""

import numpy as np
import pytest

from mampc import MampcError
from small_exports import U, Y, read, rows, stamps, text, told

MOVES = [0, 3, 7, 9, 11]  # rows in which the input is stored


def sparse_rows():
    lines = rows()
    return [[t, u if k in MOVES else "", y] for k, (t, u, y) in enumerate(lines)]


def test_nothing_is_held_without_a_word_of_the_user(tmp_path):
    export = read(tmp_path, text(sparse_rows()), fill=3)
    assert told(export, "u has 5 values, others have some in 12 rows", "--on-change")
    with pytest.raises(MampcError, match=r"expected consecutive rows .* --on-change"):
        read(tmp_path, text([[t, "" if k % 3 else u, y] for k, (t, u, y) in enumerate(rows())]))


def test_its_last_value_holds_where_asked_for(tmp_path):
    export = read(tmp_path, text(sparse_rows()), on_change="u")
    [record] = export.records
    expected = U[[max(m for m in MOVES if m <= k) for k in range(len(U))]]
    assert np.array_equal(record.u[:, 0], expected)
    assert np.array_equal(record.y[:, 0], Y)
    assert told(export, "u: its last value held in 7 rows", "on_change")
    assert any("held" in change for change in export.changes)


def test_a_bad_value_is_not_held(tmp_path):
    lines = sparse_rows()
    lines[3][1] = "Bad"
    export = read(tmp_path, text(lines), on_change="u")
    assert [len(record) for record in export.records] == [3, 5]
    assert export.records[0].u[:, 0].tolist() == [5.0] * 3


def test_a_tall_table_with_times_of_its_own_for_each_tag(tmp_path):
    """The input is stored between the samples of the output."""
    times = stamps(samples=12)
    lines = [[time, "y", str(y)] for time, y in zip(times, Y, strict=True)]
    lines += [
        [time, "u", str(u)]
        for time, u in zip(
            stamps(samples=4, dt=180.0, start="2024-04-13 09:57:31"), [5.0, 8, 5, 8], strict=True
        )
    ]
    export = read(tmp_path, text(lines, header=("time", "tag", "value")), on_change="u")
    [record] = export.records
    assert record.dt == 60.0
    assert np.array_equal(record.y[:, 0], Y)
    assert record.u[:, 0].tolist() == [5.0] * 3 + [8.0] * 3 + [5.0] * 3 + [8.0] * 3


def test_where_all_tags_are_stored_on_change_a_sample_time_is_asked_for(tmp_path):
    values = [(0, "u", 1), (0, "y", 2), (25, "u", 3), (47, "y", 4), (60, "u", 5)]
    seconds = stamps(samples=61, dt=1.0)
    lines = [[seconds[at], tag, str(value)] for at, tag, value in values]
    table = text(lines, header=("time", "tag", "value"))
    with pytest.raises(MampcError, match="--dt"):
        read(tmp_path, table, on_change=["u", "y"])
    with pytest.raises(MampcError, match="dt: expected at most 10000000 samples in"):
        read(tmp_path, table, on_change=["u", "y"], dt=1e-9)
    [record] = read(tmp_path, table, on_change=["u", "y"], dt=10.0).records
    assert record.u[:, 0].tolist() == [1, 1, 1, 3, 3, 3, 5]
    assert record.y[:, 0].tolist() == [2, 2, 2, 2, 2, 4, 4]


def test_a_name_that_is_no_column_is_refused(tmp_path):
    with pytest.raises(MampcError, match=r"on_change: expected names among"):
        read(tmp_path, text(rows()), on_change="v")
