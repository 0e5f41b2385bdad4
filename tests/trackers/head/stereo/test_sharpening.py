"""Registered shapes made sharper, against the truth of rendered faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.patches import CURVATURE_STD, SKIN_NORMALS, unknown_slopes
from jaxfilters.models.face.rig import monocular, project_shape
from jaxfilters.models.synthetic.face_motion import STEREO_PLACE_MM
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.models.synthetic.face_texture import NORMALS
from jaxfilters.trackers.head.stereo import sharpening
from jaxfilters.trackers.head.stereo.registration import register, register_monocular
from jaxfilters.trackers.head.stereo.sharpening import UNSEEN_DEPTH_MM

sharpened, first_slopes = jax.jit(sharpening.sharpened), jax.jit(sharpening.first_slopes)
SEEDS = range(8)
FLAT = np.array([0.05, 0.05, 0.001, 0.001, 0.001])
"""How well the slopes and curvatures of planes are known."""


def slopes_of_the_planes():
    """Rise over run of the planes that were rendered, out of those of an average head, seen from ahead."""
    unit = SKIN_NORMALS / np.linalg.norm(SKIN_NORMALS, axis=1, keepdims=True)
    across = np.cross(unit, [0.0, 1, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    within = np.stack([across, np.cross(unit, across)], axis=-1)
    sight = np.array([0.0, 0, -1])
    lift = sight / (unit @ sight)[:, None]
    mean = -np.einsum("kx,kxi->ki", NORMALS, within) / np.einsum("kx,kx->k", NORMALS, lift)[:, None]
    slopes = unknown_slopes(10)
    return slopes._replace(
        mean=slopes.mean.at[:, :2].set(mean), covariance=jnp.tile(jnp.diag(jnp.asarray(FLAT**2)), (10, 1, 1))
    )


class Start:
    """A registered face, and the truth about it."""

    def __init__(self, seed):
        self.video = face_sequence(jax.random.key(seed), np.array([[*STEREO_PLACE_MM, 0.0, 0, 0]]))
        self.images, self.rig = self.video.frames(0, 1)[0], self.video.rig
        self.points = self.video.uv[0, 0].astype(float)
        (model, self.pose, self.uv) = register(self.images, self.points, self.rig)
        self.shape = model.mean
        self.true = self.video.shapes[0] + self.video.poses[0][:3] - np.asarray(self.pose[:3])

    def sharpened(self, slopes, images=None):
        images = self.images if images is None else images
        return sharpened(images, self.shape, self.pose, slopes, self.rig)


@pytest.fixture(scope="module")
def starts():
    return [Start(seed) for seed in SEEDS]


def depth(errors):
    return np.sqrt(np.mean(np.square(errors)[..., 2]))


@pytest.mark.system
def test_depths_become_right_to_a_fraction_of_a_millimetre(starts):
    """From 0.45 mm to 0.15 mm once the skin's slopes are known; an average head's are already worth something."""
    slopes = slopes_of_the_planes()
    before = [np.asarray(one.shape) - one.true for one in starts]
    average = [np.asarray(one.sharpened(unknown_slopes(10)).shape) - one.true for one in starts]
    known = [np.asarray(one.sharpened(slopes).shape) - one.true for one in starts]
    assert 0.3 < depth(before) < 0.7
    assert depth(average) < 0.9 * depth(before)
    assert depth(known) < 0.2
    assert depth(known) < 0.45 * depth(before)


@pytest.mark.system
@pytest.mark.parametrize("known", [True, False])
def test_depths_are_known_as_well_as_claimed(starts, known):
    """Squared errors over variances of 80 landmarks, whose mean is 1; 4 sqrt(2 / 80) = 0.63. Unknown slopes are
    taken for worse than those of the rendered planes are."""
    results = [one.sharpened(slopes_of_the_planes() if known else unknown_slopes(10)) for one in starts]
    error = np.stack([np.asarray(r.shape) - one.true for r, one in zip(results, starts, strict=True)])
    variance = np.stack([np.diagonal(r.covariance, axis1=1, axis2=2) for r in results])
    square = error[..., 2] ** 2 / variance[..., 2]
    assert square.mean() < 1.63
    assert square.mean() > (0.1 if known else 0.01)
    assert np.all(np.linalg.eigvalsh(np.stack([r.covariance for r in results])) > 0)


@pytest.mark.system
def test_landmarks_stay_where_they_are_in_the_first_image(starts):
    for one in starts[:3]:
        found = one.sharpened(slopes_of_the_planes())
        uv, _ = project_shape(one.rig, found.shape, one.pose)
        np.testing.assert_allclose(uv[0], one.uv[0], atol=2e-3)
        assert np.abs(uv[1] - one.uv[1]).max() > 0.02
        sight = np.asarray(one.shape) + np.asarray(one.pose[:3])
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        step = np.asarray(found.shape - one.shape)
        np.testing.assert_allclose(step - np.sum(step * sight, axis=1, keepdims=True) * sight, 0, atol=1e-3)
        largest = np.linalg.eigh(found.covariance)[1][:, :, -1]
        assert np.abs(np.sum(largest * sight, axis=1)).min() > 0.9


@pytest.mark.system
def test_a_second_time_changes_little(starts):
    slopes = slopes_of_the_planes()
    once = starts[0].sharpened(slopes)
    twice = sharpened(starts[0].images, once.shape, starts[0].pose, slopes, starts[0].rig)
    first, second = (np.abs(b - a)[:, 2].max() for a, b in ((starts[0].shape, once.shape), (once.shape, twice.shape)))
    assert second < 0.25 * first


@pytest.mark.system
def test_what_is_not_found_stays_where_it_was(starts):
    """Another picture in the second image: no landmark moves farther than a match may, and depths say so."""
    one = starts[1]
    wrong = np.stack([one.images[0], np.roll(one.images[1], 40, axis=0)])
    found = one.sharpened(slopes_of_the_planes(), wrong)
    assert np.all(np.isfinite(found.shape))
    uv, _ = project_shape(one.rig, found.shape, one.pose)
    assert np.linalg.norm(uv[1] - one.uv[1], axis=-1).max() < sharpening.MOST_CHANGE_PX + 0.2
    right = one.sharpened(slopes_of_the_planes())
    depths = [np.median(np.sqrt(np.asarray(r.covariance)[:, 2, 2])) for r in (found, right)]
    assert depths[0] > 2 * depths[1]


@pytest.mark.system
def test_pictures_that_differ_make_depths_less_certain(starts):
    """Something else behind the edge of a face, say: noise in one window of the second image."""
    one, slopes = starts[2], slopes_of_the_planes()
    u, v = np.round(np.asarray(one.uv)[1, 4]).astype(int)
    images = one.images.copy()
    window = images[1, v - 8 : v + 8, u - 8 : u + 8]
    images[1, v - 8 : v + 8, u - 8 : u + 8] = window + np.random.default_rng(0).integers(-10, 11, window.shape)
    sure, unsure = one.sharpened(slopes), one.sharpened(slopes, images)
    ratio = np.sqrt(np.asarray(unsure.covariance)[:, 2, 2] / np.asarray(sure.covariance)[:, 2, 2])
    assert ratio[4] > 1.5
    np.testing.assert_allclose(np.delete(ratio, 4), 1, atol=0.05)


@pytest.mark.system
def test_pictures_of_one_moment_tell_the_slopes(starts):
    """Closer to those of the planes than an average head's, and no curvature; depths become better by as much."""
    true = np.asarray(slopes_of_the_planes().mean)
    found = [first_slopes(one.images, one.shape, one.pose, one.rig) for one in starts]
    off = np.stack([np.asarray(slopes.mean) - true for slopes in found])
    claimed = np.stack([np.diagonal(slopes.covariance, axis1=1, axis2=2) for slopes in found])
    assert np.sqrt(np.mean(off[..., :2] ** 2)) < 0.7 * np.sqrt(np.mean(true[:, :2] ** 2))
    assert np.mean(off**2 / claimed) < 1.3
    assert np.all(np.sqrt(claimed[..., 2:]) < CURVATURE_STD)
    depths = [
        depth([np.asarray(one.sharpened(s).shape) - one.true for one, s in zip(starts, chosen, strict=True)])
        for chosen in (found, [unknown_slopes(10)] * len(starts))
    ]
    assert depths[0] < 0.8 * depths[1]


@pytest.mark.system
def test_one_camera_knows_nothing_of_depth(starts):
    rig = monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))
    image, points = starts[0].images[0], starts[0].points
    model, pose, _ = register_monocular(image, points, rig)
    found = sharpened(image[None], model.mean, pose, unknown_slopes(10), rig)
    np.testing.assert_allclose(found.shape, model.mean, atol=1e-4)
    largest = np.sqrt(np.linalg.eigvalsh(found.covariance)[:, -1])
    np.testing.assert_allclose(largest, UNSEEN_DEPTH_MM, rtol=0.01)
