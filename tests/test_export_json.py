"""Exports in JSON, as the interfaces of historians give them."""

import json

import numpy as np
import pytest

from mampc import MampcError
from mampc.identification.export import inspect_export
from test_export_forms import U, Y, assert_whole, read, stamp

RECORDS = [
    {"time": stamp(k), "u": float(u), "y": float(y)} for k, (u, y) in enumerate(zip(U, Y, strict=True))
]


@pytest.mark.parametrize(
    "content",
    [
        json.dumps(RECORDS),
        json.dumps(RECORDS, indent=2),
        "\n".join(map(json.dumps, RECORDS)),
        json.dumps({name: [record[name] for record in RECORDS] for name in RECORDS[0]}),
        json.dumps({"site": "A", "data": RECORDS, "links": []}),
        json.dumps(
            [
                {"tag": name, "timestamp": r["time"], "value": r[name], "quality": "Good"}
                for r in RECORDS
                for name in "uy"
            ]
        ),
    ],
    ids=["records", "indented", "lines", "columns", "within an object", "tall"],
)
def test_json_in_its_usual_forms(tmp_path, content):
    assert_whole(read(tmp_path, content))


def test_json_with_a_word_null_or_nothing_for_a_value_has_a_gap_there(tmp_path):
    for mark in (None, "Bad", np.nan):
        content = json.dumps([record | ({"y": mark} if k == 7 else {}) for k, record in enumerate(RECORDS)])
        assert [len(record) for record in read(tmp_path, content).records] == [7, len(U) - 8]
    without = [dict(record) for record in RECORDS]
    del without[7]["u"]
    assert len(read(tmp_path, json.dumps(without)).records) == 2


def test_records_under_their_tags_are_a_tall_table_and_states_of_the_system_are_words(tmp_path):
    def item(k: int, name: str, value: object) -> dict[str, object]:
        good = not isinstance(value, dict)
        return {
            "Timestamp": RECORDS[k]["time"], "Value": value, "UnitsAbbreviation": "", "Good": good,
            "Questionable": False, "Substituted": False, "Annotated": False,
        }  # fmt: skip

    bad = {"Name": "Bad Input", "Value": 255, "IsSystem": True}
    for fault, lengths in (({}, [len(U)]), ({7: bad}, [7, len(U) - 8])):
        streams = [
            {
                "WebId": f"F1{name}", "Name": name, "Links": {}, "UnitsAbbreviation": "m",
                "Items": [item(k, name, (fault if name == "y" else {}).get(k, r[name])) for k, r in enumerate(RECORDS)],
            }
            for name in "uy"
        ]  # fmt: skip
        export = read(tmp_path, json.dumps({"Links": {"First": "?"}, "Items": streams}))
        assert [len(record) for record in export.records] == lengths
        assert dict(export.records[0].names.units) == {"u": "m", "y": "m"}
        assert not fault or any("'Bad Input' (1," in note for note in export.notes)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('[{"time": 1, "u": 1', "expected readable JSON"),
        ('{"a": 1}', "received another form"),
        ('{"u": [1, 2], "y": [1]}', "received another form"),
        ('[{"time": {"s": 1}, "u": 1, "y": 2}]', "received lists or objects as values"),
        ('{"a": [{"u": 1}], "b": [{"y": 1}]}', "received lists or objects as values"),
        ("{" * 3000, "expected readable JSON"),
        ('[{"time": 1, "v": 1}]', "expected one column 'u'"),
    ],
)
def test_json_in_other_forms_is_refused(tmp_path, content, message):
    with pytest.raises(MampcError, match=message):
        read(tmp_path, content)


def test_one_stream_alone_is_inspected_without_its_flags(tmp_path):
    path = tmp_path / "export.json"
    items = [
        {"Timestamp": r["time"], "Value": r["y"], "Good": True, "Questionable": False, "Annotated": False}
        for r in RECORDS
    ]
    path.write_text(json.dumps({"Links": {}, "Items": items, "UnitsAbbreviation": "m"}))
    seen = inspect_export(path)
    assert [column.name for column in seen.columns] == ["Value"]
    assert "Annotated" in seen.others
    assert not seen.doubts
