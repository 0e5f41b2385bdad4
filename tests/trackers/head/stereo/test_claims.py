"""What one camera takes for granted: faces of other sizes, through lenses of other focal lengths, drawn at random."""

import numpy as np
import pytest

from jaxfilters.trackers.head.common.state import HeadTrack
from jaxfilters.trackers.head.stereo.claims import with_assumptions
from jaxfilters.trackers.io.face_models import SIZE_STD

FOCAL_LOG_STD, DRAWS = 0.05, 20000


def track_of(pose, pose_std):
    return HeadTrack(*[None] * len(HeadTrack._fields))._replace(pose=pose[None], pose_std=pose_std[None])


@pytest.mark.parametrize("axis", [0, 1])
def test_deviations_are_those_of_heads_of_any_size_and_lenses_of_any_focal_length(axis):
    """The images of heads off the optical axis, read as if sizes and focal lengths were the usual ones."""
    rng = np.random.default_rng(0)
    size, focal = np.exp(rng.normal(0, SIZE_STD, DRAWS)), np.exp(rng.normal(0, FOCAL_LOG_STD, DRAWS))
    aside, z, first_std = 250.0, 650.0, np.array([1.0, 1.0, 2.0, 0.01, 0.02, 0.03])
    # A camera measures the direction in pixels and the spread of the landmarks, size * focal / z.
    ray, z_read = aside / z * focal, z / (size * focal)
    turned = np.arctan(ray) - np.arctan(aside / z)
    pose = np.zeros(6)
    pose[[axis, 2]] = aside, z
    found = with_assumptions(track_of(pose, first_std), FOCAL_LOG_STD).pose_std[0]
    more = np.sqrt(found**2 - first_std**2)
    np.testing.assert_allclose(more[[axis, 2]], [np.std(ray * z_read), np.std(z_read)], rtol=0.05)
    np.testing.assert_allclose(more[4 + axis], np.std(turned), rtol=0.05)
    np.testing.assert_allclose(np.delete(more, [axis, 2, 4 + axis]), 0, atol=1e-6)


def test_frames_without_a_face_have_none():
    nothing = np.full(6, np.nan)
    rows = with_assumptions(track_of(nothing, nothing), 0.0)
    assert np.isnan(rows.pose_std).all()
    np.testing.assert_array_equal(rows.pose, nothing[None])
