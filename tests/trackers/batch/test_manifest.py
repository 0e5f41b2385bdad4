"""Manifests in both formats, and what is wrong with one, by row and field."""

import json

import pytest

from jaxfilters.trackers.batch.manifest import Entry, read_manifest
from jaxfilters.trackers.io.errors import InputError

GOOD = {"name": "a", "tracker": "hand-depth"}


def written(folder, rows):
    path = folder / "manifest.json"
    path.write_text(json.dumps(rows))
    return path


def test_json_and_csv_hold_the_same_recordings(tmp_path):
    rows = [
        {"name": "one", "tracker": "hand-depth", "input": "a b.npz", "options": ["--particles", "64"]},
        {"name": "two", "tracker": "people", "input": "x.mp4", "options": "--camera 'c 1.json'"},
        GOOD,
    ]
    table = tmp_path / "manifest.csv"
    table.write_text(
        "\ufeffname,tracker,input,options\none,hand-depth,a b.npz,--particles 64\n"
        "two,people,x.mp4,--camera 'c 1.json'\n\na,hand-depth,,\n"
    )
    expected = [
        Entry("one", "hand-depth", ("a b.npz",), ("--particles", "64")),
        Entry("two", "people", ("x.mp4",), ("--camera", "c 1.json")),
        Entry("a", "hand-depth", (), ()),
    ]
    assert read_manifest(written(tmp_path, rows)) == read_manifest(table) == expected


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a", r"expected an object with name, tracker"),
        (GOOD | {"trakcer": "x"}, r"'trakcer': unknown field"),
        (GOOD | {"name": "../a"}, r"name: expected letters"),
        (GOOD | {"name": ".batch"}, r"name: expected letters"),
        (GOOD | {"name": "report.json"}, r"name: expected letters"),
        ({"tracker": "people"}, r"name: expected letters.*got None"),
        (GOOD | {"name": "FIRST"}, r"name: 'FIRST' is the name of row 1 already"),
        (GOOD | {"tracker": "feet"}, r"tracker: expected one of hand-depth, .*got 'feet'"),
        (GOOD | {"input": 3}, r"input: expected a text or a list of texts; got 3"),
        (GOOD | {"input": "-x.npz"}, r"input: '-x.npz' looks like an option; write ./-x.npz"),
        (GOOD | {"options": {"particles": 3}}, r"options: expected a text or a list"),
        (GOOD | {"options": "--hand 'left"}, r"options: No closing quotation"),
        (GOOD | {"options": "--hand middle"}, r"options: argument --hand: invalid choice: 'middle'"),
        (GOOD | {"options": "--help"}, r"options: unrecognized arguments: --help"),
        (GOOD | {"input": ["a", "b"]}, r"options: unrecognized arguments: b"),
        (GOOD | {"options": "--out elsewhere"}, r"options: --out is set by the batch"),
    ],
)
def test_a_wrong_row_is_named_with_its_field_in_one_line(tmp_path, row, message):
    path = written(tmp_path, [GOOD | {"name": "first"}, row])
    with pytest.raises(InputError, match=rf"manifest.json: row 2: {message}") as raised:
        read_manifest(path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.json", "[1, 2", "not JSON"),
        ("m.json", "[]", "expected a list of recordings.*got none"),
        ("m.json", "{}", "expected a list of recordings.*got a dict"),
        ("m.csv", "name,tracker\n", "got none"),
        ("m.csv", "name,tracker\na,people,b.mp4\n", "row 1: more cells than the header"),
        ("m.csv", 'name,tracker\na,"peo', "line 1: not CSV"),
        ("m.txt", "", "ends in .json or .csv"),
    ],
)
def test_a_file_that_is_no_manifest_is_refused(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_manifest(tmp_path / name)
