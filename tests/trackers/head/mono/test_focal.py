"""The focal length that a talking head tells, against the camera that filmed it."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfilters.trackers.head.mono.focal import DETERMINED, LOG_STD, FocalLength
from jaxfilters.trackers.head.mono.session import MonoSession


def followed(rig, face, talking, detected, share):
    """A session that takes the focal length for so much of the true one."""
    made, images = talking
    session = MonoSession(replace(rig, focal=share * rig.focal), face, detections=detected)
    for i in range(0, len(images), 8):
        session.process(images[i : i + 8], made.times[i : i + 8])
    return session


@pytest.mark.system
def test_a_wrong_focal_length_is_put_right(rig, face, talking, detected):
    """Assumed a third too short, whatever the size of the face: at least half of the way back, within its deviation."""
    found = followed(rig, face, talking, detected, 0.7).focal_length()
    off = np.log(0.7 * float(found.factor))
    assert abs(off) < 0.5 * abs(np.log(0.7))
    # Once in 370 it would be farther off, if the deviation is right.
    assert abs(off) < 3 * float(found.log_std)
    assert float(found.log_std) < LOG_STD


@pytest.mark.system
def test_one_image_does_not_tell(rig, face, talking):
    made, images = talking
    session = MonoSession(rig, face, points=np.asarray(made.uv[0, 0], float))
    session.process(images[:1], made.times[:1])
    found = session.focal_length()
    assert not found.is_determined
    assert 0.7 < float(found.factor) < 1.4


@pytest.mark.parametrize(("share", "is_determined"), [(0.9, True), (1.1, False)])
def test_determined_is_much_better_than_assumed(share, is_determined):
    found = FocalLength(np.float32(1.0), np.float32(share * DETERMINED * LOG_STD))
    assert found.is_determined is is_determined
