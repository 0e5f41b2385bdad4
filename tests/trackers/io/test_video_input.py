"""Images from files and folders, and several sources on one clock."""

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import ImageFolder, VideoFile, on_one_clock, open_video, together


def _video(path, frames=12, fps=10.0, size=(64, 48)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    for i in range(frames):
        writer.write(np.full((size[1], size[0], 3), 20 * i % 256, np.uint8))
    writer.release()
    return path


class _Stub:
    def __init__(self, times, fps):
        self.times, self.fps, self.name, self.image_size = times, fps, "stub", (2, 2)

    def sample(self, most):
        return []

    def trouble(self):
        return None

    def images(self):
        for i, t in enumerate(self.times):
            yield t, np.full((2, 2, 3), i, np.uint8)


def test_a_video_gives_all_its_frames_with_their_times(tmp_path):
    source = open_video(str(_video(tmp_path / "a.mp4")))
    images = list(source.images())
    assert source.image_size == (64, 48)
    assert len(images) == 12
    np.testing.assert_allclose([t for t, _ in images], np.arange(12) / 10)
    # The video coder keeps flat images to a few grey levels.
    np.testing.assert_allclose([image.mean() for _, image in images], 20 * np.arange(12) % 256, atol=4)
    assert source.trouble() is None
    assert len(source.sample(4)) == 4


@pytest.mark.parametrize("claimed", [3, 7, 12])
def test_samples_reach_the_end_whatever_number_of_frames_a_file_claims(tmp_path, claimed):
    source = VideoFile(_video(tmp_path / "a.mp4"))
    source.frames = claimed
    sampled = source.sample(4)
    frames = np.round([image.mean() / 20 for image in sampled])
    assert len(frames) == 4
    # A pan over 12 frames of growing brightness: from the first to one of the last three, without large gaps.
    assert frames[0] == 0
    assert frames[-1] >= 9
    assert np.diff(frames).max() <= 5


def test_a_video_that_is_cut_off_says_so(tmp_path):
    source = VideoFile(_video(tmp_path / "a.mp4"))
    source.frames = 20
    assert len(list(source.images())) == 12
    assert "12 of 20" in source.trouble()


def test_a_damaged_or_missing_video_is_refused(tmp_path):
    (tmp_path / "b.mp4").write_bytes(b"not a video")
    with pytest.raises(InputError, match="not a video"):
        open_video(str(tmp_path / "b.mp4"))
    with pytest.raises(InputError, match="no such file"):
        open_video(str(tmp_path / "c.mp4"))


def test_a_folder_of_images_is_read_in_order_and_must_be_of_one_size(tmp_path):
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), np.full((4, 6, 3), 10 * i, np.uint8))
    source = open_video(str(tmp_path), fps=5.0)
    assert isinstance(source, ImageFolder)
    assert [(t, int(image[0, 0, 0])) for t, image in source.images()] == [(0.0, 0), (0.2, 10), (0.4, 20)]
    cv2.imwrite(str(tmp_path / "999.png"), np.zeros((5, 6, 3), np.uint8))
    with pytest.raises(InputError, match=r"999\.png"):
        list(open_video(str(tmp_path)).images())
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(InputError, match="no images"):
        open_video(str(empty))


def test_images_are_in_the_order_of_their_numbers_which_are_their_clock(tmp_path):
    """Numbered without leading zeros, every fifth frame of a video, two of them missing."""
    for number in (95, 100, 105, 120, 125):
        cv2.imwrite(str(tmp_path / f"frame_{number}.png"), np.full((4, 6, 3), number, np.uint8))
    (stream,) = on_one_clock([open_video(str(tmp_path), fps=10.0)])
    assert [int(image[0, 0, 0]) for _, image in stream] == [95, 100, 105, 120, 125]
    np.testing.assert_allclose([t for t, _ in open_video(str(tmp_path), fps=10.0).images()], [0, 0.1, 0.2, 0.5, 0.6])
    cv2.imwrite(str(tmp_path / "frame_0100.png"), np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(InputError, match=r"frame_0100\.png and frame_100\.png have one frame number"):
        open_video(str(tmp_path))
    (tmp_path / "frame_0100.png").rename(tmp_path / "other.png")
    assert [t for t, _ in open_video(str(tmp_path), fps=10.0).images()] == pytest.approx(np.arange(6) / 10)


def test_folders_that_are_numbered_alike_are_on_one_clock(tmp_path):
    """The second camera began two frames later, and has lost one."""
    for name, numbers in (("a", range(6)), ("b", (2, 3, 5))):
        (tmp_path / name).mkdir()
        for number in numbers:
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.full((4, 6, 3), number, np.uint8))
    moments = list(together([open_video(str(tmp_path / name), fps=10.0) for name in "ab"]))
    found = [[None if image is None else int(image[0, 0, 0]) for image in moment.images] for moment in moments]
    assert found == [[0, None], [1, None], [2, 2], [3, 3], [4, None], [5, 5]]
    np.testing.assert_allclose([moment.time_s for moment in moments], np.arange(6) / 10, atol=1e-9)


def test_a_slower_source_has_nothing_new_in_between():
    moments = list(together([_Stub(np.arange(6) / 10, 10.0), _Stub(np.arange(3) / 5, 5.0)]))
    assert [moment.images[1] is not None for moment in moments] == [True, False] * 3
    assert all(moment.images[0] is not None for moment in moments)
    np.testing.assert_allclose([moment.time_s for moment in moments], np.arange(6) / 10)


def test_a_source_that_ends_early_leaves_the_others_going():
    moments = list(together([_Stub(np.arange(2) / 10, 10.0), _Stub(np.arange(4) / 10, 10.0)]))
    assert [moment.images[0] is not None for moment in moments] == [True, True, False, False]
    assert [int(moment.images[1][0, 0, 0]) for moment in moments] == [0, 1, 2, 3]
