"""A face whose nose and mouth are covered: a patch with lines, which some registered patches resemble by chance."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.head.common.state import DEFORMABLE, DOUBTFUL, LOST
from jaxfilters.trackers.head.mono import redetection
from jaxfilters.trackers.head.mono.estimate import FEWEST_SURE, unsure
from jaxfilters.trackers.head.mono.session import MonoSession

COVERED = slice(28, 44)
"""Frames; four of the ten landmarks are nostrils and corners of the mouth."""


def covered(image, points):
    """The image with a grey patch with dark lines over nose and mouth."""
    changed = image.copy()
    eyes = points[:4].reshape(2, 2, 2).mean(axis=1)
    apart = np.linalg.norm(eyes[1] - eyes[0])
    (u, v), (width, height) = points[4:8].mean(axis=0), (1.5 * apart, 1.4 * apart)
    rows = slice(round(v - height / 2), round(v + height / 2))
    cols = np.arange(round(u - width / 2), round(u + width / 2))
    lines = np.min(np.abs(np.subtract.outer(cols, u + width * np.array([-0.25, 0.0, 0.25]))), axis=1)
    changed[rows, cols[0] : cols[-1] + 1] = np.where(lines < 1.5, 60, 150)
    return changed


def test_a_covered_landmark_counts_again_from_a_higher_correlation_than_one_that_never_was():
    """Columns: never covered, covered now, resembling by chance since, returned, followed by another patch since."""
    before = jnp.array([False, False, True, True, True])
    has_changed = jnp.array([[False, True, False, False, False]])
    score = jnp.array([[0.6, 0.3, 0.6, 0.8, 0.0]])
    assert unsure(before, has_changed, score).tolist() == [False, True, True, False, True]


@pytest.mark.system
def test_a_covered_face_is_in_doubt_in_every_frame_and_beyond_it_soon_after(rig, face, talking, detected):
    made, images = talking
    images = images.copy()
    for i in range(COVERED.start, COVERED.stop):
        images[i, 0] = covered(images[i, 0], made.uv[i, 0])
    session = MonoSession(rig, face, detections=detected)
    track = session.process(images, made.times)
    status, yaw_std = track.status, track.pose_std[:, 4]
    assert np.all(np.isin(status[COVERED], (DOUBTFUL, LOST)))
    assert np.all(status[COVERED.start - 4 : COVERED.start] == DEFORMABLE)
    assert np.all(status[COVERED.stop + 10 :] == DEFORMABLE)
    assert np.all(yaw_std[COVERED.start + 1 : COVERED.stop] > 1.2 * yaw_std[COVERED.start - 1])


@pytest.mark.system
def test_a_landmark_that_resembles_its_patch_by_chance_asks_for_no_detection(rig, face, talking, detected):
    """The track goes on as it is where enough landmarks look as registered, although it is reported as in doubt."""
    made, images = talking
    session = MonoSession(rig, face, detections=detected)
    track = session.process(images[:24], made.times[:24])
    state = session._following.state
    row = type(track)(*(leaf[-1] for leaf in track))._replace(status=np.int32(DOUBTFUL))
    few = jnp.arange(10)[None] >= FEWEST_SURE - 1
    with_changed = lambda changed: state._replace(recent=state.recent._replace(has_changed=changed))
    assert redetection.is_beyond_doubt(with_changed(jnp.zeros_like(few)), row)
    assert not redetection.is_beyond_doubt(with_changed(few), row)
    assert redetection.is_beyond_doubt(with_changed(few), row._replace(status=np.int32(DEFORMABLE)))
    missed = with_changed(jnp.zeros_like(few))._replace(misses=jnp.ones((), jnp.int32))
    assert not redetection.is_beyond_doubt(missed, row)
