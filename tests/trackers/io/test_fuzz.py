"""Mutated files through every reader: finite values or one line that names the file, in bounded memory and time.

A file is made from a valid one by `mutated`, with a generator of random numbers that its format and its number seed:
`mutated_file(name, number)` makes the same file again.

Not by hypothesis: what is mutated is the structure of a file (entries of an archive, headers of arrays, words of a
line), which would have to be written all the same; a number names a file without a database of examples, whatever is
installed; and what hypothesis adds, smaller examples, is worth little where a traceback names the line that fails.
"""

import io
import json
import re
import resource
import signal
import struct
import traceback
import zipfile
import zlib
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
import pytest

from jaxfilters.hmm import SemiMarkovModel
from jaxfilters.models.gesture.frame_classifier import DILATIONS, KERNEL, FrameClassifier
from jaxfilters.models.gesture.poses import PoseTemplate, num_features
from jaxfilters.models.gesture.streams import StreamModel
from jaxfilters.models.tsai import calibration_of_tsai
from jaxfilters.trackers.app import results
from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.app.viewer import page_of
from jaxfilters.trackers.batch.manifest import read_manifest
from jaxfilters.trackers.calibration.command import read_room_points
from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.cameras import open_camera, open_intrinsics, read_tsai
from jaxfilters.trackers.io.depth import open_depth
from jaxfilters.trackers.io.detections import read_detections
from jaxfilters.trackers.io.detector_errors import DetectorErrors, load_detector_errors, save_detector_errors
from jaxfilters.trackers.io.enrolled_people import People, read_people, write_people
from jaxfilters.trackers.io.errors import CheckpointError, InputError
from jaxfilters.trackers.io.face_models import DEFAULT_FILE as FACE_MODEL
from jaxfilters.trackers.io.face_models import default_face_model, load_face_model
from jaxfilters.trackers.io.features import open_features
from jaxfilters.trackers.io.gesture_models import DEFAULT_FILE as SYMBOLS
from jaxfilters.trackers.io.gesture_models import read_symbols
from jaxfilters.trackers.io.gesture_streams import read_stream_model, read_streams, write_stream_model
from jaxfilters.trackers.io.ict import open_ict
from jaxfilters.trackers.io.images import read_image
from jaxfilters.trackers.io.landmark_sets import read_landmark_sets
from jaxfilters.trackers.io.landmarks import read_landmarks
from jaxfilters.trackers.io.lens_metadata import QUICKTIME_KEY, equivalent_focal_mm
from jaxfilters.trackers.io.points import read_points
from jaxfilters.trackers.io.rigs import open_rig
from jaxfilters.trackers.io.scenes import open_scene
from jaxfilters.trackers.io.strokes import read_strokes
from jaxfilters.trackers.io.video_input import open_video

MOST_MEMORY, MOST_SECONDS, LONGEST_MESSAGE = 2**30, 20, 500
"""Bytes of address space beyond what the process has, seconds of a file, and characters beside the file's name."""
RNG = np.random.default_rng(0)
POINTS = RNG.uniform((100, 80), (500, 400), (4, 21, 2)).round(3)
ROTATION = np.array([[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]])
K = np.array([[139.0, 0, 79.5], [0, 139, 59.5], [0, 0, 1]])
CAMERA = {"name": "hall", "image_size": [160, 120], "K": K.tolist(), "R": ROTATION.tolist(), "t": [1.0, 3.5, 1.2]}
LENS = [-0.2, 0.05, 0.001, 0, 0]
TSAI = """<?xml version="1.0" encoding="UTF-8"?>
<Camera name="a">
<Geometry width="768" height="576" dpx="5.1e-03" dpy="4.6e-03"/>
<Intrinsic focal="5.5" kappa1="5.1e-03" cx="324" cy="282" sx="1.09"/>
<Extrinsic tx="8.2e+02" ty="-3.1e+03" tz="3.5e+04" rx="2.04" ry="-0.89" rz="-0.43"/>
</Camera>
"""
UNIPEN = """.VERSION 1.0
.COORD X Y T
.SEGMENT DIGIT 0 ? "1"
.PEN_DOWN
10 20 0
11 21 10
12 22 20
.PEN_UP
.SEGMENT DIGIT 1-2 ? "2"
.PEN_DOWN
20 20 0
21 23 10
.PEN_UP
.PEN_DOWN
30 20 0
31 21 10
.PEN_UP
.SEGMENT DIGIT 1:1-2:0 GOOD "3"
"""


INKML = """<ink xmlns="http://www.w3.org/2003/InkML">
<annotation type="writer">Ann</annotation>
<context xml:id="pen"><inkSource xml:id="src"><traceFormat xml:id="fmt">
<channel name="X" type="integer"/><channel name="Y" type="decimal" orientation="-ve"/><channel name="T" type="integer"/>
<intermittentChannels><channel name="B1" type="boolean"/></intermittentChannels></traceFormat></inkSource></context>
<traceGroup xml:id="a"><annotation type="truth">one</annotation>
<trace xml:id="t1">10 0 0, 9 14 1, !8 '2 "3, * * *, 1 2 3 T</trace>
<trace xml:id="t2" contextRef="#pen">130 155 0,144 159 1,158 160 2</trace></traceGroup>
<trace type="penUp" xml:id="t3">1 1 1</trace>
<traceGroup><traceView traceDataRef="#t2"/></traceGroup>
<trace xml:id="t4" continuation="begin">1 2 3</trace>
<trace continuation="end" priorRef="#t4">#1F -4.5e1 3</trace>
</ink>
"""
DRAWINGS = [
    {"word": "cat", "key_id": "17", "drawing": [[[1, 2, 3], [4, 5, 6]], [[7, 8], [9, 1], [0, 10]]]},
    {"label": "dot", "person": "Ann", "fingers": 2, "points": [[0.5, 1], [2, 3.5]]},
    {"label": "line", "pieces": [[[0, 1], [2, 3]], [[4, 5]]]},
]


class Format(NamedTuple):
    """Files of one kind and their reader."""

    write: Callable[[Path], list[Path]]
    """Writes valid input into a folder, and returns the files that are mutated, one at a time."""
    read: Callable[[Path], Any]
    """Numbers from the file, or from the folder, that `write` wrote first."""
    may_lack: bool = False
    """Whether a number may be NaN where something was not observed."""
    files: int = 400


def json_file(name: str, value: Any) -> Callable[[Path], list[Path]]:
    return lambda folder: text_file(name, json.dumps(value))(folder)


def text_file(name: str, text: str) -> Callable[[Path], list[Path]]:
    def write(folder: Path) -> list[Path]:
        (folder / name).write_text(text)
        return [folder / name]

    return write


def npz_file(**arrays: Any) -> Callable[[Path], list[Path]]:
    def write(folder: Path) -> list[Path]:
        np.savez_compressed(folder / "a.npz", **arrays)
        return [folder / "a.npz"]

    return write


def copied(file: Path) -> Callable[[Path], list[Path]]:
    def write(folder: Path) -> list[Path]:
        (folder / "a.npz").write_bytes(file.read_bytes())
        return [folder / "a.npz"]

    return write


def table(header: str, rows: list[tuple]) -> Callable[[Path], list[Path]]:
    return text_file("a.csv", "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")


def pictures(suffix: str, count: int = 1, dtype: type = np.uint8) -> Callable[[Path], list[Path]]:
    def write(folder: Path) -> list[Path]:
        shape = (24, 32) if dtype is np.uint16 else (24, 32, 3)
        files = [folder / f"{i}{suffix}" for i in range(count)]
        for i, file in enumerate(files):
            assert cv2.imwrite(str(file), np.random.default_rng(i).integers(1, 250, shape).astype(dtype))
        return files

    return write


def depth_folder(folder: Path) -> list[Path]:
    (folder / "camera.json").write_text('{"fx": 30, "fy": 31, "cx": 16, "cy": 12, "depth_scale": 1000, "fps": 30}')
    return [*pictures(".png", 2, np.uint16)(folder), *[folder / "camera.json"] * 2]


def video(suffix: str, codec: str) -> Callable[[Path], list[Path]]:
    def write(folder: Path) -> list[Path]:
        file = folder / f"a{suffix}"
        writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*codec), 10.0, (64, 48))
        for i in range(4):
            writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
        writer.release()
        return [file]

    return write


def openpose(folder: Path) -> list[Path]:
    for i, points in enumerate(POINTS):
        hand = np.concatenate([points, np.full((21, 1), 0.5)], axis=1).ravel().tolist()
        person = {"person_id": [-1], "hand_left_keypoints_2d": [], "hand_right_keypoints_2d": hand}
        (folder / f"a_{i}_keypoints.json").write_text(json.dumps({"version": 1.3, "people": [person]}))
    return sorted(folder.glob("*.json"))


MEDIAPIPE = [
    {"time_s": 0.1 * i, "landmarks": [{"x": x / 640, "y": y / 480, "z": 0, "visibility": 0.9} for x, y in points]}
    for i, points in enumerate(POINTS)
]


def people_file(folder: Path) -> list[Path]:
    from jaxfilters.models.face.gallery import Gallery

    face = default_face_model().model
    size = face.num_identities
    shapes = Gallery(np.zeros((1, size)), 0.1 * np.eye(size)[None], np.zeros((1, *face.mean.shape)))
    write_people(folder / "a.npz", People(("one",), shapes), face)
    return [folder / "a.npz"]


STATE = {"mean": np.arange(6.0), "frame": np.asarray(3), "key": jax.random.key(0)}


def saved_state(folder: Path) -> list[Path]:
    checkpoint.save(folder / "a.npz", STATE, {"run": {"seed": 1}, "frames": 3, "complete": False})
    return [folder / "a.npz"]


def ict_files(folder: Path) -> list[Path]:
    rng = np.random.default_rng(1)
    np.savez(folder / "ict_landmarks68.npz", vertex_ids=np.arange(68))
    arrays = {"neutral": (70, 3), "identity": (4, 70, 3), "expression": (2, 70, 3)}
    arrays = {name: rng.normal(size=shape).astype(np.float32) for name, shape in arrays.items()}
    quads = rng.integers(70, size=(9, 4))
    np.savez(folder / "ict_face9409.npz", quads=quads, expression_names=np.array(["a", "b"]), **arrays)
    return [folder / "ict_face9409.npz", folder / "ict_landmarks68.npz"]


PYRAMID = {
    "obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\nf 1 2 3\nf 1//1 2//1 4//1\nf 2 3 4\n",
    "off": "OFF\n4 3 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 1 2 3\n",
    "ply": "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 3\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n3 1 2 3\n",
}


def scene_with(name: str, content: bytes) -> Callable[[Path], list[Path]]:
    """A scene of one mesh, of which the file of the mesh is mutated; the reader is given the scene beside it."""

    def write(folder: Path) -> list[Path]:
        (folder / "scene.json").write_text(json.dumps({"floor": [[0, 0], [5, 0], [5, 4], [0, 4]], "meshes": [name]}))
        (folder / name).write_bytes(content)
        return [folder / name]

    return write


def binary_ply() -> bytes:
    header = PYRAMID["ply"].replace("ascii", "binary_little_endian").partition("end_header\n")
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4").tobytes()
    return (
        (header[0] + header[1]).encode()
        + vertices
        + b"".join(struct.pack("<Biii", 3, *face) for face in ((0, 1, 2), (0, 1, 3), (1, 2, 3)))
    )


def binary_stl() -> bytes:
    corners = np.array([[0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]], "<f4")
    return bytes(80) + struct.pack("<I", 2) + b"".join(one.tobytes() + bytes(2) for one in corners)


def box(kind: bytes, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack(">I4s", 8 + len(body), kind) + body


def phone_video(folder: Path) -> list[Path]:
    """The boxes of a video that says its lens; no images are needed for that."""
    keys = box(b"keys", struct.pack(">II", 0, 1), box(b"mdta", QUICKTIME_KEY))
    item = box(struct.pack(">I", 1), box(b"data", struct.pack(">II", 22, 0), struct.pack(">I", 26)))
    meta = box(b"meta", box(b"hdlr", bytes(24)), keys, box(b"ilst", item))
    (folder / "a.mp4").write_bytes(
        box(b"ftyp", b"mp42", bytes(4)) + box(b"mdat", bytes(40)) + box(b"moov", box(b"trak", meta))
    )
    return [folder / "a.mp4"]


def exif_picture(folder: Path) -> list[Path]:
    """A TIFF structure whose first directory names that of EXIF, in which the lens is."""
    entry = lambda tag, kind, value: struct.pack("<HHIHH", tag, kind, 1, value, 0)
    content = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry(0x8769, 4, 26) + bytes(4)
    (folder / "a.tif").write_bytes(content + struct.pack("<H", 1) + entry(0xA405, 3, 28) + bytes(4))
    return [folder / "a.tif"]


def exif_jpeg(folder: Path) -> list[Path]:
    (jpeg,) = pictures(".jpg")(folder)
    (exif,) = exif_picture(folder)
    body = b"Exif\0\0" + exif.read_bytes()
    data = jpeg.read_bytes()
    jpeg.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(body)) + body + data[2:])
    return [jpeg]


def detector_errors(folder: Path) -> list[Path]:
    root = np.random.default_rng(2).normal(0, 1, (30, 30))
    errors = DetectorErrors(np.ones((10, 3)), root @ root.T, np.full(10, 0.5), np.eye(6)[:, :3])
    save_detector_errors(folder / "a.npz", {"own": errors}, {"people": 3})
    return [folder / "a.npz"]


def stream_model(folder: Path) -> list[Path]:
    """A model of two gestures of three points with weights of zero."""
    template = PoseTemplate(np.eye(3), np.full(3, 1 / 3), np.array([1, 2]), 1.0, 1.0, 1.0)
    inputs, width, classes = num_features(template), 4, 3
    layers = tuple(
        (np.zeros((KERNEL, inputs if i == 0 else width, width)), np.zeros(width)) for i in range(len(DILATIONS))
    )
    classifier = FrameClassifier(
        np.zeros(inputs), np.ones(inputs), layers, (np.zeros((width, classes)), np.zeros(classes))
    )
    halves = np.full((classes, 5), np.log(0.5))
    durations = SemiMarkovModel(
        np.full(classes, -np.log(3)), np.full((classes, classes), -np.log(3)), halves, halves.copy()
    )
    write_stream_model(folder / "a.npz", StreamModel(("a", "b"), template, classifier, durations), "test")
    return [folder / "a.npz"]


MANIFEST = [
    {"name": "one", "tracker": "hand-depth", "input": "a.npz", "options": "--particles 64 --seed 3"},
    {"name": "two", "tracker": "people", "input": ["a.mp4", "b.mp4"], "options": ["--scene", "scene.json"]},
]


class Rows(NamedTuple):
    """Of one object in the plane."""

    times_s: np.ndarray
    xy: np.ndarray
    std: np.ndarray
    status: np.ndarray


ROWS = Rows(np.arange(6) / 30, np.ones((6, 2)), np.full((6, 2), 0.1), np.array([0, 1, 1, 2, 3, 1]))
ROWS_TABLE = TrackTable(
    Rows, (Columns(("x_m", "y_m"), lambda rows: rows.xy), Columns(("x_std_m", "y_std_m"), lambda rows: rows.std))
)


def interrupted_run(folder: Path) -> list[Path]:
    writer = results.begin(folder, {"seed": 1}, ROWS_TABLE, overwrite=True)
    for part in (slice(0, 4), slice(4, 6)):
        rows = Rows(*(column[part] for column in ROWS))
        writer.append_rows(len(rows.times_s), rows)
        writer.checkpoint(np.zeros(2))
    writer.close()
    return sorted((folder / "checkpoint").glob("rows_*.npz"))


def resumed_rows(path: Path) -> Any:
    """As `--resume` reads them; a track may hold any numbers."""
    writer, _ = results.resume(path.parents[1], {"seed": 1}, ROWS_TABLE)
    try:
        return str(writer.results)
    finally:
        writer.close()


def finished_run(folder: Path) -> list[Path]:
    writer = results.begin(folder, {"seed": 1}, ROWS_TABLE, overwrite=True)
    writer.append_rows(6, ROWS)
    writer.finish({"input": "a", "status": {"lost": 1}, "rate": None, "seconds": 1.5})
    writer.close()
    return [*[folder / "track.csv"] * 3, folder / "report.json"]


def page_numbers(path: Path) -> Any:
    page = page_of(path.parent)
    return json.loads(page.partition('<script id="data" type="application/json">')[2].partition("</script>")[0])


def camera_numbers(path: Path) -> Any:
    _, camera, undistortion = open_camera(path)
    return camera.P, np.asarray(camera.P, np.float32), undistortion.K, undistortion.distortion


def rig_numbers(path: Path) -> Any:
    file = open_rig(path)
    return file.rig, [np.asarray(number, np.float32) for one in file.cameras for number in one[2:]]


def scene_numbers(path: Path) -> Any:
    scene = open_scene(path)
    return np.asarray(scene.floor, np.float32), scene.patches, [mesh.vertices for mesh in scene.meshes], scene.outlines


def mesh_numbers(path: Path) -> Any:
    return [np.asarray(mesh.vertices) for mesh in open_scene(path.with_name("scene.json")).meshes]


def scene_files(folder: Path) -> list[Path]:
    cube = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    (folder / "desk.stl").write_text(cube + "endsolid a\n")
    scene = {
        "floor": [[0, 0], [5, 0], [5, 4], [0, 4]],
        "patches": [[[1, 1, 0], [1, 0, 0], [0, 0, 1]]],
        "meshes": ["desk.stl"],
        "outlines": [{"camera": 0, "polygon": [[1, 1], [9, 1], [5, 9]], "at": [2, 2]}],
    }
    (folder / "scene.json").write_text(json.dumps(scene))
    return [*[folder / "scene.json"] * 3, folder / "desk.stl"]


def tsai_numbers(path: Path) -> Any:
    camera = read_tsai(path)
    try:
        return calibration_of_tsai(camera, (768, 576))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def depth_numbers(path: Path) -> Any:
    sequence = open_depth(path)
    return sequence.camera.matrix(), sequence.times_s, [sequence[i] for i in range(min(len(sequence), 4))]


def feature_numbers(path: Path) -> Any:
    sequence = open_features(path, image_size=(640, 480))
    return sequence.times_s, [np.asarray(part, np.float32) for part in (sequence.y, *sequence[0])]


def stroke_numbers(path: Path) -> Any:
    found = read_strokes(path)
    return [np.asarray(piece) for pieces, _ in found.strokes for piece in pieces]


def box_numbers(path: Path) -> Any:
    return list(read_detections(path).values())


LANDMARK_NAMES = [str(k) for k in range(68)]
BOXES = "1,-1,10.5,20,30,60,0.9\n2,-1,11,21,30.5,60,-1\n2,7,1,2,3,4,1,0.5,0.6,0\n"
COCO = {
    "images": [{"id": 4}, {"id": 9}],
    "annotations": [{"image_id": i, "bbox": [10, 20.5, 30, 60], "score": 0.9, "category_id": 1} for i in (4, 9)],
}
STROKES_NPZ = npz_file(
    points=RNG.normal(size=(9, 2)), length=np.array([3, 2, 4]), label=np.array(["a", "b", "a"]), person=np.full(3, "x")
)
FEATURES = npz_file(keypoints=POINTS, confidence=np.full((4, 21), 0.9), t_s=np.arange(4) / 30, image_shape=(480, 640))
DEPTH = npz_file(
    depth_mm=RNG.integers(0, 900, (3, 24, 32)).astype(np.uint16),
    t_us=np.arange(3) * 33_000,
    K=K,
    joints_mm=np.ones((3, 21, 3)),
)
LONG_ROWS = [(i, k, *POINTS[i, k], 0.9) for i in range(4) for k in range(21)]
FORMATS = {
    "camera.json": Format(json_file("a.json", CAMERA | {"distortion": LENS}), camera_numbers),
    "intrinsics": Format(json_file("a.json", CAMERA | {"distortion": LENS}), open_intrinsics),
    "rig.json": Format(
        json_file(
            "a.json",
            {
                "cameras": [
                    {"name": "left", "image_size": [160, 120], "K": K.tolist(), "distortion": LENS},
                    {
                        "name": "right",
                        "image_size": [160, 120],
                        "K": K.tolist(),
                        "R": np.eye(3).tolist(),
                        "t": [-120, 0, 0],
                    },
                ]
            },
        ),
        rig_numbers,
    ),
    "scene.json": Format(scene_files, scene_numbers, files=600),
    "tsai": Format(text_file("a.xml", TSAI), tsai_numbers),
    "inkml": Format(text_file("a.inkml", INKML), stroke_numbers),
    "strokes.json": Format(json_file("a.json", DRAWINGS), stroke_numbers),
    "strokes.ndjson": Format(text_file("a.ndjson", "\n".join(map(json.dumps, DRAWINGS))), stroke_numbers),
    "ict face": Format(ict_files, lambda path: open_ict(path.parent), files=300),
    "room points": Format(
        table("x_m,y_m,z_m,u,v", [(i, i % 3, 0.5, 10 * i, 20) for i in range(8)]),
        lambda path: read_room_points(path)[:2],
    ),
    "unipen": Format(text_file("a.unipen", UNIPEN), stroke_numbers),
    "strokes.csv": Format(
        table("stroke,label,time,x,y,fingers", [(s, "ab"[s], t, t + s, 2 * t, 1) for s in range(2) for t in range(5)]),
        stroke_numbers,
        may_lack=True,
    ),
    "strokes.npz": Format(STROKES_NPZ, stroke_numbers, may_lack=True),
    "points.csv": Format(
        table("frame,time_s,id,x,y", [(t, t / 30, i, t + i, 2.5) for t in range(5) for i in range(3)]),
        lambda path: read_points(path, 30.0),
        may_lack=True,
    ),
    "points.npz": Format(
        npz_file(points=RNG.normal(size=(6, 2, 3)), t_s=np.arange(6) / 30),
        lambda path: read_points(path, 30.0),
        may_lack=True,
    ),
    "landmarks": Format(
        table("name,u,v", [(name, 10 + 3 * i, 20 + i) for i, name in enumerate(LANDMARK_NAMES)]),
        lambda path: read_landmarks(path, (640, 480)),
    ),
    "landmark sets.npz": Format(
        npz_file(shapes=RNG.normal(size=(3, 2, 10, 3)), neutral=np.asarray(0)),
        lambda path: read_landmark_sets(path).shapes,
        may_lack=True,
    ),
    "landmark sets.csv": Format(
        table(
            "expression,name,x_mm,y_mm,z_mm",
            [(e, n, k, 2 * k, 1) for e in ("neutral", "smile") for k, n in enumerate(LANDMARK_NAMES)],
        ),
        lambda path: read_landmark_sets(path.parent).shapes,
        may_lack=True,
    ),
    "face model": Format(copied(FACE_MODEL), lambda path: load_face_model(path).model),
    "people": Format(people_file, lambda path: read_people([path], default_face_model().model).gallery),
    "symbols": Format(copied(SYMBOLS), lambda path: read_symbols(path).symbols.models.emission),
    "boxes.txt": Format(text_file("a.txt", BOXES), box_numbers),
    "boxes.json": Format(json_file("a.json", COCO), box_numbers),
    "keypoints.npz": Format(FEATURES, feature_numbers, may_lack=True),
    "openpose": Format(openpose, lambda path: feature_numbers(path.parent), may_lack=True),
    "mediapipe.json": Format(json_file("a.json", MEDIAPIPE), feature_numbers, may_lack=True),
    "keypoints.csv": Format(table("frame,landmark,x,y,visibility", LONG_ROWS), feature_numbers, may_lack=True),
    "depth.npz": Format(DEPTH, depth_numbers, may_lack=True),
    "depth folder": Format(depth_folder, lambda path: depth_numbers(path.parent), may_lack=True, files=600),
    "png": Format(pictures(".png"), read_image),
    "jpg": Format(pictures(".jpg"), read_image),
    "bmp": Format(pictures(".bmp"), read_image),
    "tiff": Format(pictures(".tiff"), read_image),
    "avi": Format(video(".avi", "MJPG"), lambda path: [list(open_video(str(path)).images())]),
    "mp4": Format(video(".mp4", "mp4v"), lambda path: [list(open_video(str(path)).images())]),
    "gesture streams": Format(
        npz_file(
            points=RNG.normal(size=(12, 3, 2)),
            length=np.array([5, 7]),
            annotations=np.array([[0, 1, 0, 3], [1, 0, 2, 6]]),
            names=np.array(["right", "up"]),
            fps=np.asarray(20.0),
        ),
        lambda path: [stream.points for stream in read_streams(path).streams],
        may_lack=True,
    ),
    "gesture differences": Format(
        npz_file(
            delta_1e5=RNG.integers(-99, 99, (3, 4, 12)).astype(np.int32),
            length=np.array([5, 7]),
            seq_id=np.array([3, 8]),
            gesture=np.array([1, 2]),
        ),
        lambda path: [stream.points for stream in read_streams(path).streams],
    ),
    "stream model": Format(stream_model, lambda path: read_stream_model(path)[1:3]),
    "lens of a video": Format(phone_video, equivalent_focal_mm),
    "lens of a tiff": Format(exif_picture, equivalent_focal_mm),
    "lens of a jpeg": Format(exif_jpeg, equivalent_focal_mm),
    "detector errors": Format(detector_errors, load_detector_errors),
    "manifest.json": Format(json_file("a.json", MANIFEST), read_manifest),
    "manifest.csv": Format(
        table(
            "name,tracker,input,options", [("one", "hand-depth", "a.npz", "--seed 3"), ("two", "articulated", "", "")]
        ),
        read_manifest,
    ),
    "mesh.obj": Format(scene_with("a.obj", PYRAMID["obj"].encode()), mesh_numbers),
    "mesh.off": Format(scene_with("a.off", PYRAMID["off"].encode()), mesh_numbers),
    "mesh.ply": Format(scene_with("a.ply", PYRAMID["ply"].encode()), mesh_numbers),
    "binary mesh.ply": Format(scene_with("a.ply", binary_ply()), mesh_numbers),
    "binary mesh.stl": Format(scene_with("a.stl", binary_stl()), mesh_numbers),
    "rows": Format(interrupted_run, resumed_rows),
    "page of results": Format(finished_run, page_numbers),
    # A state may hold any numbers; it is read as it was written.
    "checkpoint": Format(saved_state, lambda path: str(checkpoint.load(path))),
}
TOKENS = [
    *("", "nan", "inf", "-Infinity", "1e999", "1e308", "-1e308", "1e39", "1e-320", "1e30", "0", "-1", "0.5", "1e6"),
    *("9" * 30, "1" * 5000, "999999999999", "0-999999999999", "x" * 4000, "\x00", "\u0663", '"', "null", "true", "-"),
]
VALUES = [
    *(None, True, "", "a", "x" * 4000, [], {}, 0, -1, 1, 2, 0.5, 1e6, 40_000, 10**17, 1e30, 1e39, -1e39, 1e308, 1e-320),
    *(float("nan"), float("inf"), -float("inf"), [[]], [[1], 2], {"a": 1}, [0] * 3000),
]
DTYPES = ("<f2", "<f4", ">f8", "<c16", "|b1", "<i8", "<u8", "|i1", "<U3", "|S2", "<M8[s]", "|V8", "|O")


def mutated_bytes(rng: np.random.Generator, data: bytes) -> bytes:
    """Bits turned, bytes overwritten by extremes, pieces cut, repeated, swapped and inserted."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        # Headers are where the sizes are.
        place = int(rng.integers(min(len(out), 200) if rng.random() < 0.5 else len(out))) if out else 0
        size = int(rng.choice([1, 2, 4, 8]))
        match rng.integers(8):
            case 0 | 1 if out:
                out[place] ^= 1 << int(rng.integers(8))
            case 2 | 3:
                out[place : place + size] = rng.choice([b"\x00", b"\xff", b"\x7f", b"\x80"]) * size
            case 4:
                out = out[:place]
            case 5:
                del out[place : place + int(rng.integers(64))]
            case 6:
                start = int(rng.integers(len(out))) if out else 0
                out[place:place] = out[start : start + int(rng.integers(1, 64))]
            case _:
                out[place:place] = rng.bytes(int(rng.integers(1, 16)))
    return bytes(out)


def mutated_value(rng: np.random.Generator, value: Any) -> Any:
    """One entry of nested lists and objects replaced, removed, repeated or wrapped."""
    if isinstance(value, dict | list) and value and rng.random() < 0.8:
        keys = list(value) if isinstance(value, dict) else range(len(value))
        key, changed = keys[int(rng.integers(len(keys)))], value.copy()
        match rng.integers(10):
            case 0:
                del changed[key]
            case 1 if isinstance(changed, list):
                changed.insert(key, changed[-1])
            case 1:
                changed["unknown"] = changed.pop(key)
            case _:
                changed[key] = mutated_value(rng, value[key])
        return changed
    if rng.random() < 0.2:
        return [value]
    if isinstance(value, int | float) and rng.random() < 0.3:
        return value * float(rng.choice([-1, 0, 1e-9, 1e3, 1e12, 1e39, 1e300]))
    return VALUES[int(rng.integers(len(VALUES)))]


def mutated_json(rng: np.random.Generator, data: bytes) -> bytes:
    value = json.loads(data)
    for _ in range(rng.integers(1, 4)):
        value = mutated_value(rng, value)
    text = json.dumps(value)
    if rng.random() < 0.1:
        text = text.replace("1", str(rng.choice(["1" * 30, "1" * 5000, "[" * 5000, "1e400"])), 1)
    return text.encode()


def mutated_text(rng: np.random.Generator, data: bytes) -> bytes:
    """Words of lines replaced, lines removed, repeated and swapped; words end at spaces, commas and quotation marks."""
    # Meshes may have a header of lines before numbers that are no text.
    lines = data.decode(errors="surrogateescape").split("\n")
    for _ in range(rng.integers(1, 4)):
        i = int(rng.integers(len(lines)))
        match rng.integers(8):
            case 0 if len(lines) > 1:
                del lines[i]
            case 1:
                lines.insert(i, lines[int(rng.integers(len(lines)))])
            case 2:
                j = int(rng.integers(len(lines)))
                lines[i], lines[j] = lines[j], lines[i]
            case _:
                mark = next((mark for mark in ',"' if mark in lines[i]), " ")
                words = lines[i].split(mark)
                words[int(rng.integers(len(words)))] = TOKENS[int(rng.integers(len(TOKENS)))]
                lines[i] = mark.join(words)
    return "\n".join(lines).encode(errors="surrogateescape")


def mutated_array(rng: np.random.Generator, array: np.ndarray) -> np.ndarray:
    match rng.integers(8):
        case 0 if array.ndim:
            return array[: int(rng.integers(len(array) + 1))]
        case 1:
            return array.T if array.ndim > 1 else array[None]
        case 2:
            return array.reshape(-1)
        case 3:
            try:
                return array.astype(DTYPES[int(rng.integers(len(DTYPES)))])
            except (ValueError, TypeError):
                return np.zeros(array.shape, array.dtype)
        case _ if array.dtype.kind in "fiu" and array.size:
            changed = array.copy()
            extremes = [np.nan, np.inf, -np.inf, 1e39, 1e308, 1e30, -1.0, 0.0, 2.0**62, 1e6]
            with np.errstate(all="ignore"):
                worst = np.asarray(extremes[int(rng.integers(len(extremes)))]).astype(array.dtype)
            changed.reshape(-1)[rng.integers(array.size, size=rng.choice([1, array.size]))] = worst
            return changed
        case _ if array.dtype.kind == "U" and str(array)[:1] == "{":
            return np.asarray(mutated_json(rng, str(array).encode()).decode())
        case _:
            return np.asarray(TOKENS[int(rng.integers(len(TOKENS)))])


def mutated_npz(rng: np.random.Generator, data: bytes) -> bytes:
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files}
    for _ in range(rng.integers(1, 3)):
        name = sorted(arrays)[int(rng.integers(len(arrays)))]
        if rng.random() < 0.1 and len(arrays) > 1:
            del arrays[name]
        else:
            with np.errstate(all="ignore"):
                arrays[name] = mutated_array(rng, arrays[name])
    entries = {name: npy_bytes(rng, array) for name, array in arrays.items()}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", int(rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))) as file:
        for name, content in entries.items():
            file.writestr(f"{name}.npy", content)
        if rng.random() < 0.1:
            fields = ("file_size", "compress_size", "CRC", "header_offset", "flag_bits", "compress_type")
            which = int(rng.integers(len(fields)))
            values = (0, 1, 14, 2**12, 2**31) if which < 4 else (1, 9, 14, 99)
            setattr(file.filelist[0], fields[which], values[int(rng.integers(len(values)))])
    return out.getvalue()


def npy_bytes(rng: np.random.Generator, array: np.ndarray) -> bytes:
    """An array in NumPy's format, a few with headers that claim another shape or type."""
    stream = io.BytesIO()
    if rng.random() > 0.1:
        np.save(stream, array)
        return stream.getvalue()
    shape = [(10**12,), (-1,), (2**40, 2**40), array.shape[::-1], (0,)][int(rng.integers(5))]
    header = {"descr": str(rng.choice(DTYPES)), "fortran_order": bool(rng.integers(2)), "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + array.tobytes()


def mutated_png(rng: np.random.Generator, data: bytes) -> bytes:
    """Another size or kind in the header, with the check sum that belongs to it."""
    sides = rng.choice([0, 1, 33, 4000, 2**15, 2**16, 2**24, 2**31 - 1], size=2)
    header = b"IHDR" + struct.pack(">II", *map(int, sides)) + data[24:29]
    if rng.random() < 0.3:
        header = b"IHDR" + data[16:24] + rng.bytes(5)
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def mutated_sides(rng: np.random.Generator, data: bytes) -> bytes:
    """Another number of columns or rows where the header of a JPEG, a BMP or a TIFF has it."""
    starts = [place for side in (24, 32) for mark in (side.to_bytes(2, "big"), side.to_bytes(2, "little"))
              for place in range(2, min(len(data), 700)) if data[place : place + 2] == mark]  # fmt: skip
    starts += [len(data) - place for place in range(2, min(len(data), 200)) if data[-place] in (24, 32)]
    out = bytearray(data)
    for _ in range(2):
        place = starts[int(rng.integers(len(starts)))]
        out[place : place + 2] = int(rng.choice([0, 1, 33, 4000, 2**15, 2**16 - 1])).to_bytes(2, "big")
    return bytes(out)


MUTATIONS = {
    ".json": mutated_json,
    ".ndjson": mutated_text,
    ".inkml": mutated_text,
    ".jpg": mutated_sides,
    ".bmp": mutated_sides,
    ".tiff": mutated_sides,
    ".npz": mutated_npz,
    ".csv": mutated_text,
    ".xml": mutated_text,
    ".unipen": mutated_text,
    ".stl": mutated_text,
    ".obj": mutated_text,
    ".off": mutated_text,
    ".ply": mutated_text,
    ".png": mutated_png,
}
"""By the format's structure; a third of the files, and those of other suffixes, have their bytes changed."""


def mutated(rng: np.random.Generator, data: bytes, suffix: str) -> bytes:
    by_structure = MUTATIONS.get(suffix)
    if by_structure is None or rng.random() < 0.35:
        return mutated_bytes(rng, data)
    return by_structure(rng, data)


@contextmanager
def bounded():
    """Raises `MemoryError` or `TimeoutError` where a reader wants too much."""

    def too_late(*_):
        raise TimeoutError

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGALRM, too_late)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_MEMORY, hard))
    signal.alarm(MOST_SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


def fault(format: Format, path: Path) -> str | None:
    """What is wrong with how a file was read; None where it gave finite numbers, or one short line."""
    try:
        with bounded():
            numbers = format.read(path)
    except (InputError, CheckpointError) as error:
        text = str(error).replace(str(path.parent), "")
        if len(text) > LONGEST_MESSAGE or "\n" in text or "pickle" in text:
            return f"too long a message: {re.sub('[^a-z ]', '', text)[:40]!r}"
        return None
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {str(error)[:80]!r}"
    for leaf in jax.tree.leaves(numbers):
        if isinstance(leaf, np.ndarray | jax.Array | float) and np.asarray(leaf).dtype.kind == "f":
            bad = np.isinf(leaf) if format.may_lack else ~np.isfinite(leaf)
            if bad.any():
                return f"a number is {np.asarray(leaf)[bad][0]}"
    return None


def mutated_file(name: str, number: int, folder: Path) -> Path:
    """Writes the input of a format with one of its files mutated; what its reader is given."""
    format = FORMATS[name]
    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    files = format.write(folder)
    changed = files[int(rng.integers(len(files)))]
    changed.write_bytes(mutated(rng, changed.read_bytes(), changed.suffix))
    return files[0]


@pytest.mark.system
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs the memory of the process")
@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.filterwarnings("ignore")
def test_mutated_files_are_read_as_finite_numbers_or_refused_in_one_line(name, tmp_path):
    with bounded():
        FORMATS[name].read(FORMATS[name].write(tmp_path)[0])
    found: dict[str, list[int]] = {}
    for number in range(FORMATS[name].files):
        wrong = fault(FORMATS[name], mutated_file(name, number, tmp_path))
        if wrong:
            found.setdefault(wrong, []).append(number)
    assert not found, "\n".join(f"{name}: files {numbers}: {wrong}" for wrong, numbers in found.items())


def test_ten_thousand_files_are_tried():
    assert sum(format.files for format in FORMATS.values()) >= 10_000
