"""Images of several cameras: what belongs together, what is missing, what ends."""

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.io import video_input
from jaxfilters.trackers.io.paired_input import PairedInput
from jaxfilters.trackers.io.video_input import ImageFolder, LiveCamera, VideoFile


class Stub:
    """A source whose images hold their number; None stands for nothing new."""

    def __init__(self, name, times, fps=10.0, numbers=None, trouble=None):
        self.name, self.times, self.fps, self.image_size = name, times, fps, (2, 2)
        self.numbers = range(len(times)) if numbers is None else numbers
        self._trouble = trouble

    def sample(self, most):
        return []

    def trouble(self):
        return self._trouble

    def images(self):
        for time_s, number in zip(self.times, self.numbers, strict=True):
            yield time_s, None if number is None else np.full((2, 2, 3), number, np.uint8)


def numbers(moments):
    return [tuple(None if image is None else int(image[0, 0, 0]) for image in moment.images) for moment in moments]


def test_images_within_half_a_frame_belong_together():
    jitter = np.array([0.0, 0.04, -0.04, 0.02])
    paired = PairedInput([Stub("a", np.arange(4) / 10), Stub("b", np.arange(4) / 10 + jitter)])
    assert numbers(paired) == [(0, 0), (1, 1), (2, 2), (3, 3)]
    assert paired.trouble() == []


def test_a_dropped_frame_leaves_a_gap_and_no_shift():
    paired = PairedInput([Stub("a", np.arange(5) / 10), Stub("b", np.array([0.0, 0.1, 0.3, 0.4]))])
    moments = list(paired)
    assert numbers(moments) == [(0, 0), (1, 1), (2, None), (3, 2), (4, 3)]
    np.testing.assert_allclose([moment.time_s for moment in moments], np.arange(5) / 10)
    (said,) = paired.trouble()
    assert said.startswith("1 of 5 moments skipped")
    assert "(50 ms) of each other; the first at 0.20 s, without b" in said


def test_a_slower_camera_leaves_gaps_that_are_counted():
    paired = PairedInput([Stub("a", np.arange(6) / 10), Stub("b", np.arange(3) / 5, fps=5.0)])
    assert numbers(paired)[:5] == [(0, 0), (1, None), (2, 1), (3, None), (4, 2)]
    assert "2 of 5 moments skipped" in paired.trouble()[-1]
    assert "not synchronised" in paired.trouble()[-1]


def test_the_source_that_ends_first_ends_all_and_is_named():
    paired = PairedInput([Stub("left.mp4", np.arange(3) / 10), Stub("right.mp4", np.arange(6) / 10)])
    assert numbers(paired) == [(0, 0), (1, 1), (2, 2)]
    assert paired.trouble() == ["left.mp4: over after 3 moments, before right.mp4"]
    both = PairedInput([Stub("a", np.arange(3) / 10), Stub("b", np.arange(3) / 10)])
    assert len(list(both)) == 3
    assert both.trouble() == []
    assert list(PairedInput([Stub("a", []), Stub("b", [0.0])])) == []


def test_a_live_camera_is_waited_for_until_it_has_stopped():
    waits = Stub("camera 0", [7.0, 7.05, 7.1], numbers=[0, None, 1])
    assert numbers(PairedInput([waits, Stub("camera 1", [7.0, 7.1])])) == [(0, 0), (1, 1)]
    stopped = Stub("camera 0", [7.0, 7.05, 7.1], numbers=[0, None, 1], trouble="camera 0: no image since 2 s")
    paired = PairedInput([stopped, Stub("camera 1", [7.0, 7.1])])
    moments = list(paired)
    assert numbers(moments) == [(0, 0)]
    assert moments[0].time_s == 0
    assert paired.trouble() == ["camera 0: no image since 2 s", "camera 0: over after 1 moments, before camera 1"]


def folder_of(path, names):
    path.mkdir()
    for i, name in enumerate(names):
        cv2.imwrite(str(path / f"{name}.png"), np.full((4, 6, 3), 10 * i, np.uint8))
    return ImageFolder(path, 30.0)


@pytest.mark.parametrize(
    ("left", "right", "expected"),
    [
        # A counter, one frame missing.
        (["l_08", "l_09", "l_10", "l_11"], ["r_08", "r_10", "r_11"], [(0, 0), (10, None), (20, 10), (30, 20)]),
        # Time stamps in microseconds.
        (["1000000", "1033366", "1066700"], ["1000300", "1066900", "1100000"], [(0, 0), (10, None), (20, 10)]),
        # No numbers, numbers of nothing in common, and counters of other steps: their order is all there is.
        (["a", "b", "c"], ["1", "2", "3"], [(0, 0), (10, 10), (20, 20)]),
        (["1", "2", "3"], ["5", "6", "7"], [(0, 0), (10, 10), (20, 20)]),
        (["1", "2", "3"], ["1", "3", "5"], [(0, 0), (10, 10), (20, 20)]),
    ],
)
def test_numbered_folders_keep_their_own_clock(tmp_path, left, right, expected):
    paired = PairedInput([folder_of(tmp_path / "l", left), folder_of(tmp_path / "r", right)])
    assert numbers(paired) == expected


def test_a_video_is_on_the_clock_of_its_file(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (64, 48))
    for _ in range(6):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    np.testing.assert_allclose([t for t, _ in VideoFile(tmp_path / "a.mp4").images()], np.arange(6) / 25, atol=1e-9)
    np.testing.assert_allclose([t for t, _ in VideoFile(tmp_path / "a.mp4", 10.0).images()], np.arange(6) / 10)


class Capture:
    """A file whose stamps are gone after its third frame."""

    stamps = (40.0, 80.0, 120.0, 0.0, 0.0, 240.0)

    def __init__(self):
        self.done = 0

    def get(self, what):
        return {cv2.CAP_PROP_FPS: 25.0, cv2.CAP_PROP_FRAME_WIDTH: 6.0}.get(what, self.stamps[max(self.done - 1, 0)])

    def read(self):
        self.done += 1
        return self.done <= len(self.stamps), np.zeros((4, 6, 3), np.uint8)

    def release(self):
        pass


def test_a_video_without_stamps_goes_on_at_its_pace(tmp_path, monkeypatch):
    monkeypatch.setattr(VideoFile, "_open", lambda self: Capture())
    (tmp_path / "a.mp4").touch()
    times = [t for t, _ in VideoFile(tmp_path / "a.mp4").images()]
    np.testing.assert_allclose(times, [0, 0.04, 0.08, 0.12, 0.16, 0.2])


@pytest.mark.parametrize("last", [80, 70], ids=["repeated", "late"])
def test_a_frame_whose_stamp_does_not_increase_follows_the_one_before_and_is_counted(last, tmp_path, monkeypatch):
    monkeypatch.setattr(Capture, "stamps", (40, 80, last, 160))
    monkeypatch.setattr(VideoFile, "_open", lambda self: Capture())
    (tmp_path / "a.mp4").touch()
    video, given = VideoFile(tmp_path / "a.mp4"), VideoFile(tmp_path / "a.mp4", 10.0)
    np.testing.assert_allclose([t for t, _ in video.images()], [0, 0.04, 0.08, 0.12])
    assert (
        "1 time stamps do not increase; these frames were taken to follow the one before by 1/25 s" in video.trouble()
    )
    np.testing.assert_allclose([t for t, _ in given.images()], [0, 0.1, 0.2, 0.3])
    assert "time stamps" not in given.trouble()


class Camera:
    """Delivers an image every 20 ms, its number in it, and stops after thirty."""

    def __init__(self, number):
        self.done = 0

    def read(self):
        if self.done >= 30:
            return False, None
        video_input.time.sleep(0.02)
        self.done += 1
        return True, np.full((4, 6, 3), self.done, np.uint8)

    def get(self, what):
        return 50.0


def test_live_cameras_share_a_clock_and_end_when_they_stop(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    monkeypatch.setattr(video_input, "SILENT_S", 0.3)
    paired = PairedInput([LiveCamera(0), LiveCamera(1)])
    moments = list(paired)
    assert moments[0].time_s == 0
    assert 0.3 < moments[-1].time_s < 1.5
    assert sum(None not in pair for pair in numbers(moments)) > 5
    assert "no image since" in paired.trouble()[0]
