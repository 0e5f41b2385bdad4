"""Files of unknown origin: whatever is wrong is one error that names the file; nothing large is allocated."""

import io
import json
import os
import resource
import struct
import zipfile

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.images import read_image
from jaxfilters.trackers.io.json_text import parse_json, read_json_text
from jaxfilters.trackers.io.npz import names_in_npz, read_npz

WANTED = "expected arrays"
RNG = np.random.default_rng(0)
ARRAYS = {"a": RNG.normal(size=(3, 4)), "b": np.asfortranarray(RNG.normal(size=(2, 3, 2))), "c": np.asarray("text")}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_of_numpy(tmp_path, save):
    path = tmp_path / "a.npz"
    save(path, **ARRAYS, empty=np.zeros((0, 5)), flags=np.array([True, False]))
    found = read_npz(path, WANTED)
    with np.load(path) as expected:
        assert set(found) == set(expected.files) == set(names_in_npz(path, WANTED))
        for name in expected.files:
            np.testing.assert_array_equal(found[name], expected[name])
            assert found[name].dtype == expected[name].dtype
    assert set(read_npz(path, WANTED, ("a", "nothing"))) == {"a"}


def archive(path, content, name="a.npy", **changes):
    """An archive of one entry, whose directory says what `changes` say."""
    info = zipfile.ZipInfo(name)
    info.compress_type = changes.pop("compress_type", zipfile.ZIP_DEFLATED)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr(info, content)
        for field, value in changes.items():
            setattr(file.filelist[0], field, value)
    return path


def array_bytes(shape, dtype="<f8", content=b""):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + content


def with_objects(path):
    np.savez(path, a=np.array([{}], object), allow_pickle=True)


def single_array(path):
    with path.open("wb") as file:
        np.save(file, np.ones(3))


WRONG = {
    "claims 1e12 elements": (lambda p: archive(p, array_bytes((10**12,), content=b"1234")), "claims shape"),
    "claims fewer elements": (lambda p: archive(p, array_bytes((1,), content=bytes(16))), "claims shape"),
    "claims more bytes than fit": (lambda p: archive(p, array_bytes((9,)), file_size=2**31), "not a complete .npz"),
    "more than the limit": (lambda p: archive(p, array_bytes((9,)), file_size=2**34), "more than 8 GiB"),
    "encrypted": (lambda p: archive(p, array_bytes((0,)), flag_bits=1), "encrypted"),
    "unknown compression": (lambda p: archive(p, array_bytes((0,)), compress_type=zipfile.ZIP_LZMA), "not an array"),
    "not an array": (lambda p: archive(p, b"hello", name="a.txt"), "not an array"),
    "no header": (lambda p: archive(p, b"hello"), "not a complete .npz file"),
    "objects": (with_objects, "objects, not numbers"),
    "no archive": (lambda p: p.write_bytes(b"hello"), "not a complete .npz file"),
    "a single array": (single_array, "a single array"),
    "a pipe": (os.mkfifo, "a pipe or a device"),
    "a folder": (lambda p: p.mkdir(), "a folder"),
    "nothing": (lambda p: None, "No such file"),
}


@pytest.mark.parametrize(("make", "words"), WRONG.values(), ids=WRONG)
def test_wrong_archives_are_named(tmp_path, make, words):
    path = tmp_path / "a.npz"
    make(path)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=words) as caught:
        read_npz(path, WANTED)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 500 + len(str(path))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**18, "more than 256 MiB"


def test_mutated_archives_are_read_or_refused(tmp_path):
    """Bytes changed, cut and repeated at random: an error with the file's name, or arrays; nothing else is raised."""
    path = tmp_path / "a.npz"
    np.savez_compressed(path, **ARRAYS)
    good, refused, read = path.read_bytes(), 0, 0
    rng = np.random.default_rng(1)
    for _ in range(500):
        bad = bytearray(good)
        for place in rng.integers(len(bad), size=rng.integers(1, 6)):
            bad[place] = rng.integers(256)
        if rng.random() < 0.2:
            bad = bad[: rng.integers(len(bad))]
        path.write_bytes(bytes(bad))
        try:
            read_npz(path, WANTED)
        except InputError as error:
            refused += str(path) in str(error)
        else:
            read += 1
    assert refused + read == 500
    assert refused > 250


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "nested too deeply|not JSON"),
        ('{"a":' * 100_000, "nested too deeply|not JSON"),
        ("1" + "0" * 400, "an integer of 401 digits"),
        ("1" * 5000, "an integer of 5000 digits"),
        ("{", "not JSON"),
        ("", "not JSON"),
    ],
    ids=["lists", "objects", "large", "larger", "cut off", "empty"],
)
def test_wrong_json_is_named(tmp_path, text, words):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_json_text(path, WANTED)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_json_is_that_of_the_standard_library(tmp_path):
    path = tmp_path / "a.json"
    value = {"a": [1, 2.5, -(10**17), "x", None, True], "b": {}}
    path.write_text(json.dumps(value))
    assert read_json_text(path, WANTED) == value
    assert parse_json("[1e400]", "here", WANTED) == [np.inf]
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(InputError, match="not JSON"):
        read_json_text(path, WANTED)


def test_a_png_that_claims_2_to_the_30_pixels_is_refused_before_they_are_allocated(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((4, 4, 3), np.uint8))
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", 2**15, 2**15)
    path.write_bytes(bytes(content))
    with pytest.raises(InputError, match="32768x32768 pixels"):
        read_image(path)
