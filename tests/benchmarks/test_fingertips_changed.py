"""Changed videos of fingertips: marks stay on what they mark."""

import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import fingertips_changed
from jaxfilters.benchmarks.scenarios._marked_tips import NAMES, Count
from jaxfilters.benchmarks.scenarios.fingertips_changed import Changed

MARK = (52, 31)
"""(u, v) of a bright square, in frame 1 of 3."""


def marked_video():
    images = [np.full((90, 120, 3), 40, np.uint8) for _ in range(3)]
    images[1][MARK[1] - 2 : MARK[1] + 3, MARK[0] - 2 : MARK[0] + 3] = 220
    frames = {"1": {"tips": {"index": list(MARK)}, "cut": {}}}
    return Changed(images, {"frames": frames, "half_width_px": 10.0})


@pytest.mark.parametrize("name", list(fingertips_changed.changes(0)))
def test_a_mark_is_where_the_changed_image_has_what_is_marked(name):
    """The middle of what is bright, to a pixel."""
    video = fingertips_changed.changes(0)[name](marked_video())
    ((frame, own),) = video.marks["frames"].items()
    image = video.images[int(frame)].mean(axis=2)
    v, u = np.nonzero(image > (image.min() + image.max()) / 2)
    np.testing.assert_allclose([u.mean(), v.mean()], own["tips"]["index"], atol=1.0)
    scale = np.sqrt(image.size / (90 * 120))
    assert video.marks["half_width_px"] == pytest.approx(10 * scale)
    assert len(u) == pytest.approx(25 * scale**2, abs=8 * scale)


def test_quarter_turns_and_mirrored_images_have_all_pixels_where_numpy_has_them():
    video = marked_video()
    images = [np.random.default_rng(0).integers(0, 256, image.shape, np.uint8) for image in video.images]
    changes = fingertips_changed.changes(0)
    for turns in (1, 2, 3):
        found = changes[f"turned_{90 * turns}"](video._replace(images=images)).images
        np.testing.assert_array_equal(found[0], np.rot90(images[0], turns))
    np.testing.assert_array_equal(changes["mirrored"](video._replace(images=images)).images[0], images[0][:, ::-1])


def test_backwards_has_the_marks_of_the_opposite_frames():
    video = marked_video()
    video.marks["frames"]["0"] = {"tips": {}, "cut": {"thumb": [1, 2]}}
    frames = fingertips_changed.changes(0)["backwards"](video).marks["frames"]
    assert frames["2"]["cut"] == {"thumb": [1, 2]}
    assert frames["1"]["tips"] == {"index": list(MARK)}


def test_counts_of_two_videos_add_up_and_names_are_those_of_the_worse():
    names = {name: set[int]() for name in NAMES}
    one, other = Count(10, 9, 11, 2, names | {"index": {1, 2}}), Count(5, 1, 1, 0, names | {"index": {1}, "thumb": {0}})
    found = fingertips_changed.total([one, other])
    assert found[:4] == (15, 10, 12, 2)
    assert found.metrics["names_per_finger"] == 2
