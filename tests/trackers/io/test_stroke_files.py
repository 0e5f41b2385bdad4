"""Strokes in InkML as the W3C's recommendation of 2011 writes it, and in JSON."""

import json

import numpy as np
import pytest

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.inkml import read_inkml
from jaxfilters.trackers.io.strokes import read_strokes, usable

DIFFERENCES = """<trace xml:id="id4525abc">1125 18432,'23'43,"7"-8,3-5,7 -3,6 2,6 8,3 6 T,2 4*T,3 6,3-6 F F</trace>"""
"""The example of differences in the recommendation, under the element `trace`; below, the points of its table."""
POINTS = [
    *[(1125, 18432), (1148, 18475), (1178, 18510), (1211, 18540), (1251, 18567), (1297, 18596)],
    *[(1349, 18633), (1404, 18676), (1461, 18723), (1521, 18776), (1584, 18823)],
]
FORMAT = """<traceFormat xml:id="buttons"><channel name="X" type="decimal"/><channel name="Y" type="decimal"/>
<intermittentChannels><channel name="B1" type="boolean" default="F"/><channel name="B2" type="boolean" default="F"/>
</intermittentChannels></traceFormat>"""


def inkml(tmp_path, *content, namespace=' xmlns="http://www.w3.org/2003/InkML"'):
    path = tmp_path / "a.inkml"
    path.write_text(f"<ink{namespace}>{''.join(content)}</ink>")
    return path


def points_of(path):
    return [[piece.tolist() for piece in pieces] for pieces, _ in read_inkml(path).strokes]


@pytest.mark.parametrize("namespace", ["", ' xmlns="http://www.w3.org/2003/InkML"'])
def test_first_and_second_differences_are_those_of_the_recommendation(tmp_path, namespace):
    ((piece,),) = points_of(inkml(tmp_path, FORMAT, DIFFERENCES, namespace=namespace))
    np.testing.assert_array_equal(piece, POINTS)


def test_values_are_decimal_double_hexadecimal_or_explicit_again(tmp_path):
    trace = "<trace>1 2, '3 -4.5, * *, !#1F .5, 1e1 -2.5E-1, !5-6,</trace>"
    ((piece,),) = points_of(inkml(tmp_path, trace))
    # An explicit mark holds for its own channel: y goes on with differences.
    np.testing.assert_allclose(piece[:3], [(1, 2), (4, -4.5), (7, -4.5)])
    np.testing.assert_allclose(piece[3:], [(31, 0.5), (10, -0.25), (5, -6)])


def test_channels_are_those_of_the_context_with_their_order_and_orientation(tmp_path):
    channels = '<channel name="T" type="integer"/><channel name="Y" orientation="-ve"/><channel name="X"/>'
    device = f'<inkSource xml:id="pen"><traceFormat>{channels}</traceFormat></inkSource>'
    definitions = f'<definitions>{device}<context xml:id="c" inkSourceRef="#pen"/></definitions>'
    path = inkml(tmp_path, definitions, '<trace contextRef="#c">0 3 7, 1 4 8</trace>', "<trace>5 6</trace>")
    assert points_of(path) == [[[[7, -3], [8, -4]]], [[[5, 6]]]]
    streamed = inkml(
        tmp_path, definitions, '<context contextRef="#c"/>', "<trace>0 3 7</trace>", "<trace>0 4 8</trace>"
    )
    assert points_of(streamed) == [[[[7, -3]]], [[[8, -4]]]]
    space = '<traceFormat><channel name="X"/><channel name="Y"/><channel name="Z"/></traceFormat>'
    assert read_strokes(inkml(tmp_path, space, "<trace>1 2 3,4 5 6</trace>")).dimensions == 3


def test_groups_are_labelled_strokes_of_several_pieces(tmp_path):
    found = read_strokes(
        inkml(
            tmp_path,
            '<annotation type="writer">Ann</annotation>',
            '<trace xml:id="a">0 0,1 1</trace><trace xml:id="b">2 2,3 3</trace><trace xml:id="c">4 4,5 5</trace>',
            '<trace type="penUp">9 9,9 8</trace>',
            '<traceGroup xml:id="all"><annotation type="truth">xy</annotation>',
            '<traceGroup xml:id="x"><annotation type="truth">x</annotation>',
            '<traceView traceDataRef="#a"/><traceView traceDataRef="b"/></traceGroup>',
            '<traceGroup><annotation type="truth">y</annotation><trace>6 6,7 7</trace></traceGroup></traceGroup>',
        )
    )
    assert (found.labels, found.people, found.ids) == (("x", "y", ""), ("Ann",) * 3, ("x", "1", "c"))
    assert [len(pieces) for pieces, _ in found.strokes] == [2, 1, 1]
    np.testing.assert_array_equal(found.strokes[0][0][1], [(2, 2), (3, 3)])


def test_a_continued_trace_is_one_piece(tmp_path):
    first, last = (
        '<trace xml:id="a" continuation="begin">0 0,1 1</trace>',
        '<trace continuation="end" priorRef="#a">2 2</trace>',
    )
    assert points_of(inkml(tmp_path, first, last)) == [[[[0, 0], [1, 1], [2, 2]]]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<trace>1 2,3</trace>", "trace 0, point 1: expected 2 to 2 values; got '3'"),
        ("<trace>1 2,3 four</trace>", "trace 0, point 1: expected numbers; got '3 four'"),
        ("<trace>1 ?</trace>", "X and Y must be finite numbers"),
        ("<trace>1 1e400</trace>", "X and Y must be finite numbers"),
        ('<trace contextRef="#no">1 2</trace>', "trace refers to '#no', which is not in the file"),
        ('<context xml:id="a" contextRef="#a"/><trace>1 2</trace>', "refers to itself, or too far on"),
        ('<traceFormat><channel name="X"/></traceFormat><trace>1</trace>', "a traceFormat must name X and Y"),
        ("<trace></trace>", "no trace holds any points"),
        ("", "without traces"),
    ],
)
def test_what_is_no_ink_is_named(tmp_path, content, message):
    with pytest.raises(InputError, match=message.replace("?", r"\?")):
        read_strokes(inkml(tmp_path, content))


def test_another_document_is_no_ink(tmp_path):
    (tmp_path / "a.inkml").write_text("<html/>")
    with pytest.raises(InputError, match="its outermost element is 'html'; expected InkML"):
        read_strokes(tmp_path / "a.inkml")
    (tmp_path / "a.inkml").write_text("<ink>")
    with pytest.raises(InputError, match="not XML"):
        read_strokes(tmp_path / "a.inkml")


ENTRIES = [
    {
        "word": "cat",
        "key_id": "17",
        "countrycode": "DE",
        "drawing": [[[1, 2], [4, 5], [0, 9]], [[7, 8], [9, 1], [12, 20]]],
    },
    {"label": "dot", "person": "Ann", "fingers": 2, "points": [[0.5, 1], [2, 3.5]]},
    {"label": "line", "pieces": [[[0, 1], [2, 3]], [], [[4, 5]]]},
]


@pytest.mark.parametrize("form", [".json", ".ndjson", "object"])
def test_strokes_in_json_are_by_point_by_piece_or_by_coordinate(tmp_path, form):
    path = tmp_path / ("a.ndjson" if form == ".ndjson" else "a.json")
    lines = "\n".join(map(json.dumps, ENTRIES)) + "\n"
    path.write_text(lines if form == ".ndjson" else json.dumps(ENTRIES if form == ".json" else {"strokes": ENTRIES}))
    found = read_strokes(path)
    assert (found.labels, found.people) == (("cat", "dot", "line"), ("", "Ann", ""))
    assert (found.ids, found.dimensions, found.pieces) == (("17", "1", "2"), 2, 2)
    assert [fingers for _, fingers in found.strokes] == [1, 2, 1]
    np.testing.assert_array_equal(found.strokes[0][0][1], [(7, 9), (8, 1)])
    np.testing.assert_array_equal(found.strokes[2][0][1], [(4, 5)])


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"a": 1}, "expected strokes such as .* got a dict"),
        ([{"label": "a"}], "stroke 0: expected strokes such as"),
        ([{"points": [[1, 2], [3, None]]}], "stroke 0: points must be finite numbers"),
        ([{"points": [[1, 2], [3]]}], "stroke 0: points must be finite numbers"),
        ([{"points": [[1, 1e39]]}], "stroke 0: points must be finite numbers"),
        ([{"drawing": [[[1, 2], [3]]]}], "stroke 0: a piece of drawing has 2 x and 1 y"),
        ([{"points": [[1, 2]]}, {"points": [[1, 2, 3]]}], "some strokes have two coordinates and some three"),
        ([{"points": [[1, 2]], "fingers": 9}], "fingers must be from 0 to 5; got 9"),
        ([{"points": [[1, 2]], "label": ["a"]}], "label must be text"),
        ([], "no stroke in it"),
    ],
)
def test_what_are_no_strokes_is_named(tmp_path, entries, message):
    (tmp_path / "a.json").write_text(json.dumps(entries))
    with pytest.raises(InputError, match=message):
        read_strokes(tmp_path / "a.json")


def test_what_nothing_can_recognise_is_named_with_its_place(tmp_path):
    table, archive, listed = tmp_path / "a.csv", tmp_path / "a.npz", tmp_path / "a.json"
    table.write_text("stroke,x,y\na,1,2\na,nan,3\nb,0,0\nb,1,1\nc,4,4\nd,5,5\nd,5,5\n")
    points = np.array([[1, 2], [np.nan, 3], [0, 0], [1, 1], [4, 4], [5, 5], [5, 5]], float)
    np.savez(archive, points=points, length=[1, 1, 2, 1, 2, 0], pieces=[2, 1, 1, 1, 1])
    listed.write_text(
        '[{"points": [[1, 2]]}, {"pieces": [[[3, 3]], [[3, 3]]]}, {"points": []}, {"points": [[0, 1], [1, 2]]}]'
    )
    assert read_strokes(table).faults == (
        f"{table}: line 3: stroke a has a coordinate that is no number",
        "",
        f"{table}: line 6: stroke c holds a single point",
        f"{table}: line 7: stroke d does not move",
    )
    assert read_strokes(archive).faults == (
        f"{archive}: row 1: stroke 0 has a coordinate that is no number",
        "",
        f"{archive}: row 4: stroke 2 holds a single point",
        f"{archive}: row 5: stroke 3 does not move",
        f"{archive}: stroke 4 holds no point",
    )
    assert read_strokes(listed).faults == (
        f"{listed}: stroke 0 holds a single point",
        f"{listed}: stroke 1 does not move",
        f"{listed}: stroke 2 holds no point",
        "",
    )


def test_examples_are_usable_or_left_out_with_a_warning_or_refused(tmp_path):
    path = tmp_path / "a.csv"
    rows = "stroke,label,x,y\na,V,0,0\na,V,1,1\nb,V,3,3\n"
    path.write_text(rows)
    found = usable(read_strokes(path))
    assert (found.ids, found.labels, found.faults) == (("a",), ("V",), ("",))
    assert found.warnings == (f"{path}: line 4: stroke b holds a single point; it is left out",)
    path.write_text(rows + "c,L,2,2\nc,L,2,2\n")
    with pytest.raises(InputError, match=r"no usable stroke of \['L'\]: .*line 5: stroke c does not move"):
        usable(read_strokes(path))
    path.write_text(rows + "c,V,2,nan\nc,V,2,2\n")
    with pytest.raises(InputError, match="line 5: stroke c has a coordinate that is no number"):
        usable(read_strokes(path))
