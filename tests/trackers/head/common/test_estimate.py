"""One frame's estimate on rendered faces: the mean around the mode, and the fit near it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face.landmarks import BROWS, EYES, MOUTH
from jaxfilters.models.face.rig import nominal, project_shape
from jaxfilters.models.synthetic.face_motion import STEREO_PLACE_MM
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.trackers.head.common import estimate as module
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.estimate import MODEL_VARIANCE, RESIDUAL_SCALE, around_mode
from jaxfilters.trackers.head.common.search import gathered
from jaxfilters.trackers.head.common.state import NUM_MODES, POSE, UNITS
from jaxfilters.trackers.head.stereo.registration import register
from jaxfilters.trackers.head.stereo.tracking import begin

refined = jax.jit(module.refined)
MOVED = np.array([*STEREO_PLACE_MM, 0, 0, 0]) + np.array([6, -4, 15, *np.radians([3, -8, 5])])


class Face:
    """Registered in the first frame; moved in the second, with another expression in the third."""

    def __init__(self):
        poses = np.stack([[*STEREO_PLACE_MM, 0.0, 0, 0], MOVED, MOVED])
        expressions = np.array([(0.0, 0), (0, 0), (0.3, 0.4)])
        self.video = face_sequence(jax.random.key(5), poses, expressions=expressions)
        images = self.video.frames(0, 3)
        self.images, self.rig = jnp.asarray(images, float), self.video.rig
        model, pose, _ = register(images[0], self.video.uv[0, 0].astype(float), self.rig, num_modes=NUM_MODES)
        self.state = begin(
            jax.random.key(0), model, pose, images[0], jnp.zeros(()), self.rig, options=HeadConfig(num_particles=50)
        )

    def refined(self, frame, off=0.0, images=None):
        """From particles gathered near the truth, `off` in millimetres and degrees."""
        x = jnp.concatenate([jnp.asarray(MOVED + np.asarray(off) * UNITS, float), jnp.zeros(NUM_MODES)])
        spread = jnp.concatenate([jnp.asarray(20 * UNITS, float), jnp.zeros(NUM_MODES)])
        search = gathered(self.state.search, x)._replace(estimate=x, spread=spread)
        images = self.images[frame] if images is None else images
        return refined(search, self.state, self.state.model, images, self.rig, jnp.zeros(POSE))


@pytest.fixture(scope="module")
def face():
    return Face()


@pytest.mark.parametrize("cameras", [1, 2])
def test_displaced_images_move_a_head_by_the_pseudoinverse_of_its_pixels(cameras):
    """Beside NumPy's pseudoinverse of central differences of the projection; of one camera the depth stays."""
    rig = nominal()
    rig = jax.tree.map(lambda leaf: leaf[:cameras], rig) if cameras == 1 else rig
    place = np.array([30.0, -20, 640])
    project = lambda at: np.asarray(project_shape(rig, jnp.zeros((1, 3)), jnp.array([*at, 0.1, -0.3, 0.2]))[0], float)
    steps = np.eye(3)
    by_place = np.stack([(project(place + d) - project(place - d)).ravel() / 2 for d in steps], axis=-1)
    inverse = np.linalg.pinv(by_place, rcond=1e-3)
    found = np.asarray(module.matching_covariance(rig, jnp.array([*place, 0.1, -0.3, 0.2])), float)
    # Differences of float32 pixels are right to 1e-4 of a pixel, and the damping takes 4 % of the variance of depth.
    np.testing.assert_allclose(found / module.MATCHING_STD**2, inverse @ inverse.T, rtol=0.06, atol=0.03)


@pytest.mark.system
@pytest.mark.parametrize("off", [(0, 0, 0, 0, 0, 0), (1.5, -1, 4, 0.7, -1.5, 1)])
def test_the_fit_finds_the_pose_from_nearby(face, off):
    found = face.refined(1, off)
    error = np.asarray(found.belief.mean[:POSE]) - MOVED
    deviation = np.sqrt(np.diagonal(found.belief.covariance)[:POSE])
    assert bool(found.is_found)
    assert np.all(np.abs(error) / UNITS < [0.3, 0.3, 1.0, 0.2, 0.6, 0.6])
    assert np.all(np.abs(error) < 4 * deviation)
    assert np.all(deviation / UNITS < [0.5, 0.5, 1.5, 0.3, 0.8, 0.8])
    np.testing.assert_allclose(found.belief.mean[POSE:], 0, atol=1e-3)


@pytest.mark.system
def test_a_face_at_rest_keeps_its_registered_shape(face):
    found = face.refined(1)
    np.testing.assert_allclose(found.shape, face.state.registered.shape, atol=0.02)


@pytest.mark.system
def test_a_face_that_deforms_is_measured(face):
    """The mouth and the brows have moved by some 6 mm; what is measured is where they are, but for depth."""
    found = face.refined(2)
    change = np.asarray(found.measured - face.state.registered.shape)
    true = face.video.shapes[2] - face.video.shapes[1]
    moved = list(MOUTH + BROWS)
    assert np.abs(true[moved]).max() > 5
    assert np.sqrt(np.mean((change - true)[moved][:, :2] ** 2)) < 0.25 * np.sqrt(np.mean(true[moved][:, :2] ** 2))
    assert bool(found.is_found)
    error = (np.asarray(found.belief.mean[:POSE]) - MOVED) / UNITS
    assert np.all(np.abs(error) < [0.6, 0.8, 2.5, 0.6, 1.5, 2.0])


@pytest.mark.system
def test_landmarks_that_moved_become_loose(face):
    found = face.refined(2)
    change = np.sqrt(np.asarray(found.model_variance)) - np.sqrt(np.asarray(face.state.model_variance))
    assert change[list(MOUTH)].min() > change[list(EYES)].max()
    for values, (low, high) in ((found.model_variance, MODEL_VARIANCE), (found.residual_scale, RESIDUAL_SCALE)):
        assert np.all((np.asarray(values) >= low * (1 - 1e-5)) & (np.asarray(values) <= high))


@pytest.mark.system
@pytest.mark.parametrize("kind", ["noise", "flat"])
def test_no_face_is_not_found(face, kind):
    noise = np.random.default_rng(0).integers(0, 256, face.images[0].shape)
    images = jnp.asarray(noise if kind == "noise" else np.full(noise.shape, 100), float)
    found = face.refined(1, images=images)
    assert not bool(found.is_found)
    assert np.all(np.isfinite(found.belief.mean))
    np.testing.assert_allclose(found.slopes.mean, face.state.slopes.mean, atol=1e-6)


@pytest.mark.system
def test_the_slopes_of_the_skin_become_better_known(face):
    found = face.refined(1)
    before, after = (np.diagonal(s.covariance, axis1=1, axis2=2) for s in (face.state.slopes, found.slopes))
    assert np.all(after <= before * (1 + 1e-5))
    assert np.median(after / before) < 0.8


@pytest.mark.system
def test_the_papers_estimate_is_the_mean_that_the_search_has_made(face):
    rng = np.random.default_rng(1)
    particles = rng.normal(size=(POSE + NUM_MODES, 50))
    w = rng.uniform(size=50)
    estimate = (particles * w).sum(axis=1) / w.sum()
    search = face.state.search._replace(
        particles=jnp.asarray(particles, float),
        log_weights=jnp.asarray(np.log(w / w.sum()), float),
        estimate=jnp.asarray(estimate, float),
    )
    found = around_mode(search, face.state, face.state.model)
    np.testing.assert_allclose(found.belief.mean, estimate, atol=1e-6)
    np.testing.assert_allclose(found.belief.covariance, np.cov(particles, aweights=w, ddof=0), atol=1e-5)
    np.testing.assert_array_equal(found.shape, face.state.model.mean)
    assert bool(found.is_found)
    silent = search._replace(
        log_weights=search.log_weights.at[3].set(-jnp.inf), particles=search.particles.at[:, 3].set(jnp.inf)
    )
    assert np.all(np.isfinite(around_mode(silent, face.state, face.state.model).belief.covariance))
