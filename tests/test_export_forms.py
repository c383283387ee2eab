"""Forms of exports of historians, control systems and loggers, made up: each is read as it was meant, or refused."""

import numpy as np
import pytest

import mampc
from mampc import MampcError, read_export
from mampc.identification.export import inspect_export

pd = pytest.importorskip("pandas")
U = np.repeat([45.0, 55.0, 45.0, 55.0], 5)
Y = np.round(300.0 + np.cumsum(U - 50) / 20, 3)
FIRST = pd.Timestamp("2024-05-17 13:57:00")


def stamp(k, form="%Y-%m-%d %H:%M:%S", dt=10.0):
    return (FIRST + pd.Timedelta(seconds=k * dt)).strftime(form)


def rows(line, header, end=()):
    return (
        "\r\n".join([*header, *(line(k, u, y) for k, (u, y) in enumerate(zip(U, Y, strict=True))), *end])
        + "\r\n"
    )


def read(tmp_path, content, **options):
    path = tmp_path / "export.csv"
    path.write_text(content, encoding="utf-8", newline="")
    return read_export(path, **{"inputs": "u", "outputs": "y"} | options)


def assert_whole(export, dt=10.0, factor=1.0):
    [record] = export.records
    assert record.dt == dt
    np.testing.assert_allclose(record.u[:, 0], factor * U, rtol=1e-12)
    np.testing.assert_allclose(record.y[:, 0], Y, rtol=1e-12)


def comma(value, digits=3):
    return f"{value:.{digits}f}".replace(".", ",")


TALL = {
    "interleaved": rows(
        lambda k, u, y: f"u;{stamp(k)};{u};Good\r\ny;{stamp(k)};{y};Good", ["tag;timestamp;value;quality"]
    ),
    "tag after tag": "\r\n".join(
        [
            "Variable;Zeit;Wert;Status",
            *(f"u;{stamp(k, '%d.%m.%Y %H:%M:%S')};{comma(u)};OK" for k, u in enumerate(U)),
            *(f"y;{stamp(k, '%d.%m.%Y %H:%M:%S')};{comma(y)};OK" for k, y in enumerate(Y)),
        ]
    ),
    "several columns of values": rows(
        lambda k, u, y: f"{stamp(k)},u,{u},{u},0,192\r\n{stamp(k)},y,{y},{y},0,192",
        ["DateTime,TagName,Value,vValue,Quality,QualityDetail"],
    ),
    "no name that is known": rows(lambda k, u, y: f"{stamp(k)},u,{u}\r\n{stamp(k)},y,{y}", ["T,S,X"]),
    "dates and times": rows(
        lambda k, u, y: f"u,{stamp(k, '%d.%m.%Y,%H:%M:%S')},{u}\r\ny,{stamp(k, '%d.%m.%Y,%H:%M:%S')},{y}",
        ["Tag,Date,Time,Value"],
    ),
    "a tag that nobody wants": rows(
        lambda k, u, y: f"u,{stamp(k)},{u}\r\nz,{stamp(k, dt=7.3)},1\r\ny,{stamp(k)},{y}", ["tag,time,value"]
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", TALL)
def test_a_row_for_every_value_becomes_a_column_for_every_tag_and_is_told(tmp_path, form):
    export = read(tmp_path, TALL[form])
    assert_whole(export)
    assert any("a row for every value" in note for note in export.notes)


def test_marks_qualities_and_contradictions_in_tall_tables(tmp_path):
    def line(k, u, y):
        return f"u,{stamp(k)},{u},Good\r\ny,{stamp(k)},{'Bad' if k == 4 else y},{'Bad' if k == 9 else 'Good'}"

    export = read(tmp_path, rows(line, ["tag,time,value,quality"], [f"y,{stamp(14)},1.0,Good"]))
    assert [len(record) for record in export.records] == [4, 4, 4, 5]
    assert all(record.y.min() > 290 for record in export.records)
    assert any("contradicts another row of the same time" in note for note in export.notes)


def test_tall_tables_are_inspected_tag_by_tag(tmp_path):
    path = tmp_path / "export.csv"
    path.write_text(TALL["interleaved"])
    seen = inspect_export(path)
    assert [column.name for column in seen.columns] == ["u", "y"]
    assert seen.dt == 10.0


def test_tags_at_times_of_their_own_are_refused(tmp_path):
    def line(k, u, y):
        return f"u,{stamp(k)},{u}\r\ny,{stamp(k, dt=10.3)},{y}"

    with pytest.raises(MampcError, match="expected"):
        read(tmp_path, rows(line, ["tag,time,value"]))


FORMS = {
    "groups of thousands between no-break spaces": (
        rows(lambda k, u, y: f"{stamp(k)};{u * 100:,.2f};{y}".replace(",", "\u00a0").replace(".", ","), ["time;u;y"]),
        100.0,
    ),
    "groups of thousands between apostrophes": (
        rows(lambda k, u, y: f"{stamp(k)};{u * 100:,.2f};{y}".replace(",", "'"), ["time;u;y"]),
        100.0,
    ),
    "columns between spaces": (
        rows(lambda k, u, y: f"{10 * k:7d}  {u:5.1f}  {y:9.3f} ", ["   time      u       y"]),
        1.0,
    ),
    "a line under the header": (
        rows(lambda k, u, y: f"{stamp(k)},{u},{y}", ["time,u,y", "----,--,--"], ["", "(20 rows affected)"]),
        1.0,
    ),
    "UTC in words": (rows(lambda k, u, y: f"{stamp(k)} UTC,{u},{y}", ["time,u,y"]), 1.0),
    "sums and means at the end": (
        rows(lambda k, u, y: f"{stamp(k)},{u},{y}", ["time,u,y"], ["Average,50,300", "Max,55,310"]),
        1.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_forms(tmp_path, form):
    content, factor = FORMS[form]
    assert_whole(read(tmp_path, content), factor=factor)
    path = tmp_path / "export.csv"
    assert [column.name for column in inspect_export(path).columns] == ["u", "y"]


def test_names_in_two_rows_are_joined_and_told(tmp_path):
    content = rows(lambda k, u, y: f"{stamp(k)},{u},1,{y}", [",FIC-1,,TI-1", "time,OP,PV,PV"])
    export = read(tmp_path, content, inputs="FIC-1.OP", outputs="TI-1.PV")
    assert_whole(export)
    assert any("two rows" in note for note in export.notes)
    assert [column.name for column in inspect_export(tmp_path / "export.csv").columns] == [
        "FIC-1.OP", "FIC-1.PV", "TI-1.PV"
    ]  # fmt: skip
    with pytest.raises(MampcError, match=r"'PV'.*a name that stands twice says nothing"):
        read(tmp_path, content, inputs="OP", outputs="PV")


def test_decimal_commas_in_stamps_do_not_part_fields(tmp_path):
    content = rows(
        lambda k, u, y: f"{stamp(k, '%d.%m.%Y %H:%M:%S')},000;{comma(u)};{comma(y)}", ["Zeit;u [%];y [°C]"]
    )
    assert_whole(read(tmp_path, content))
    assert [column.unit for column in inspect_export(tmp_path / "export.csv").columns] == ["%", "°C"]


def test_the_clock_that_goes_back_among_the_first_rows_does_not_turn_the_record_round(tmp_path):
    times = pd.date_range("2024-10-27 00:58:40", periods=len(U), freq="10s", tz="UTC").tz_convert(
        "Europe/Berlin"
    )
    content = rows(lambda k, u, y: f"{times[k]:%Y-%m-%d %H:%M:%S},{u},{y}", ["time,u,y"])
    assert_whole(read(tmp_path, content))
    assert_whole(read(tmp_path, content, time_zone="Europe/Berlin"))


def test_days_of_matlab_are_asked_about(tmp_path):
    content = rows(lambda k, u, y: f"{739023.5 + k / 8640:.9f},{u},{y}", ["time,u,y"])
    with pytest.raises(MampcError, match="seconds or days"):
        read(tmp_path, content)
    [record] = read(tmp_path, content, time_unit="d").records
    assert record.dt == 10.0


def test_inputs_that_stand_only_where_they_change_are_refused_with_what_closes_them(tmp_path):
    content = rows(lambda k, u, y: f"{stamp(k)},{u if k % 5 == 0 else ''},{y}", ["time,u,y"])
    with pytest.raises(MampcError, match=r"numbers in 4 of u, 20 of y in 20 rows.*--fill"):
        read(tmp_path, content)
    [record] = read(tmp_path, content, fill=4).records
    np.testing.assert_array_equal(record.u[:, 0], U[: len(record)])


@pytest.mark.parametrize(
    ("off", "on"), [("OFF", "ON"), ("Closed", "OPEN"), ("false", "true"), ("Aus", "Ein"), ("Zu", "Auf")]
)
def test_two_states_in_words_are_0_and_1_for_inputs(tmp_path, off, on):
    content = rows(lambda k, u, y: f"{stamp(k)},{on if u > 50 else off},{y}", ["time,u,y"])
    export = read(tmp_path, content)
    np.testing.assert_array_equal(export.records[0].u[:, 0], U > 50)
    assert any(f"{off.upper()} as 0 and {on.upper()} as 1" in note for note in export.changes)
    with pytest.raises(MampcError, match="only inputs may be words"):
        read(tmp_path, content, inputs="y", outputs="u")
    assert [column.name for column in inspect_export(tmp_path / "export.csv").columns] == ["u", "y"]


@pytest.mark.parametrize("words", [("AUTO", "MAN"), ("OPEN", "MOVING"), ("ON", "ON")])
def test_other_words_are_no_numbers_and_the_refusal_says_what_to_do(tmp_path, words):
    content = rows(lambda k, u, y: f"{stamp(k)},{words[int(u > 50)]},{y}", ["time,u,y"])
    with pytest.raises(MampcError, match="save others as numbers"):
        read(tmp_path, content)


def test_a_third_state_is_a_missing_value(tmp_path):
    content = rows(
        lambda k, u, y: f"{stamp(k)},{'MOVING' if k == 7 else 'OPEN' if u > 50 else 'CLOSED'},{y}",
        ["time,u,y"],
    )
    assert [len(record) for record in read(tmp_path, content).records] == [7, 12]


@pytest.mark.parametrize("form", ["{:.1f}%", "{:.1f} %", "{:.1f} m3/h", "{:.1f}°C"])
@pytest.mark.parametrize("decimal", [".", ","])
def test_a_unit_behind_every_number_is_its_unit(tmp_path, form, decimal):
    content = rows(
        lambda k, u, y: f"{stamp(k)};{form.format(u)};{y:.3f} bar".replace(".", decimal), ["time;u;y"]
    )
    export = read(tmp_path, content)
    assert_whole(export)
    assert export.records[0].names.units == (("u", form[6:].strip()), ("y", "bar"))
    content = content.replace("45", "45.0", 1) if decimal == "." else content
    with pytest.raises(MampcError, match="expected a number"):  # two units in one column
        read(tmp_path, content.replace(" bar", " mbar", 3))


@pytest.mark.parametrize(
    "form",
    [
        "%a %b %d %H:%M:%S CEST %Y", "%a %b %d %H:%M:%S %Y", "%a, %d %b %Y %H:%M:%S +0200", "%A, %B %d, %Y %I:%M:%S %p",
        "%d. Mai %Y %H:%M:%S", "%d-MAI-%y %H:%M:%S", "%d mai %Y %H:%M:%S", "%Y-%m-%d %H:%M:%S CEST",
        "%d.%m.%Y %H:%M:%S MESZ", "%d/%b/%Y:%H:%M:%S +0200", "Fr %d.%m.%Y %H:%M:%S", "%b %d, %Y %I:%M:%S %p",
        "%b %d, %Y, %I:%M:%S %p", "%m/%d/%Y, %I:%M:%S %p", "%d.%m.%Y, %H:%M:%S", "%d.%m.%Y %H.%M.%S",
        "%d/%m/%Y %I.%M.%S %p", "%d мая %Y %H:%M:%S", "%d mai %Y à %Hh%Mm%S", "%d maja %Y %H:%M:%S",
        "%Y. %m. %d. %H:%M:%S", "%d.%m.%Y klo %H.%M.%S", "%Y-%m-%d kl. %H:%M:%S", "%d %B %Y at %H:%M:%S UTC",
        "%d мая %Y г., %H:%M:%S", "martes, %d de mayo de %Y %H:%M:%S", "mar. %d mai %Y %H:%M:%S",
        "%d-%b-%y %I.%M.%S.000000 %p", "%a %b %d %Y %H:%M:%S GMT+0200 (Central European Summer Time)",
    ],
)  # fmt: skip
def test_dates_in_words(tmp_path, form):
    assert_whole(read(tmp_path, rows(lambda k, u, y: f"{stamp(k, form)};{u};{y}", ["time;u;y"])))


def test_the_name_of_a_zone_tells_when_clocks_are_put_back(tmp_path):
    def local(k):
        moment = pd.Timestamp("2024-10-27 00:59:00", tz="UTC") + pd.Timedelta(seconds=10 * k)
        return moment.tz_convert("Europe/Berlin").strftime("%a %b %d %H:%M:%S %Z %Y")

    export = read(tmp_path, rows(lambda k, u, y: f"{local(k)},{u},{y}", ["time,u,y"]))
    assert_whole(export)
    assert not export.changes


@pytest.mark.parametrize(("power", "words"), [(3, "milliseconds"), (6, "microseconds"), (9, "nanoseconds")])
def test_times_since_1970_in_small_units(tmp_path, power, words):
    content = rows(lambda k, u, y: f"{(1_700_000_000 + 10 * k) * 10**power},{u},{y}", ["timestamp,u,y"])
    export = read(tmp_path, content)
    assert_whole(export)
    assert any(words in note for note in export.notes)


@pytest.mark.parametrize(
    "word", ["Good, Annotated", "Good [Non-Specific]", "good - local override", "192 Good"]
)
def test_what_is_said_behind_good_keeps_it_good(tmp_path, word):
    content = rows(
        lambda k, u, y: (
            f'{stamp(k)},{u},{y},"{"Good, Questionable" if k == 9 else word if k % 3 else "Good"}"'
        ),
        ["time,u,y,y Status"],
    )
    assert [len(record) for record in read(tmp_path, content).records] == [9, 10]


def test_worksheets_with_the_same_columns_are_asked_about(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for sheet in (book.active, book.create_sheet("June")):
        sheet.append(["time", "u", "y"])
        for k, (u, y) in enumerate(zip(U, Y, strict=True)):
            sheet.append([(FIRST + pd.Timedelta(seconds=10 * k)).to_pydatetime(), u, y])
    book.create_sheet("Notes").append(["written by hand"])
    book.save(tmp_path / "export.xlsx")
    with pytest.raises(MampcError, match=r"one worksheet.*2 of them; save"):
        mampc.read_export(tmp_path / "export.xlsx", inputs="u", outputs="y")


LOGGERS = {
    "remarks behind a #": rows(
        lambda k, u, y: f"{stamp(k)},{u},{y}", ["#NAMES", "time,u,y", "#TYPES", "date,F,F", '#ROWS,"20"']
    ),
    "a header behind a #": rows(lambda k, u, y: f"{10 * k} {u} {y}", ["# made by numpy", "# time u y"]),
    "a header behind a %": rows(lambda k, u, y: f"  {10 * k:.5e}  {u:.5e}  {y:.5e}", ["% t u y"]),
    "numbers of rows without a name": rows(
        lambda k, u, y: f'"{k + 1}" "{stamp(k)}" {u} {y}', ['"t" "u" "y"']
    ),
    "a name without a column": rows(
        lambda k, u, y: f"{10 * k}\t{u}\t{y}", ["Writer_Version\t2", "***End***", "X_Value\tu\ty\tComment"]
    ),
    "pages": rows(
        lambda k, u, y: (
            f"Page {k // 5} of 4\r\n\r\ntime;u;y\r\n;%;°C\r\n{stamp(k)};{u};{y}"
            if k % 15 == 14
            else f"{stamp(k)};{u};{y}"
        ),
        ["time;u;y", ";%;°C"],
    ),
    "tables of Influx": rows(
        lambda k, u, y: (
            f",,0,{stamp(0)},{stamp(900)},{stamp(k)},{u},u\r\n,,1,{stamp(0)},{stamp(900)},{stamp(k)},{y},y"
        ),
        [
            "#datatype,string,long,dateTime,dateTime,dateTime,double,string",
            ",result,table,_start,_stop,_time,_value,_field",
        ],
    ),
    "spans": rows(lambda k, u, y: f"{30 + k}:00:00,{u},{y}", ["elapsed,u,y"]),
    "spans of pandas": rows(lambda k, u, y: f"{k // 24} days {k % 24:02}:00:00,{u},{y}", [",u,y"]),
    "dates in Japanese": rows(
        lambda k, u, y: f"{stamp(k, '%Y年%m月%d日 %H時%M分%S秒')},{u},{y}", ["日時,u,y"]
    ),
}


@pytest.mark.parametrize("form", list(LOGGERS))
def test_what_loggers_and_programs_write_around_their_numbers(tmp_path, form):
    assert_whole(read(tmp_path, LOGGERS[form]), dt=3600.0 if "spans" in form else 10.0)


def test_a_row_with_too_few_fields_and_no_number_is_a_missing_sample_and_one_with_a_number_is_refused(
    tmp_path,
):
    content = rows(lambda k, u, y: "broken" if k == 7 else f"{u},{y}", ["u,y"])
    assert [len(record) for record in read(tmp_path, content, dt=10.0).records] == [7, 12]
    content = rows(lambda k, u, y: f"{u}" if k == 7 else f"{u},{y}", ["u,y"])
    with pytest.raises(MampcError, match="expected 2 fields in row 9, received 1; the names stand in row 1"):
        read(tmp_path, content, dt=10.0)


def test_an_error_of_a_spreadsheet_is_no_remark(tmp_path):
    content = rows(lambda k, u, y: "#N/A,#N/A" if k == 7 else f"{u},{y}", ["u,y"])
    assert [len(record) for record in read(tmp_path, content, dt=10.0).records] == [7, 12]


def test_texts_in_other_encodings(tmp_path):
    content = rows(lambda k, u, y: f"{stamp(k)},{u},{y}", ["日時,弁開度[%],温度"]).encode("cp932")
    path = tmp_path / "export.csv"
    path.write_bytes(content)
    names = {"inputs": "弁開度", "outputs": "温度"}
    with pytest.raises(MampcError, match=r"unless its encoding is passed \(--encoding\)"):
        read_export(path, **names)
    for word in ("nonsense", "hex", "\0"):
        with pytest.raises(MampcError, match="encoding: expected one such as 'cp932', received"):
            read_export(path, **names, encoding=word)
    assert_whole(read_export(path, **names, encoding="cp932"))


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_values_that_leap_away_or_stay_are_told_and_kept(tmp_path, scale):
    rng = np.random.default_rng(4)
    y = scale * (200 + np.cumsum(rng.standard_normal(400)))
    u = np.repeat(rng.choice([1.0, 2.0], 50), 8)
    plain = [f"{u[k]},{y[k]:.9g}" for k in range(400)]

    def notes(lines):
        path = tmp_path / "export.csv"
        path.write_text("\n".join(["u,y", *lines]))
        return " ".join(read_export(path, inputs="u", outputs="y", dt=1.0).notes)

    assert not notes(plain)
    spikes = [f"{u[k]},0" if k in (50, 51, 90) else line for k, line in enumerate(plain)]
    assert (
        "y: 3 values far from those before and after, in rows 52, 53 and 92 (the first is 0 after"
        in notes(spikes)
    )
    stuck = [f"{u[k]},{y[60]:.9g}" if 60 <= k < 75 else line for k, line in enumerate(plain)]
    assert "for 15 samples from row 62 on, and moves nearly always elsewhere" in notes(stuck)
    steps = [f"{y[k]:.9g},{np.repeat(u, 4)[k]:.9g}" for k in range(400)]
    assert not notes(steps)
    test = np.repeat(rng.choice([-1.0, 1.0], 27), 15)[:400]  # of a controller's output, which moves about it
    moved = [f"{u[k]},{scale * (100 * test[k] + rng.standard_normal()):.9g}" for k in range(400)]
    assert not notes(moved)
