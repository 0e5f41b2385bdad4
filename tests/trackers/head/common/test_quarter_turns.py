"""Recordings that are stored sideways."""

import cv2
import numpy as np
import pytest

from jaxfilters.trackers.head.common.quarter_turns import upright
from jaxfilters.trackers.io.video_input import ImageFolder


@pytest.fixture
def stored(draw_face, tmp_path):
    """Makes a folder of images of a face after a rotation, half a second apart."""

    def folder(rotation, count=3):
        image, _ = draw_face((200, 150), 60.0, shape=(320, 400))
        for i in range(count):
            cv2.imwrite(str(tmp_path / f"{i}.png"), image if rotation is None else cv2.rotate(image, rotation))
        return ImageFolder(tmp_path, 2.0), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)

    return folder


@pytest.mark.parametrize(
    ("rotation", "degrees"),
    [(cv2.ROTATE_90_CLOCKWISE, 270), (cv2.ROTATE_90_COUNTERCLOCKWISE, 90), (cv2.ROTATE_180, 180)],
)
def test_a_face_that_lies_sideways_is_turned(stored, rotation, degrees):
    source, image = stored(rotation)
    turned, note = upright(source)
    assert f"clockwise by {degrees} degrees" in note
    assert (turned.image_size, turned.fps, turned.frames) == ((400, 320), 2.0, 3)
    times, images = zip(*turned.images(), strict=True)
    assert times == (0.0, 0.5, 1.0)
    np.testing.assert_array_equal(images[0], image)
    np.testing.assert_array_equal(turned.sample(1)[0], image)
    assert turned.trouble() is None


def test_upright_faces_and_a_single_find_stay_as_they_are(stored):
    source, _ = stored(None)
    assert upright(source) == (source, None)


def test_one_image_may_be_a_mistake(stored):
    source, _ = stored(cv2.ROTATE_180, count=1)
    assert upright(source) == (source, None)
