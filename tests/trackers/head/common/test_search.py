"""The search's likelihood, motion and resampling on a rendered face (oracles 3, 4 and 13 of the specification)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.filter import predict, update
from jaxfilters.models.face.correlation import score_points
from jaxfilters.models.face.rig import project_shape
from jaxfilters.models.face.shape_model import rigid
from jaxfilters.models.synthetic.face_motion import STEREO_PLACE_MM
from jaxfilters.models.synthetic.face_sequence import face_sequence
from jaxfilters.trackers.head.common import search as module
from jaxfilters.trackers.head.common.config import HeadConfig, compiled
from jaxfilters.trackers.head.common.search import (
    HIGH,
    KAPPA,
    LEAST_DEVIATION,
    LOW,
    FaceLikelihood,
    at,
    first_diffusion,
    gathered,
    searches,
)
from jaxfilters.trackers.head.common.search import start as start_search
from jaxfilters.trackers.head.common.state import NUM_MODES, POSE, UNITS
from jaxfilters.trackers.head.stereo.registration import register

N = 300
OPTIONS = HeadConfig(num_particles=N)
likelihood = jax.jit(lambda likelihood, particles, images: likelihood(particles, images))
score_at = jax.jit(module.score_at)
step = jax.jit(lambda filter, key, state, tau: predict(filter, key, state, tau))
weigh = jax.jit(lambda filter, key, state, images: update(filter, key, state, images))


class Face:
    """A face at rest in two frames of different noise, registered in the first."""

    def __init__(self):
        video = face_sequence(jax.random.key(3), np.tile([*STEREO_PLACE_MM, 0.0, 0, 0], (2, 1)))
        images = video.frames(0, 2)
        self.rig, self.first, self.images = video.rig, jnp.asarray(images[0]), jnp.asarray(images[1])
        model, self.pose, _ = register(images[0], video.uv[0, 0].astype(float), video.rig, num_modes=NUM_MODES)
        basis = np.linalg.qr(np.random.default_rng(0).normal(size=(30, NUM_MODES)))[0]
        self.rigid = model
        self.model = replace(model, basis=jnp.asarray(basis, float), deviation=jnp.array([6.0, 4, 2.5, 1.6, 0.0]))
        self.x = jnp.concatenate([jnp.asarray(self.pose), jnp.zeros(NUM_MODES)])

    def likelihood(self, model=None):
        model = self.model if model is None else model
        return FaceLikelihood(model, model.templates, self.rig)


@pytest.fixture(scope="module")
def face():
    return Face()


@pytest.mark.system
def test_the_registered_face_scores_nearly_all_there_is(face):
    """Oracle 3: c >= 2K - 0.6 in another frame, where noise has a standard deviation of 2 grey levels."""
    found = score_at(face.rigid, face.rigid.templates, face.rig, face.x, face.images)
    assert 20 * float(found) >= 20 - 0.6
    assert float(score_at(face.rigid, face.rigid.templates, face.rig, face.x, face.first)) > 0.999
    away = face.x.at[0].add(20.0)
    assert float(score_at(face.rigid, face.rigid.templates, face.rig, away, face.images)) < 0.5
    outside = face.x.at[0].add(5000.0)
    assert float(score_at(face.rigid, face.rigid.templates, face.rig, outside, face.images)) == -1
    behind = face.x.at[2].set(-650.0)
    assert float(score_at(face.rigid, face.rigid.templates, face.rig, behind, face.images)) == -1


def test_landmarks_that_are_turned_away_have_no_part_in_the_score(face):
    """They have flat templates; the score is the mean of the others, also with none left."""
    whole = float(score_at(face.rigid, face.rigid.templates, face.rig, face.x, face.images))
    hidden = face.rigid.templates.at[:, 3:].set(0.0)
    some = float(score_at(face.rigid, hidden, face.rig, face.x, face.images))
    uv, _ = project_shape(face.rig, face.rigid.mean, face.x[:POSE])
    expected = np.mean([float(_score(face.images[c], hidden[c, k], uv[c, k])) for c, k in np.ndindex(2, 3)])
    assert some == pytest.approx(expected, abs=1e-5)
    assert some > 0.9 * whole
    assert float(score_at(face.rigid, 0 * hidden, face.rig, face.x, face.images)) == 0


def particles_about(face, deformed=1.0, n=N):
    rng = np.random.default_rng(1)
    spread = np.array([*(3 * UNITS), *[deformed] * NUM_MODES])
    return face.x[:, None] + jnp.asarray(spread[:, None] * rng.normal(size=(POSE + NUM_MODES, n)), float)


@pytest.mark.system
def test_weights_are_those_of_the_paper(face):
    """Oracle 4, from projections one by one, and windows cut one by one."""
    particles = particles_about(face, n=20).at[:, 0].set(face.x)
    found = np.asarray(likelihood(face.likelihood(), particles, face.images))
    expected = []
    for x in np.asarray(particles, float).T:
        shape = np.asarray(face.model.mean) + (np.asarray(face.model.basis) @ x[POSE:]).reshape(10, 3)
        uv, _ = project_shape(face.rig, jnp.asarray(shape, float), jnp.asarray(x[:POSE], float))
        c = sum(float(_score(face.images[i], face.model.templates[i, k], uv[i, k])) for i, k in np.ndindex(2, 10))
        expected.append(-((20 - c) ** 2) / 18 - 0.5 * np.sum((x[POSE:-1] / [6, 4, 2.5, 1.6]) ** 2))
    np.testing.assert_allclose(found, expected, atol=5e-3)
    assert found.argmax() == 0
    normal = np.exp(found - found.max()) / np.exp(found - found.max()).sum()
    shifted = np.exp(found + 7 - (found + 7).max())
    np.testing.assert_allclose(shifted / shifted.sum(), normal, rtol=1e-4, atol=1e-7)


@jax.jit
def _score(image, template, place):
    return score_points(image, template, place[None])[0]


def test_one_standard_deviation_of_a_mode_costs_half(face):
    """Oracle 4: with modes that move no landmark, c is the same."""
    model = replace(face.model, basis=jnp.zeros_like(face.model.basis))
    deformations = jnp.zeros((NUM_MODES, 20)).at[:, 1:6].set(jnp.diag(model.deviation))
    particles = jnp.concatenate([jnp.tile(face.x[:POSE, None], (1, 20)), deformations])
    log = np.asarray(likelihood(face.likelihood(model), particles, face.images))[:6]
    np.testing.assert_allclose(log[1:] - log[0], [-0.5] * 4 + [0], atol=1e-4)


def permuted(model, rig, images, landmarks, cameras):
    """The same face with landmarks and cameras in another order."""
    rows = (3 * landmarks[:, None] + np.arange(3)).ravel()
    templates = model.templates[cameras][:, landmarks]
    model = replace(model, mean=model.mean[landmarks], basis=model.basis[rows], templates=templates)
    return model, jax.tree.map(lambda leaf: leaf[cameras], rig), images[cameras]


@pytest.mark.system
def test_the_order_of_landmarks_and_cameras_does_not_matter(face, x64):
    """Oracle 13: one frame with the same random keys; the world stays the frame of the left camera."""
    wide = lambda tree: jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf), float), tree)
    model, rig, x, images = *wide((face.model, face.rig, face.x)), face.images
    ten, two = np.arange(10), np.arange(2)
    estimates = []
    for order in ((ten, two), (np.random.default_rng(2).permutation(10), two), (ten, two[::-1])):
        one, cameras, observed = permuted(model, rig, images, *order)
        filter = at(searches(cameras, OPTIONS).layered, one, one.templates, one.deviation)
        state = step(filter, jax.random.key(0), start_search(x, OPTIONS), 1.0)
        estimates.append(np.asarray(weigh(filter, jax.random.key(1), state, observed)[0].estimate))
    np.testing.assert_allclose(estimates[1:], [estimates[0]] * 2, atol=1e-6)
    assert np.abs(estimates[0] - np.asarray(x)).max() > 0.01


@pytest.mark.system
def test_particles_spread_as_fast_as_the_head_goes(face):
    velocity = jnp.asarray(UNITS * [2.0, 0, -60, 0, 3, 0], float)
    state = start_search(face.x, OPTIONS)._replace(velocity=velocity)
    filter = at(searches(face.rig, OPTIONS).layered, face.model, face.model.templates, face.model.deviation)
    moved = step(filter, jax.random.key(0), state, 1.0)
    expected = np.clip(np.abs(velocity) + UNITS, LOW, HIGH)
    np.testing.assert_allclose(moved.spread[:POSE], expected, rtol=1e-5)
    np.testing.assert_allclose(moved.spread[POSE:], KAPPA * face.model.deviation, rtol=1e-5)
    apart = np.asarray(moved.particles - face.x[:, None])
    # Halfway: every particle moves in the pose or in the modes (specification, section 2.8).
    in_pose, in_modes = np.any(apart[:POSE] != 0, axis=0), np.any(apart[POSE:-1] != 0, axis=0)
    np.testing.assert_array_equal(in_pose, ~in_modes)
    assert in_pose.sum() == N // 2
    # 150 numbers: means within 4 / sqrt(150), deviations within 4 / sqrt(300), of their standard deviation.
    noise = (apart[:POSE, in_pose] - np.asarray(velocity)[:, None]) / expected[:, None]
    assert np.abs(noise.mean(axis=1)).max() < 4 / np.sqrt(150)
    assert np.abs(noise.std(axis=1) - 1).max() < 4 / np.sqrt(300)


@pytest.mark.parametrize(("fixed", "expected"), [(5.0, 5.0), (1.0, 1.0), (100.0, None)])
def test_a_fixed_diffusion_does_not_care_for_speed(face, fixed, expected):
    options = HeadConfig(num_particles=N, diffusion="fixed", fixed_diffusion=fixed)
    filter = at(searches(face.rig, options).rigid, face.rigid, face.rigid.templates, jnp.zeros(NUM_MODES))
    for speed in (0.0, 7.0):
        state = start_search(face.x, options)._replace(velocity=jnp.asarray(speed * UNITS, float))
        spread = step(filter, jax.random.key(0), state, 1.0).spread[:POSE]
        np.testing.assert_allclose(spread, HIGH if expected is None else expected * UNITS, rtol=1e-5)


def test_options_that_differ_in_numbers_share_a_program():
    """The diffusion is a leaf of filters and state, not a constant of what is compiled."""
    fixed = [HeadConfig(diffusion="fixed", fixed_diffusion=value, seed=i) for i, value in enumerate((1.0, 5.0))]
    assert compiled(fixed[0]) == compiled(fixed[1]) == compiled(HeadConfig())
    assert compiled(HeadConfig(diffusion="online")) != compiled(HeadConfig())
    assert compiled(HeadConfig(variant="published")) != compiled(HeadConfig())
    one, two = (jax.tree.structure(first_diffusion(options)) for options in fixed)
    assert one == two


def test_the_filter_is_fitted_to_the_model_of_the_day(face):
    filters = searches(face.rig, OPTIONS)
    filter = at(filters.rigid, face.model, 2 * face.model.templates, face.model.deviation)
    np.testing.assert_array_equal(filter.params.log_likelihood.templates, 2 * face.model.templates)
    np.testing.assert_array_equal(filter.params.log_likelihood.model.mean, face.model.mean)
    np.testing.assert_allclose(filter.params.mode_scale[POSE:], [6, 4, 2.5, 1.6, LEAST_DEVIATION], rtol=1e-6)
    np.testing.assert_array_equal(filter.params.mode_scale[:POSE], filters.rigid.params.mode_scale[:POSE])
    assert filters.rigid.params.partitions is None
    assert filters.layered.params.partitions is not None


@pytest.mark.system
def test_one_frame_finds_a_head_that_has_moved_a_little(face):
    start = start_search(face.x.at[:POSE].add(jnp.asarray(UNITS * [0.8, -0.5, 1, 0.5, 0.7, -0.5], float)), OPTIONS)
    filter = at(searches(face.rig, OPTIONS).rigid, face.rigid, face.rigid.templates, jnp.zeros(NUM_MODES))
    state, info = weigh(filter, jax.random.key(1), step(filter, jax.random.key(0), start, 1.0), face.images)
    before, after = (np.abs((x - face.x)[:2]) for x in (start.estimate, state.estimate))
    assert np.all(after < 0.5 * before)
    assert 1 <= float(info.effective_sample_size) <= N
    together = gathered(state, face.x)
    np.testing.assert_array_equal(together.particles, np.tile(np.asarray(face.x)[:, None], (1, N)))
    np.testing.assert_allclose(together.log_weights, -np.log(N), rtol=1e-6)
    np.testing.assert_array_equal(together.estimate, state.estimate)


def test_a_search_starts_as_a_known_place(face):
    state = start_search(face.x, OPTIONS)
    np.testing.assert_array_equal(state.estimate, face.x)
    assert state.particles.shape == (POSE + NUM_MODES, N)
    assert int(state.num_estimates) == 1
    assert not np.any(state.velocity)
    traced = jax.jit(lambda x: start_search(x, OPTIONS))(face.x)
    jax.tree.map(np.testing.assert_array_equal, traced, state)
    np.testing.assert_array_equal(rigid(face.model.mean, face.model.templates, num_modes=2).deviation, 0)
