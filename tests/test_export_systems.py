"""Exports as particular systems write them, and what their texts went through."""

import bz2
import gzip
import io
import lzma
import zipfile

import numpy as np
import pytest

import mampc
from mampc import MampcError, read_export
from mampc.identification.export import inspect_export
from small_exports import U, Y, assert_whole, read, rows, stamps, text, told, write

STAMPS = stamps()
QUALITY_100 = [[time, u, "100", y, "100"] for time, u, y in rows()]
SYSTEMS = {
    "names above a block of descriptions": "Tagname,,u,y\nDescriptor,,Valve,Level\nStart,01-Apr-2024\n,,,\n"
    + text([[time, "", u, y] for time, u, y in rows()], header=("Timestamp", "", "u", "y")),
    "a table of a terminal": "  time | u | y\n------+---+---\n"
    + text([[f" {cell} " for cell in row] for row in rows()], "|", (" time ", " u ", " y "))
    + "(12 rows)\n",
    "confidence in percent": text(QUALITY_100, header=("time", "u", "u Confidence", "y", "y Confidence")),
    "validity that is always 1": text(
        [[time, u, "1", y, "1"] for time, u, y in rows()], header=("time", "u", "u.Validity", "y", "y.Validity")
    ),
    "pages with names and units": "\n".join(
        f"Page {k // 6};;\ntime;u;y\nhh:mm;%;m\n{';'.join(row)}" if k % 6 == 0 else ";".join(row)
        for k, row in enumerate(rows())
    ),
    "files put together, each with a mark of its bytes": "\ufeff"
    + text(rows()[:6])
    + "\ufeff"
    + text(rows()[6:]),
    "a mark of bytes before a row": text(rows()[:6]) + "\ufeff" + text(rows())[len(text(rows()[:6])) :],
    "Fortran": text([[time, f"{float(u):.4E}".replace("E", "D"), y] for time, u, y in rows()]),
    "zeros at the end": text(rows()) + "\0" * 500,
    "columns between spaces, the date and the time under one name": text(rows(), "  ", ("time", "u", "y")),
    "spans and means around the numbers": text(
        [["Low", "0", "0"], ["High", "100", "50"], *rows(), ["Average", "6", "20"], ["", "72", "240"]]
    ),
    "durations of MATLAB in seconds": text([[f"{60 * k} sec", u, y] for k, (_, u, y) in enumerate(rows())]),
    "durations of MATLAB": text([[f"{k} min", u, y] for k, (_, u, y) in enumerate(rows())]),
}  # fmt: skip


@pytest.mark.parametrize("form", SYSTEMS)
def test_what_systems_write_around_their_numbers(tmp_path, form):
    assert_whole(read(tmp_path, SYSTEMS[form]))


def test_text_of_four_bytes_a_letter(tmp_path):
    assert_whole(read(tmp_path, text(rows()), "utf-32"))


def zipped(*names, content="t,u,y"):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name in names:
            archive.writestr(name, content)
    return packed.getvalue()


@pytest.mark.parametrize("kind", [gzip, bz2, lzma])
def test_compressed_files_are_read_and_damaged_ones_refused(tmp_path, kind):
    packed = kind.compress(text(rows()).encode())
    assert_whole(read(tmp_path, packed))
    with pytest.raises(MampcError, match="received when unpacked"):
        read(tmp_path, packed[:-20])


def test_an_archive_of_one_file_is_read_and_another_refused(tmp_path):
    export = read(tmp_path, zipped("may/", "may/plant.csv", "__MACOSX/may/._plant.csv", content=text(rows())))
    assert_whole(export)
    assert told(export, "'may/plant.csv' read out of the archive")
    for names in ((), ("may.csv", "june.csv")):
        with pytest.raises(
            MampcError, match=f"of one file, received {len(names)}.*unpack it and name the files"
        ):
            read(tmp_path, zipped(*names))


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mampc.identification.export.text.FILE_LIMIT", 1000)
    for packed in (gzip.compress(bytes(1001)), zipped("a.csv", content=bytes(1001))):
        with pytest.raises(MampcError, match="that unpacks to"):
            read(tmp_path, packed)


def test_groups_of_thousands_as_in_india(tmp_path):
    [record] = read(tmp_path, text(rows(y=[f'"1,20,{k:03}"' for k in range(len(U))]))).records
    np.testing.assert_array_equal(record.y[:, 0], 120_000 + np.arange(len(U)))


@pytest.mark.parametrize("space", ["\u2009", "\u2007", "\u00a0", "´", " "])
def test_thousands_apart(tmp_path, space):
    u = [f"{value * 1e6:,.1f}".replace(",", space).replace(".", ",") for value in U]
    y = [f"{value * 100:,.1f}".replace(",", space).replace(".", ",") for value in Y]
    [record] = read(tmp_path, text(rows(u=u, y=y), ";")).records
    np.testing.assert_allclose(record.u[:, 0], U * 1e6)
    np.testing.assert_allclose(record.y[:, 0], np.round(Y * 100, 1))


def test_a_plain_space_may_part_two_numbers(tmp_path):
    with pytest.raises(MampcError, match="received '5 000'"):
        read(tmp_path, text(rows(u=[f"{value:.0f} 000" for value in U])))
    u = [f"{value:.0f} 000{'.5' if k == 3 else ''}" for k, value in enumerate(U)]
    [record] = read(tmp_path, text(rows(u=u))).records
    np.testing.assert_allclose(record.u[:, 0], 1000 * U + 0.5 * (np.arange(len(U)) == 3))


@pytest.mark.parametrize("confidence", ["0", "50"])
def test_what_is_less_than_certain_is_not_used(tmp_path, confidence):
    lines = [row if k != 5 else [*row[:4], confidence] for k, row in enumerate(QUALITY_100)]
    export = read(tmp_path, text(lines, header=("time", "u", "u Confidence", "y", "y Confidence")))
    assert [len(record) for record in export.records] == [5, 6]


def test_a_product_quality_in_whole_numbers_can_be_said_to_be_none_of_others(tmp_path):
    lines = [[*row, str(95 + k % 4)] for k, row in enumerate(rows())]
    path = write(tmp_path, text(lines, header=("time", "u", "y", "Quality")))
    with pytest.raises(MampcError, match=r"says nothing of others \(no_quality, --no-quality\)"):
        read_export(path, inputs="u", outputs="y")
    assert_whole(read_export(path, inputs="u", outputs="y", no_quality="Quality"))
    seen = inspect_export(path, no_quality="Quality")
    assert [column.name for column in seen.columns] == ["u", "y", "Quality"]


@pytest.mark.parametrize("named", [True, False])
def test_the_sample_time_is_that_of_the_columns_that_are_sampled(tmp_path, named):
    lines = [[time, "y", str(y)] for time, y in zip(STAMPS, Y, strict=True)]
    lines += [[STAMPS[k].replace(":00", ":17"), "u", str(U[k])] for k in (0, 3, 7, 9)]
    path = write(tmp_path, text(lines, header=("time", "tag", "value")))
    columns = {"inputs": "u", "outputs": "y"} if named else {}
    seen = inspect_export(path, on_change="u", **columns)
    assert (seen.dt, seen.doubts) == (60.0, ())
    assert [len(column.values) for column in seen.columns] == [len(Y)] * 2


def test_many_nines_are_a_mark(tmp_path):
    y = [99999999.0 if k == 5 else value for k, value in enumerate(Y)]
    export = read(tmp_path, text(rows(y=y)))
    assert [len(record) for record in export.records] == [5, 6]
    assert told(export, "1e+08")


def test_rows_of_one_column_each_are_put_together(tmp_path):
    lines = [line for time, u, y in rows() for line in ([time, u, ""], [time, "", y])]
    export = read(tmp_path, text(lines))
    assert_whole(export)
    assert told(export, "times stand more than once")


@pytest.mark.parametrize("form", ["{} Uhr", "{} GMT+0200", "{} UTC+02:00", "{}+02:00[Europe/Berlin]"])
def test_words_behind_a_time(tmp_path, form):
    assert_whole(read(tmp_path, text(rows([form.format(time) for time in STAMPS]))))


@pytest.mark.parametrize("good", ["192 - Good", "192: GOOD", "00 Good"])
def test_a_number_before_good_keeps_it_good(tmp_path, good):
    lines = [[*row, good if k != 5 else "24 - Bad"] for k, row in enumerate(rows())]
    export = read(tmp_path, text(lines, header=("time", "u", "y", "y.q")))
    assert [len(record) for record in export.records] == [5, 6]


def test_a_dash_for_a_minus(tmp_path):
    [record] = read(tmp_path, text(rows(y=[f"–{value}" for value in Y]))).records
    np.testing.assert_array_equal(record.y[:, 0], -Y)


def test_of_two_rows_of_names_the_one_above_the_numbers_is_the_header(tmp_path):
    path = write(tmp_path, SYSTEMS["names above a block of descriptions"])
    seen = inspect_export(path)
    assert (seen.time, [column.name for column in seen.columns]) == ("Timestamp", ["u", "y"])


def test_times_without_a_date_are_told_without_one(tmp_path):
    times = stamps(start="2024-04-13 23:55:00", form="%H:%M:%S")
    seen = inspect_export(write(tmp_path, text(rows(times))))
    assert (seen.start, seen.end) == ("23:55:00", "00:06:00 on day 2")
    assert read(tmp_path, text(rows(times))).starts == ("23:55:00",)


def test_columns_with_few_values_are_told_before_any_is_named(tmp_path):
    lines = [[time, u if k in (0, 6) else "", y] for k, (time, u, y) in enumerate(rows())]
    seen = inspect_export(write(tmp_path, text(lines)))
    assert seen.columns[0].verdict == "has few values: stored on change?"
    assert any("--on-change" in note for note in seen.notes)


def test_a_recorded_loop_is_a_record_to_identify_from(tmp_path):
    model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=5.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=5, control_horizon=2)
    regulator = mampc.Regulator(mampc.MPC(problem))
    with mampc.Recorder(tmp_path / "loop.csv", regulator) as recorder:
        state = regulator.initial_state()
        for k in range(12):
            state = recorder.step(state, [np.nan if k == 7 else 0.1 * k], [1.0]).state
    export = read_export(tmp_path / "loop.csv", inputs="u1", outputs="y1_measured")
    assert [len(record) for record in export.records] == [7, 4]
    assert export.records[0].dt == 5.0
    seen = inspect_export(tmp_path / "loop.csv")
    assert not seen.doubts
    with pytest.raises(MampcError, match="did you mean 'y1_measured' for 'y1'"):
        read_export(tmp_path / "loop.csv", inputs="u1", outputs="y1")


@pytest.mark.parametrize("path", [None, 5])
def test_a_recorder_wants_the_name_of_a_file(path):
    model = mampc.StateSpace([[0.9]], [[0.1]], [[1.0]], None, dt=5.0)
    problem = mampc.TrackingProblem(model, prediction_horizon=5, control_horizon=2)
    with pytest.raises(MampcError, match="path: expected the name of a file, received"):
        mampc.Recorder(path, mampc.Regulator(mampc.MPC(problem)))


def test_hidden_worksheets_are_left_out_and_told(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["written by hand"])
    for title, names in (("old", ("time", "u", "z")), ("June", ("time", "u", "y"))):
        sheet = book.create_sheet(title)
        for row in (names, *([time, float(u), float(y)] for time, u, y in rows())):
            sheet.append(row)
    book["old"].sheet_state = "hidden"
    book.save(tmp_path / "export.xlsx")
    export = read_export(tmp_path / "export.xlsx", inputs="u", outputs="y")
    assert_whole(export)
    assert told(export, "worksheet 'June' read, one of 2")
    assert told(export, "hidden worksheets left out: ['old']")
    with pytest.raises(MampcError, match=r"expected one column 'z'.*hidden worksheets left out: \['old'\]"):
        read_export(tmp_path / "export.xlsx", inputs="u", outputs="z")
