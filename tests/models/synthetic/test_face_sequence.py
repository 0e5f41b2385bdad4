"""Videos of drawn faces: their truth, and that images do not depend on how they are asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_motion import motion
from jaxfilters.models.synthetic.face_sequence import face_sequence, sequence


@pytest.fixture(scope="module")
def disturbed():
    return sequence(jax.random.key(0), "slow", 360, 3, deform=True, occlusion=True)


@pytest.mark.system
def test_images_are_the_same_however_they_are_asked_for(disturbed):
    together = disturbed.frames(10, 14)
    np.testing.assert_array_equal(disturbed.frames(12, 14), together[2:])
    assert together.shape == (4, 2, 480, 640)
    assert together.dtype == np.uint8
    assert np.any(together[0] != together[1])


@pytest.mark.system
def test_chunks_cover_every_frame_once():
    short = face_sequence(jax.random.key(1), motion("mix", 5, 0))
    pieces = list(short.chunks(2))
    assert [start for start, _ in pieces] == [0, 2, 4]
    np.testing.assert_array_equal(np.concatenate([images for _, images in pieces]), short.frames(0, 5))


def test_truth_is_the_projection_of_the_posed_shape(disturbed):
    for frame in (0, 170, 359):
        R = Rotation.from_euler("ZYX", disturbed.poses[frame, 3:]).as_matrix()
        world = disturbed.shapes[frame] @ R.T + disturbed.poses[frame, :3]
        for camera, t in ((0, 0.0), (1, -120.0)):
            x, y, z = (world + np.array([t, 0, 0])).T
            expected = np.stack([800 * x / z + 319.5, 800 * y / z + 239.5], axis=-1)
            np.testing.assert_allclose(disturbed.uv[frame, camera], expected, atol=1e-3)
    np.testing.assert_allclose(disturbed.times[:3], [0, 1 / 30, 2 / 30])


def test_shapes_deform_about_the_centroid_of_the_neutral_face(disturbed):
    np.testing.assert_allclose(disturbed.shapes[0].mean(axis=0), 0, atol=1e-4)
    np.testing.assert_array_equal(disturbed.shapes[100], disturbed.shapes[0])
    moved = np.linalg.norm(disturbed.shapes - disturbed.shapes[0], axis=-1)
    assert moved[:, [4, 5]].max() > 8
    assert moved[:, [1, 2]].max() == 0


@pytest.mark.system
def test_the_occluder_covers_mouth_and_nostrils_in_both_cameras_and_nothing_else(disturbed):
    covered = face_sequence(
        jax.random.key(0), disturbed.poses[:216], expressions=disturbed.expressions[:216], covered=np.ones(216, bool)
    )
    frame = int(np.flatnonzero(disturbed.covered)[0]) - 1
    observed, hidden = disturbed.frames(frame, frame + 1)[0], covered.frames(frame, frame + 1)[0]
    for camera in (0, 1):
        for k, (u, v) in enumerate(np.round(disturbed.uv[frame, camera]).astype(int)):
            window = (camera, slice(v - 8, v + 8), slice(u - 8, u + 8))
            if k in (4, 5, 6, 7):
                assert hidden[window].std() < 3
                assert observed[window].std() > 5
            else:
                np.testing.assert_array_equal(hidden[window], observed[window])


@pytest.mark.system
def test_one_camera_will_do():
    rig = monocular(Pinhole.from_intrinsics(400.0, (159.5, 119.5), (240, 320)))
    one = face_sequence(jax.random.key(2), motion("slow", 3, 1, place_mm=(0.0, 0.0, 650.0)), rig=rig)
    assert one.frames(0, 1).shape == (1, 1, 240, 320)
    assert one.uv.shape == (3, 1, 10, 2)


def test_frames_outside_the_sequence_are_refused(disturbed):
    for start, stop in ((-1, 3), (5, 4), (350, 361)):
        with pytest.raises(ValueError, match=r"start and stop must be within 0\.\.360"):
            disturbed.frames(start, stop)


@pytest.mark.system
def test_people_of_different_keys_differ():
    poses = motion("slow", 2, 0)
    a, b = (face_sequence(jax.random.key(i), poses) for i in (0, 1))
    assert jnp.abs(a.identity.neutral - b.identity.neutral).max() > 0.5
