"""What a long benchmark keeps of its finished parts."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxfilters.benchmarks import finished
from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._mono_runs import MonoRun, as_arrays, from_arrays
from jaxfilters.trackers.head.mono.state import MonoTrack
from jaxfilters.trackers.io.errors import InputError

METRICS = {
    "error": Metric(1 / 3, "mm", "lower"),
    "speed": Metric(float("inf"), "frames/s", "higher"),
    "coverage": Metric(0.9, "", 0.954),
}


class Measuring:
    """Counts how often it had to measure."""

    def __init__(self):
        self.times = 0

    def __call__(self):
        self.times += 1
        return METRICS


@pytest.mark.system
def test_what_is_finished_is_measured_once(tmp_path):
    measure = Measuring()
    for _ in range(2):
        assert Finished(tmp_path, seed=0).metrics("speed", measure) == METRICS
    assert measure.times == 1
    Finished(tmp_path, seed=0).metrics("starts", measure)
    Finished(tmp_path, seed=1).metrics("speed", measure)
    assert measure.times == 3


def test_without_a_folder_everything_is_measured():
    measure = Measuring()
    for _ in range(2):
        assert Finished(None, seed=0).metrics("speed", measure) == METRICS
    assert measure.times == 2


def test_other_code_measures_anew(tmp_path, monkeypatch):
    measure, package = Measuring(), tmp_path / "package"
    package.mkdir()
    (package / "tracker.py").write_text("STEPS = 1")
    monkeypatch.setattr(finished, "package_folders", lambda: [package])
    Finished(tmp_path).metrics("speed", measure)
    (package / "tracker.py").write_text("STEPS = 2")
    Finished(tmp_path).metrics("speed", measure)
    assert measure.times == 2


def test_another_package_measures_anew(tmp_path, monkeypatch):
    measure = Measuring()
    for packages in ([], [SimpleNamespace(name="mediapipe", version="0.10.14")]):
        monkeypatch.setattr(finished, "distributions", lambda packages=packages: packages)
        Finished(tmp_path).metrics("speed", measure)
    assert measure.times == 2


def test_what_breaks_off_leaves_nothing(tmp_path):
    def broken():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Finished(tmp_path).metrics("speed", broken)
    assert not list(tmp_path.rglob("*.npz*"))


def test_a_damaged_file_is_named(tmp_path):
    Finished(tmp_path).metrics("speed", Measuring())
    (path,) = tmp_path.rglob("speed.npz")
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match=r"speed\.npz: not a complete \.npz file"):
        Finished(tmp_path).metrics("speed", Measuring())


def test_runs_come_back_as_they_were():
    rng = np.random.default_rng(0)
    track = MonoTrack(*(rng.normal(size=(3, i + 1)) for i in range(len(MonoTrack._fields))))
    runs = {
        name: MonoRun(track, rng.normal(size=(3, 6)), rng.normal(size=3), rng.normal(size=3)) for name in ("a", "b.c")
    }
    back = from_arrays(as_arrays(runs))
    assert list(back) == list(runs)
    for name, run in runs.items():
        for one, other in zip((*run.track, *run[1:]), (*back[name].track, *back[name][1:]), strict=True):
            np.testing.assert_array_equal(one, other)
