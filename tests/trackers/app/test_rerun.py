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

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.app.rerun_log import RerunLog
from jaxfilters.trackers.app.results import Columns, TrackTable
from jaxfilters.trackers.io.errors import InputError


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
