"""`--rerun`: what is sent to the viewer, by a stand-in of its package, and read back from a file where it is there."""

import subprocess
import sys
from contextlib import closing
from importlib.util import find_spec
from operator import attrgetter
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

from jaxfilters.models.articulated.layout import Layout
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.rerun_log import RerunLog
from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.articulated.table import TimedArticulatedTrack, articulated_table
from jaxfilters.trackers.fingertips.table import TIP_TABLE, TimedTips
from jaxfilters.trackers.hand_depth.table import HAND_TABLE, POSE_COLUMNS, STD_COLUMNS, TimedHandTrack
from jaxfilters.trackers.head.common.table import HEAD_TABLE, TimedHeadTrack, empty_rows
from jaxfilters.trackers.head.mono.table import TimedMonoTrack, empty_mono_rows, mono_table
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.face_models import default_face_model
from jaxfilters.trackers.people.state import STATE, PeopleConfig
from jaxfilters.trackers.people.table import TimedPeopleTrack, people_table
from jaxfilters.trackers.people.tracker import people_scene
from jaxfilters.trackers.registry import SYSTEMS


class Track(NamedTuple):
    """Rows of two objects that move on a floor, and of their places in the image."""

    frame: np.ndarray
    times_s: np.ndarray
    name: np.ndarray
    xy: np.ndarray
    std: np.ndarray
    uv: np.ndarray
    status: np.ndarray


TABLE = TrackTable(
    Track,
    (
        Columns(("id",), attrgetter("name")),
        Columns(("x_m", "y_m"), attrgetter("xy")),
        Columns(("x_std_m", "y_std_m"), attrgetter("std")),
        Columns(("tip_x_px", "tip_y_px"), attrgetter("uv")),
    ),
)
TRACK = Track(
    np.array([3, 3, 4]),
    np.array([0.3, 0.3, 0.4]),
    np.array(["a", "b", "a"]),
    np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
    np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]),
    np.array([[7.0, 8.0]] * 3),
    np.array([1, 1, 2]),
)


class FakeRerun:
    """Keeps what it is sent, by entity."""

    def __init__(self):
        self.sent, self.logged, self.now = {}, [], {}
        self.Scalars = SimpleNamespace(columns=lambda scalars: scalars.tolist())
        self.Ellipsoids3D = self.Ellipses2D = SimpleNamespace(
            columns=lambda centers, half_sizes: (centers.tolist(), half_sizes.tolist())
        )
        self.Image = lambda image: SimpleNamespace(compress=lambda jpeg_quality: image)

    def RecordingStream(self, name):
        return self

    def TimeColumn(self, name, sequence=None, duration=None):
        return name, (sequence if duration is None else duration).tolist()

    def save(self, path):
        self.path = path

    def send_columns(self, entity, indexes, columns):
        self.sent[entity] = (dict(indexes), columns)

    def set_time(self, name, sequence=None, duration=None):
        self.now[name] = sequence if duration is None else duration

    def log(self, entity, image):
        self.logged.append((entity, dict(self.now), image))

    def flush(self):
        pass

    disconnect = flush


def test_numbers_places_and_pictures_are_sent_with_their_frames_and_times(tmp_path, monkeypatch):
    fake = FakeRerun()
    monkeypatch.setitem(sys.modules, "rerun", fake)
    with closing(RerunLog(str(tmp_path / "new" / "run.rrd"), TABLE)) as log:
        log.rows(0, TRACK)
        log.rows(5, Track(*(field[:0] for field in TRACK)))
        log.picture(3, 0.3, np.array([[[1, 2, 3]]], np.uint8))
    assert fake.path == str(tmp_path / "new" / "run.rrd")
    assert (tmp_path / "new").is_dir()
    index = {"frame": [3, 4], "time": [0.3, 0.4]}
    assert fake.sent["numbers/x_m/a"] == (index, [1.0, 5.0])
    assert fake.sent["numbers/y_std_m/b"] == ({"frame": [3], "time": [0.3]}, [0.4])
    assert fake.sent["numbers/status/a"] == (index, [1.0, 2.0])
    assert fake.sent["places/estimate/a"] == (index, ([[1, 2, 0], [5, 6, 0]], [[0.2, 0.4, 0], [1.0, 1.2, 0]]))
    assert fake.sent["picture/tip/b"][1] == ([[7, 8]], [[0, 0]])
    ((entity, now, image),) = fake.logged
    assert (entity, now, image.tolist()) == ("picture", {"frame": 3, "time": 0.3}, [[[3, 2, 1]]])


def test_what_is_missing_or_wrong_is_named(monkeypatch):
    with pytest.raises(InputError, match=r"--rerun run.mp4: expected a file whose name ends in .rrd"):
        RerunLog("run.mp4", TABLE)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"--rerun: needs rerun-sdk: pip install 'jaxfilters\[viz\]'"):
        RerunLog("run.rrd", TABLE)


@pytest.mark.usefixtures("fake_hand_depth")
def test_a_file_for_the_viewer_holds_the_run(npz_file, tmp_path, monkeypatch):
    if find_spec("rerun") is None:
        pytest.skip("needs rerun-sdk")
    monkeypatch.setenv("XLA_FLAGS", "")
    file = tmp_path / "run.rrd"
    arguments = ["track", "hand-depth", str(npz_file), "--no-video", "--out", str(tmp_path / "out")]
    assert main([*arguments, "--rerun", str(file)]) == 0
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(file)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for entity in ("/picture", "/numbers/wrist_x_m", "/numbers/status", "/places/wrist"):
        assert entity in shown


ROWS = 3


def rows_of(kind, **fields):
    """Rows of a table: the given arrays, and ones in all other fields."""
    made = {name: fields.get(name, np.ones(ROWS)) for name in kind._fields}
    frames = {"frame": 4 + np.arange(ROWS)} if "frame" in kind._fields else {}
    return kind(**made | frames | {"times_s": np.arange(ROWS) / 10, "status": np.zeros(ROWS, int)})


def poses(size):
    """(rows, size) numbers that differ, of which the first frame is not observed."""
    values = 0.1 * np.arange(ROWS * size).reshape(ROWS, size)
    values[0] = np.nan
    return values


def hand_depth():
    stds = np.full((ROWS, len(STD_COLUMNS)), 0.01)
    return HAND_TABLE, rows_of(TimedHandTrack, pose=poses(len(POSE_COLUMNS)), pose_std=stds), "places/wrist"


def articulated():
    layout = Layout(2)
    arrays = {"mean": poses(layout.size), "std": np.full((ROWS, layout.size), 0.5)}
    observed = np.ones((ROWS, layout.lengths.stop - layout.lengths.start), bool)
    rows = rows_of(TimedArticulatedTrack, **arrays, length_observed=observed)
    return articulated_table(layout), rows, "picture/wrist"


def people():
    # 3 m above the floor, turned down by 37 degrees.
    R = np.array([[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]])
    K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    camera = FloorCamera.from_matrix(K @ np.column_stack([R, -R @ [0.0, -5.0, 3.0]]), (120, 160))
    floor = np.array([[-2.0, -2], [2, -2], [2, 2], [-2, 2]])
    scene = people_scene([camera], floor, config=PeopleConfig(capacity=2, cell_m=2.0))
    covariance = np.tile(0.04 * np.eye(STATE), (ROWS, 1, 1))
    rows = rows_of(
        TimedPeopleTrack,
        identity=np.full(ROWS, 7),
        mean=np.ones((ROWS, STATE)),
        covariance=covariance,
        slot=np.zeros(ROWS, int),
        image=np.arange(ROWS),
        innovations=np.ones((ROWS, 2), int),
    )
    return people_table(scene), rows, "places/estimate/7"


def head_stereo():
    arrays = empty_rows(2, ROWS)._asdict() | {"pose": poses(6), "pose_std": np.full((ROWS, 6), 0.01)}
    return HEAD_TABLE, rows_of(TimedHeadTrack, **arrays), "places/estimate"


def head_mono():
    face = default_face_model().model
    arrays = empty_mono_rows(face, ROWS)._asdict() | {"pose": poses(6), "pose_std": np.full((ROWS, 6), 0.01)}
    return mono_table(face), rows_of(TimedMonoTrack, **arrays), "places/estimate"


def fingertips():
    two = np.full((ROWS, 2), 40.0)
    fields = {"hand": np.zeros(ROWS, int), "finger": np.full(ROWS, 2), "position": two, "velocity": two}
    return TIP_TABLE, rows_of(TimedTips, **fields, position_std=0.1 * two), "picture/estimate/0-2"


PLACES = {
    "hand-depth": ("wrist_x_m", "wrist_x_std_m"),
    "articulated": ("wrist_x_px", "wrist_x_std_px"),
    "fingertips": ("x_px", "x_std_px"),
    **dict.fromkeys(("people", "head-stereo", "head-mono"), ("x_m", "x_std_m")),
}
"""Columns of the first coordinate of a place, and of its standard deviation."""
MADE = {
    "hand-depth": hand_depth,
    "articulated": articulated,
    "people": people,
    "head-stereo": head_stereo,
    "head-mono": head_mono,
    "fingertips": fingertips,
}


@pytest.mark.parametrize("name", [one.name for one in SYSTEMS])
def test_the_table_of_every_system_is_read_back_from_a_file(name, tmp_path):
    """By the package of the viewer: the numbers of `track.csv` as time series, an ellipsoid of two deviations."""
    reader = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk").RrdReader
    table, rows, place = MADE[name]()
    file = tmp_path / "run.rrd"
    with closing(RerunLog(str(file), table)) as log:
        log.rows(4, rows)
    chunks = {chunk.entity_path: chunk.to_record_batch().to_pydict() for chunk in reader(file).stream().to_chunks()}
    frames, times, *columns = zip(*table.rows(4, rows), strict=True)
    written = {name: column for name, column in zip(table.columns, columns, strict=False) if name != "id"}
    below = f"/{place.rpartition('/')[2]}" if "id" in table.columns else ""
    for column, expected in written.items():
        found = chunks[f"/numbers/{column}{below}"]
        assert found["frame"] == list(frames)
        np.testing.assert_allclose([time.total_seconds() for time in found["time"]], np.array(times, float), atol=1e-6)
        np.testing.assert_allclose(np.ravel(found["Scalars:scalars"]), np.array(expected, float), rtol=1e-8)
    found, kind = chunks[f"/{place}"], "Ellipses2D" if place.startswith("picture") else "Ellipsoids3D"
    x, x_std = (np.array(written[name], float) for name in PLACES[name])
    np.testing.assert_allclose([one[0][0] for one in found[f"{kind}:centers"]], x, rtol=1e-6)
    np.testing.assert_allclose([one[0][0] for one in found[f"{kind}:half_sizes"]], 2 * x_std, rtol=1e-6)
