"""Models of symbols and strokes on disk: written and read again, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jaxfilters.models.gesture.coded import learn_codes, recognise
from jaxfilters.models.gesture.stroke import stacked
from jaxfilters.models.gesture.symbols import learn
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.gesture_models import SymbolsFile, default_symbols, read_symbols, write_symbols
from jaxfilters.trackers.io.strokes import read_strokes
from jaxfilters.trackers.io.unipen import read_unipen

LINE = np.stack([np.arange(9.0), np.zeros(9)], axis=1)


def of_shape():
    strokes = [([LINE], 1), ([LINE[:, ::-1]], 1), ([LINE * [1, 2] + [0, 1]], 1)]
    return learn(stacked(strokes), ["right", "down", "right"], num_states=3)


def of_codes():
    return learn_codes([(np.full(9, 1), np.ones(9, int)), (np.full(9, 5), np.full(9, 2))], ["a", "b"], num_states=2)


@pytest.mark.system
@pytest.mark.parametrize("learned", [of_shape, of_codes])
def test_models_are_read_as_they_were_written(learned, tmp_path):
    symbols = replace(learned(), sharpness=0.07, lapse=0.01, margins=np.array([0.25, -0.5]))
    write_symbols(tmp_path / "new" / "model.npz", SymbolsFile(symbols, "two lines", {"strokes": 2}))
    read = read_symbols(tmp_path / "new" / "model.npz")
    assert (read.source, read.parameters, read.symbols.names) == ("two lines", {"strokes": 2}, symbols.names)
    assert read.dimensions == (2 if learned is of_shape else 0)
    assert (read.symbols.sharpness, read.symbols.lapse) == (0.07, 0.01)
    np.testing.assert_array_equal(read.symbols.margins, [0.25, -0.5])
    models, again = symbols.models, read.symbols.models
    np.testing.assert_allclose(again.log_transition, models.log_transition, rtol=1e-6)
    codes, counts = np.full(20, 1), np.ones(20, int)
    expected = recognise(symbols, codes, counts, margin=-1e9).log_likelihood
    np.testing.assert_allclose(recognise(read.symbols, codes, counts, margin=-1e9).log_likelihood, expected, rtol=1e-5)


def changed(path, target, header=None, without=(), **arrays):
    """A copy of a file with other entries in its header and other arrays."""
    with np.load(path) as archive:
        found = {name: archive[name] for name in archive.files if name not in without}
    found["header"] = np.asarray(json.dumps({**json.loads(str(found["header"])), **(header or {})}))
    np.savez(target, **(found | arrays))
    return target


def test_what_is_no_model_is_refused_with_the_reason(tmp_path):
    good = tmp_path / "good.npz"
    write_symbols(good, SymbolsFile(of_shape(), "", {}))
    with np.load(good) as archive:
        mean, variance, owner = archive["mean"], archive["variance"], archive["owner"]
    bad = tmp_path / "bad.npz"
    for changes, word in (
        ({"header": {"version": 2}}, "version 2; this program reads version 1"),
        ({"header": {"format": "face"}}, "format"),
        ({"header": {"emission": "spline"}}, "emission must be one of shape, codes; got 'spline'"),
        ({"header": {"names": ["a", "a"]}}, "none twice"),
        ({"header": {"settings": {}}}, "min_variance"),
        ({"without": ("mean",)}, "without mean"),
        ({"mean": mean[:, :2]}, "mean must be numbers"),
        ({"mean": np.full_like(mean, np.nan)}, "mean must be finite"),
        ({"variance": -variance}, "positive"),
        ({"owner": owner + 1}, "owner"),
        ({"header": {"settings": {"min_variance": 0.1, "lapse": 2}}}, "lapse must be above 0 and at most 1"),
        ({"margins": np.zeros(3, np.float32)}, "margins must be numbers"),
        ({"margins": np.full(2, np.nan, np.float32)}, "margins must be finite"),
        ({"header": {"settings": {"min_variance": 0.1, "sharpness": 0}}}, "sharpness must be above 0"),
    ):
        with pytest.raises(InputError, match=word):
            read_symbols(changed(good, bad, **changes))
    for content in (b"", b"not an archive", good.read_bytes()[:500]):
        bad.write_bytes(content)
        with pytest.raises(InputError, match=r"bad\.npz"):
            read_symbols(bad)
    with pytest.raises(InputError, match="cannot be read"):
        read_symbols(tmp_path / "none.npz")
    np.savez(bad, shapes=np.zeros(3))
    with pytest.raises(InputError, match="fit gestures"):
        read_symbols(bad)


def test_the_model_of_the_package_knows_twelve_shapes_of_one_finger_and_of_two():
    found = default_symbols()
    assert len(found.symbols.names) == 24
    assert found.dimensions == 2


def test_rows_of_points_become_strokes_in_the_order_of_their_times(tmp_path):
    file = tmp_path / "strokes.csv"
    file.write_text(
        "stroke, label,person,time,x,y,fingers\n"
        "a,V,Ann,0.2,3,1,2\na,V,Ann,0.1,2,5,2\nb,L,Bob,,0,0,\nb,L,Bob,,0,4,\na,V,Ann,0.0,1,1,1\nc,,,,nan,1,0\n"
    )
    found = read_strokes(file)
    assert (found.ids, found.labels, found.people) == (("a", "b", "c"), ("V", "L", ""), ("Ann", "Bob", ""))
    np.testing.assert_array_equal(found.strokes[0][0][0], [(1, 1), (2, 5), (3, 1)])
    assert [fingers for _, fingers in found.strokes] == [2, 1, 0]
    assert (found.dimensions, found.pieces) == (2, 1)


def test_a_folder_has_a_folder_for_each_symbol_and_perhaps_for_each_person(tmp_path):
    for place in ("V/1.csv", "Ann/V/1.csv", "Ann/L/1.csv"):
        file = tmp_path / place
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("x,y,z\n0,1,2\n3,4,5\n")
    found = read_strokes(tmp_path)
    assert sorted(zip(found.labels, found.people, strict=True)) == [("L", "Ann"), ("V", ""), ("V", "Ann")]
    assert found.dimensions == 3


def test_arrays_become_strokes_whatever_their_names(tmp_path):
    file = tmp_path / "pen.npz"
    points = np.arange(14.0).reshape(7, 2)
    np.savez(file, xy=points, stroke_len=[2, 3, 2], n_strokes=[2, 1], label=[4, 7], donor=["x", "y"])
    found = read_strokes(file)
    assert (found.labels, found.people, found.pieces) == (("4", "7"), ("x", "y"), 2)
    np.testing.assert_array_equal(found.strokes[0][0][1], points[2:5])
    np.savez(file, points=points, length=[3, 4])
    assert read_strokes(file).labels == ("", "")
    for arrays, word in (
        ({"points": points[:, :1], "length": [7]}, "points"),
        ({"points": points, "length": [3, 3]}, "add up to 7"),
        ({"points": points, "length": [7], "label": ["a", "b"]}, "label"),
        ({"points": points, "length": [3.5, 3.5]}, "length must be counts"),
    ):
        np.savez(file, **arrays)
        with pytest.raises(InputError, match=word):
            read_strokes(file)


def test_files_that_are_no_strokes_are_refused_with_the_reason(tmp_path):
    file = tmp_path / "strokes.csv"
    for text, word in (
        ("", "without stroke, x, y"),
        ("stroke,x,y\n", "no stroke"),
        ("stroke,x\na,1\n", "without y"),
        ("stroke,x,y,colour\na,1,2,red\n", "unknown columns"),
        ("stroke,x,y\na,1,b\n", "line 2: y must be a number; got 'b'"),
        ("stroke,x,y,fingers\na,1,2,6\n", "fingers"),
        ("stroke,x,y,label\na,1,2,V\na,1,2,L\n", "several entries in label"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=word):
            read_strokes(file)
    for path, word in ((tmp_path / "none.csv", "no such file"), (tmp_path, "no CSV files")):
        with pytest.raises(InputError, match=word):
            read_strokes(path)


UNIPEN = """.VERSION 1.0
.COORD X Y T
.HIERARCHY PAGE DIGIT
.PEN_DOWN
0 0 1
5 7 2
.PEN_UP
6 6 3
.PEN_DOWN
1 1 4
.PEN_DOWN
2 2 5
3 3 6
.SEGMENT PAGE 0-2 ? "all"
.SEGMENT DIGIT 0-1 GOOD "4"
.SEGMENT DIGIT 2:0-2:1 ? "7"
"""


def test_segments_of_parts_and_without_points(tmp_path):
    """Pen-downs without points have no number; pen-ups have none either."""
    file = tmp_path / "parts.dat"
    points = ".PEN_DOWN\n0 0\n1 0\n2 0\n.PEN_UP\n.PEN_DOWN\n.PEN_UP\n7 7\n.PEN_DOWN\n5 5\n6 6\n"
    file.write_text(points + '.SEGMENT S 0:1-1:0 OK "a \\"b\\""\n.SEGMENT S 1:1 OK "c"\n.SEGMENT S 0:7-0:9 OK "none"\n')
    found = read_strokes(file)
    assert found.labels == ('a "b"', "c")
    first, second = (pieces for pieces, _ in found.strokes)
    np.testing.assert_array_equal(first[0], [(1, 0), (2, 0)])
    np.testing.assert_array_equal(first[1], [(5, -5)])
    np.testing.assert_array_equal(second[0], [(6, -6)])
    assert len(found.warnings) == 1
    assert "line 14: the segment holds no points" in found.warnings[0]


def test_included_files_are_found_as_in_the_distribution(tmp_path):
    (tmp_path / "data" / "1a" / "gmd").mkdir(parents=True)
    (tmp_path / "include" / "gmd").mkdir(parents=True)
    file = tmp_path / "data" / "1a" / "gmd" / "a.dat"
    file.write_text('.INCLUDE gmd/a.dat\n.SEGMENT S 1 OK "2"\n')
    (tmp_path / "include" / "gmd" / "a.dat").write_text(".PEN_DOWN\n0 0\n.PEN_UP\n.PEN_DOWN\n3 4\n5 6\n.PEN_UP\n")
    ((pieces, label),) = read_unipen(file).strokes
    assert label == "2"
    np.testing.assert_array_equal(pieces[0], [(3, -4), (5, -6)])
    (tmp_path / "include" / "gmd" / "a.dat").write_text(".INCLUDE gmd/a.dat\n")
    with pytest.raises(InputError, match="neither beside the file nor"):
        read_unipen(file)
    (tmp_path / "data" / "1a" / "gmd" / "b.dat").write_text(".INCLUDE a.dat\n")
    file.write_text(".INCLUDE b.dat\n")
    with pytest.raises(InputError, match="includes itself"):
        read_unipen(file)


@pytest.mark.system
@pytest.mark.data
@pytest.mark.parametrize("donor", ["art", "gmd"])
def test_files_of_the_distribution_give_the_strokes_that_others_read_from_them(data_dir, donor):
    """Those of a separate parser, point for point, in the order of the file."""
    with np.load(data_dir / "unipen_digits" / "unipen_1a_digits.npz") as parsed:
        arrays = dict(parsed)
    ends = np.cumsum(arrays["stroke_len"])
    pieces = np.split(arrays["xy"], ends[:-1])
    firsts = np.cumsum(arrays["n_strokes"]) - arrays["n_strokes"]
    checked = 0
    for file in sorted((data_dir / "unipen_files" / "data" / "1a" / donor).glob("*.dat")):
        found = read_unipen(file).strokes
        own = np.flatnonzero((arrays["donor"] == donor) & (arrays["srcfile"] == f"{donor}/{file.name}"))
        assert [label for _, label in found] == [str(arrays["label"][i]) for i in own]
        for (strokes, _), i in zip(found, own, strict=True):
            expected = pieces[firsts[i] : firsts[i] + arrays["n_strokes"][i]]
            assert len(strokes) == len(expected)
            for stroke, other in zip(strokes, expected, strict=True):
                np.testing.assert_array_equal(stroke * [1, -1], other)
            checked += 1
    assert checked > 100


def test_segments_of_unipen_become_strokes_with_y_down(tmp_path):
    file = tmp_path / "digits.unipen"
    file.write_text(UNIPEN)
    found = read_strokes(file)
    assert (found.labels, found.pieces) == (("4", "7"), 2)
    np.testing.assert_array_equal(found.strokes[0][0][0], [(0, 0), (5, -7)])
    np.testing.assert_array_equal(found.strokes[1][0][0], [(2, -2), (3, -3)])
    file.write_text(UNIPEN.partition(".SEGMENT")[0])
    ((pieces, label),) = read_unipen(file).strokes
    assert (len(pieces), label) == (3, "")
    for text, word in (
        (UNIPEN + '.SEGMENT DIGIT 9 ? "1"\n', "line 17: expected components from 0 to 2"),
        (UNIPEN + '.SEGMENT DIGIT 0-999999999 ? "1"\n', "line 17: expected components from 0 to 2"),
        (UNIPEN + '.SEGMENT DIGIT 0-99999999999999 ? "1"\n', "line 17: expected components from 0 to 2"),
        (UNIPEN + '.SEGMENT DIGIT 2-1 ? "1"\n', "line 17: expected components from 0 to 2"),
        (UNIPEN + ".INCLUDE other.dat\n", "line 17: other.dat is neither beside the file nor in a folder"),
        (UNIPEN + ".INCLUDE ../other.dat\n", "must be named below its folder"),
        (UNIPEN.replace("5 7 2", "5 nan 2"), "line 6: expected 3 numbers"),
        (UNIPEN.replace("5 7 2", "5 x"), "line 6: expected 3 numbers"),
        (".COORD X T\n", "X and Y"),
        ("hello\n", "without .PEN_DOWN"),
    ):
        file.write_text(text)
        with pytest.raises(InputError, match=word):
            read_unipen(file)
