"""Input that a run could never use, block on or exhaust memory with: one line that says what was expected."""

import json
import os
import re
import struct
import threading
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.io.cameras import open_camera, read_tsai
from jaxfilters.trackers.io.checkpoint import load_meta
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.errors import CheckpointError, InputError, shortened, shown
from jaxfilters.trackers.io.features import open_features
from jaxfilters.trackers.io.gesture_streams import read_streams
from jaxfilters.trackers.io.images import read_image
from jaxfilters.trackers.io.landmark_sets import read_landmark_sets
from jaxfilters.trackers.io.landmarks import read_landmarks
from jaxfilters.trackers.io.paired_input import PairedInput
from jaxfilters.trackers.io.points import read_points
from jaxfilters.trackers.io.rigs import open_rig
from jaxfilters.trackers.io.scenes import open_scene
from jaxfilters.trackers.io.strokes import read_strokes
from jaxfilters.trackers.io.video_input import ImageFolder, VideoFile, open_video, together

ROTATION = [[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]]
CAMERA = {"image_size": [160, 120], "K": [[139, 0, 79.5], [0, 139, 59.5], [0, 0, 1]], "R": ROTATION, "t": [1, 3.5, 1.2]}
FLOOR = [[0, 0], [8, 0], [8, 6], [0, 6]]


def described(tmp_path, settings, name="a.json"):
    path = tmp_path / name
    path.write_text(json.dumps(settings))
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_size": [40000, 40000]}, "image_size: 40000x40000 pixels; at most 128 million"),
        ({"image_size": [True, 120]}, "two positive integers"),
        (
            {"t": [1000, 3500, 1200]},
            r"stands 3520 m above the floor, expected at most 200 m.*[(]are they in millimetres\?",
        ),
        ({"t": [100, 350, 120]}, r"stands 352 m above the floor.*[(]are they in centimetres\?"),
        ({"t": [500, 1750, 600]}, r"stands 1760 m above the floor.*[(]are they in centimetres or millimetres\?"),
        ({"t": [1e5, 3.5e5, 1.2e5]}, r"P and t must be in metres\.$"),
        ({"t": [0, 0, 1e30]}, "t must be numbers of at most 1e[+]12; got 1e[+]30"),
        ({"K": [[1e8, 0, 80], [0, 1e8, 60], [0, 0, 1]]}, "fx and fy must be from 1 to 1e[+]06 pixels"),
        ({"K": [[1e-320, 0, 80], [0, 139, 60], [0, 0, 1]]}, "fx and fy must be from 1"),
        ({"name": "x" * 9000}, None),
        ({"name": ["x" * 9000]}, r"name must be text; got \['xxx"),
    ],
)
def test_cameras_in_other_units_or_beyond_all_cameras(tmp_path, changes, message):
    path = described(tmp_path, CAMERA | changes)
    if message is None:
        assert open_camera(path).name == "x" * 9000
        return
    with pytest.raises(InputError, match=message) as caught:
        open_camera(path)
    assert len(str(caught.value)) < 500 + len(str(path))


def test_an_integer_of_thirty_digits_is_no_focal_length(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(CAMERA).replace("139", "9" * 30))
    with pytest.raises(InputError, match="an integer of 30 digits"):
        open_camera(path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"floor": [[1000 * x, 1000 * y] for x, y in FLOOR]}, r"floor spans 8000 x 6000 m.*millimetres\?"),
        ({"floor": FLOOR, "patches": [[[9000, 0, 0], [1, 0, 0], [0, 0, 1]]]}, "patches spans 9000 x 6 m"),
        ({"floor": FLOOR, "outlines": 7}, "outlines must be a list; got 7"),
        ({"floor": FLOOR, "meshes": [{}]}, "meshes must be names of files"),
        ({"floor": FLOOR, "meshes": ["none.stl"]}, "none.stl: cannot be read"),
        (
            {"floor": FLOOR, "outlines": [{"polygon": [[0, 0]] * 3, "at": [0, 0], "camera": -1}]},
            "a number from 0; got -1",
        ),
        ({"floor": FLOOR[:2]}, "polygon of 3 corners or more; got 2"),
        ({"floor": None}, "floor must be finite"),
    ],
)
def test_scenes_in_other_units_or_of_other_form(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        open_scene(described(tmp_path, settings))


def test_a_scene_may_say_that_it_has_no_outlines(tmp_path):
    scene = open_scene(described(tmp_path, {"floor": FLOOR, "outlines": None, "meshes": None, "patches": None}))
    assert (len(scene.outlines), len(scene.meshes), len(scene.patches)) == (0, 0, 0)


READERS = {
    "camera": open_camera,
    "rig": open_rig,
    "scene": open_scene,
    "tsai": read_tsai,
    "image": read_image,
    "landmarks": lambda path: read_landmarks(path, (640, 480)),
    "points.csv": lambda path: read_points(path, 30.0),
    "points.npz": lambda path: read_points(path, 30.0),
    "features.npz": open_features,
    "features.json": open_features,
    "features.csv": open_features,
    "depth.npz": open_depth,
    "strokes.csv": read_strokes,
    "strokes.npz": read_strokes,
    "strokes.unipen": read_strokes,
    "strokes.inkml": read_strokes,
    "strokes.json": read_strokes,
    "strokes.ndjson": read_strokes,
    "checkpoint": load_meta,
    "video.avi": lambda path: open_video(str(path)),
}


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_refused_where_reading_would_block(tmp_path, name):
    path = tmp_path / name
    os.mkfifo(path)
    found = []

    def read():
        try:
            READERS[name](path)
        except (InputError, CheckpointError) as error:
            found.append(str(error))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(20)
    assert len(found) == 1, "it blocks"
    assert "a pipe or a device" in found[0]


def test_a_device_is_refused(tmp_path):
    (tmp_path / "a.csv").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="a pipe or a device"):
        read_points(tmp_path / "a.csv", 30.0)


def test_a_pipe_among_the_images_of_a_folder_is_refused(tmp_path):
    os.mkfifo(tmp_path / "1.png")
    with pytest.raises(InputError, match=r"1\.png: a pipe or a device"):
        open_video(str(tmp_path))


def test_a_table_of_twenty_thousand_points_in_as_many_frames_is_refused_before_it_is_allocated(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("frame,id,x,y\n" + "".join(f"{i},{i},0,0\n" for i in range(20_000)))
    with pytest.raises(InputError, match="20000 points in 20000 frames, of which 20000 are there; at most 64 million"):
        read_points(path, 30.0)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("nan,a,1,2\n1,a,1,2\n", "line 2: time_s must be a finite number of at most 1e[+]12; got nan"),
        ("inf,a,1,2\n", "line 2: time_s must be a finite number"),
        ("0,a,inf,2\n", "line 2: x must be a finite number"),
        ("0,a,1e39,2\n", "line 2: x must be a finite number"),
        ("0,a,1,2\n0,a,3,4\n", "line 3: point a is there twice in one frame"),
        ("0,a,1\n", "line 2 has 3 entries, its header 4"),
        ("0,a,1," + "x" * 9000 + "\n", "line 2: y must be a number; got 'xxx"),
    ],
)
def test_points_that_are_no_points_are_named_with_their_line(tmp_path, rows, message):
    path = tmp_path / "a.csv"
    path.write_text("time_s,id,x,y\n" + rows)
    with pytest.raises(InputError, match=message) as caught:
        read_points(path, 30.0)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_points_of_arrays_have_finite_increasing_times_and_no_infinite_place(tmp_path):
    points = np.zeros((3, 1, 2))
    for times, worst, message in (
        ([0, np.nan, 1], 0, "times must be finite; frame 1 is not"),
        ([0, 2, 1], 0, "times must increase strictly"),
        ([0, 1, 2], np.inf, "coordinates must be finite or NaN; point 0 in frame 0 is not"),
        ([0, 1, 2], 1e39, "finite in single precision|must be finite or NaN"),
    ):
        np.savez(tmp_path / "a.npz", points=points + worst, t_s=np.array(times, float))
        with pytest.raises(InputError, match=message):
            read_points(tmp_path / "a.npz", 30.0)


@pytest.mark.parametrize("segment", ["0-999999999999", "0-999999999", "1:0-1:99999999999", ",".join(["0-1"] * 60_000)])
def test_ranges_of_unipen_are_not_expanded_before_they_are_checked(tmp_path, segment):
    path = tmp_path / "a.unipen"
    path.write_text(f'.COORD X Y\n.SEGMENT D {segment} ? "1"\n.PEN_DOWN\n1 2\n3 4\n.PEN_UP\n.PEN_DOWN\n1 2\n.PEN_UP\n')
    with pytest.raises(InputError, match="expected components from 0 to 1") as caught:
        read_strokes(path)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_counts_whose_sum_overflows_are_no_lengths(tmp_path):
    lengths = np.array([2**63 - 1, 2**63 - 1, 5], np.int64)
    with np.errstate(over="ignore"):
        assert lengths.sum() == 3
    np.savez(tmp_path / "a.npz", points=np.zeros((3, 2)), length=lengths)
    with pytest.raises(InputError, match="length must add up to 3"):
        read_strokes(tmp_path / "a.npz")


def test_xml_defines_no_entities(tmp_path):
    levels = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10 if i else "x"}">' for i in range(9))
    (tmp_path / "a.xml").write_text(f"<?xml version='1.0'?><!DOCTYPE a [{levels}]><a>&a8;</a>")
    with pytest.raises(InputError, match="defines entities"):
        read_tsai(tmp_path / "a.xml")


def with_sides(path, starts, form):
    """An image whose header claims 40000 x 40000 pixels."""
    assert cv2.imwrite(str(path), np.zeros((24, 32, 3), np.uint8))
    content = bytearray(path.read_bytes())
    for start in starts(content):
        content[start : start + struct.calcsize(form)] = struct.pack(form, *[40000] * (len(form) - 1))
    path.write_bytes(bytes(content))
    return path


HEADERS = {
    ".png": (lambda content: [16], ">II"),
    ".bmp": (lambda content: [18], "<ii"),
    ".jpg": (lambda content: [content.index(b"\xff\xc0") + 5], ">HH"),
    ".tiff": (lambda content: [content.index(struct.pack("<HHI", tag, 3, 1)) + 8 for tag in (256, 257)], "<H"),
}


@pytest.mark.parametrize("suffix", HEADERS)
def test_images_that_claim_too_many_pixels_are_refused_before_they_are_allocated(tmp_path, suffix):
    with pytest.raises(InputError, match="40000x40000 pixels; at most 128 million can be read"):
        read_image(with_sides(tmp_path / f"a{suffix}", *HEADERS[suffix]))


@pytest.mark.parametrize("fps", [-1.0, 0.0, float("nan"), float("inf")])
def test_no_iterator_runs_at_a_rate_that_has_no_end(tmp_path, fps):
    assert cv2.imwrite(str(tmp_path / "1.png"), np.zeros((4, 6, 3), np.uint8))
    source = ImageFolder(tmp_path, 10.0)
    source.fps = fps
    for make in (lambda: ImageFolder(tmp_path, fps), lambda: PairedInput([source]), lambda: list(together([source]))):
        with pytest.raises(InputError, match="fps must be finite and above 0"):
            make()
    for read in (lambda: read_points(tmp_path / "a.csv", fps), lambda: open_depth(tmp_path, fps=fps)):
        with pytest.raises(InputError, match="fps must be finite and above 0"):
            read()


FRAMES = 295


@pytest.fixture(scope="module")
def long_video(tmp_path_factory):
    """An AVI of 295 frames, the number of each in its grey level modulo 200, whose header claims three."""
    path = tmp_path_factory.mktemp("video") / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (32, 24))
    for i in range(FRAMES):
        writer.write(np.full((24, 32, 3), i % 200, np.uint8))
    writer.release()
    content = bytearray(path.read_bytes())
    main_header = content.index(b"avih") + 8
    content[main_header + 16 : main_header + 20] = struct.pack("<I", 3)
    stream_header = content.index(b"strh") + 8
    content[stream_header + 32 : stream_header + 36] = struct.pack("<I", 3)
    path.write_bytes(bytes(content))
    return path


def test_a_video_is_read_to_its_end_whatever_its_header_claims(long_video, monkeypatch):
    source = VideoFile(long_video)
    # Some builds of OpenCV count the index instead of believing the header.
    source.frames = 3
    levels = [int(image[0, 0, 0]) for _, image in source.images()]
    assert len(levels) == FRAMES
    np.testing.assert_allclose(levels, np.arange(FRAMES) % 200, atol=3)
    assert source.trouble() is None


def test_a_sample_keeps_few_images_whatever_the_header_claims(long_video, monkeypatch):
    source = VideoFile(long_video)
    source.frames = 3
    held = [0]

    class Image(np.ndarray):
        def __del__(self):
            held[0] -= 1

    def counted():
        for i in range(FRAMES):
            held[0] += 1
            most.append(held[0])
            yield i / 25, np.full((2, 2, 3), i % 200, np.uint8).view(Image)

    most: list[int] = []
    monkeypatch.setattr(source, "images", counted)
    sample = source.sample(20)
    assert len(sample) == 20
    assert max(most) <= 2 * 20 + 3
    every = np.arange(0, FRAMES, 8)
    assert [int(image[0, 0, 0]) for image in sample] == [
        every[i] % 200 for i in np.linspace(0, len(every) - 1, 20).round().astype(int)
    ]


@pytest.mark.parametrize("number", ["9" * 30, "9" * 5000, "12345", "\u0663"], ids=len)
def test_a_camera_number_that_no_camera_has_is_a_name_of_nothing(number):
    with pytest.raises(InputError, match="no such file or folder; a live camera is given by its number, of at most 4"):
        open_video(number)


def test_a_camera_that_opencv_refuses_is_named(monkeypatch):
    def refuse(number):
        return SimpleNamespace(read=lambda: cv2.VideoCapture("a", "b"), release=lambda: None)

    real = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda *place: real(*place) if len(place) > 1 else refuse(*place))
    with pytest.raises(InputError, match="camera 7: cannot be opened, or delivers no image"):
        open_video("7")


def test_times_name_a_folder_of_images_and_no_camera(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "1403636579763555584").mkdir()
    assert cv2.imwrite("1403636579763555584/1.png", np.zeros((4, 6, 3), np.uint8))
    assert open_video("1403636579763555584").image_size == (6, 4)


LONG = "n" * 3000
"""Longer than any file system takes, at which `Path.exists` raises."""
OPENERS = {
    "video": lambda: open_video(LONG),
    "depth": lambda: open_depth(LONG),
    "features": lambda: open_features(LONG),
    "strokes": lambda: read_strokes(Path(LONG)),
    "landmark sets": lambda: read_landmark_sets(Path(LONG)),
    "streams": lambda: read_streams(Path(LONG)),
    "points": lambda: read_points(Path(LONG), 30.0),
    "camera": lambda: open_camera(Path(LONG)),
}


@pytest.mark.parametrize("name", OPENERS)
def test_a_name_that_is_too_long_is_that_of_no_file(name):
    with pytest.raises(InputError, match=r"no such file or folder|File name too long"):
        OPENERS[name]()


@pytest.mark.parametrize(
    ("number", "got"), [("Infinity", "inf at K[0][2]"), ("NaN", "nan at K[0][2]"), ("1e999", "inf at K[0][2]")]
)
def test_numbers_that_are_not_finite_are_named_with_their_place(tmp_path, number, got):
    path = tmp_path / "a.json"
    path.write_text(json.dumps(CAMERA).replace("79.5", number))
    with pytest.raises(InputError, match=re.escape(f"{path}: K must be finite numbers; got {got}")):
        open_camera(path)


def test_messages_show_little_of_what_was_found():
    assert shown("a\nb") == r"'a\nb'"
    assert shown([1] * 10**5) == repr([1] * 10**5)[:77] + "..."
    assert shortened("a\nb\x00") == "a?b?"
    assert len(shown("x" * 10**6)) == len(shortened("x" * 10**6)) == 80


OPENS = re.compile(
    r"\bnp\.(load|fromfile)\(|json\.loads?\(|\.read_(text|bytes)\(|(?<!\w)open\(|imread|ElementTree\.parse\("
)
WRITES = re.compile(r"""open\((?:mode|"[wa]b?")|cpuinfo|json\.dumps""")
SAFE = {"input_files.py", "json_files.py", "npz.py"}
"""The files that open input and check it first."""


def test_input_is_opened_by_the_safe_readers_alone(root):
    found = [
        f"{path.relative_to(root)}:{number}: {line.strip()}"
        for path in sorted((root / "trackers").rglob("*.py"))
        if path.name not in SAFE
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if OPENS.search(line) and not WRITES.search(line)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("line", ["np.load(path)", "with path.open() as file:", "path.read_text()", "open(path)"])
def test_the_rule_notices_what_it_forbids(line):
    assert OPENS.search(line)
    assert not WRITES.search(line)
