"""Recalculated landmarks against the energy and its equations written out (oracle 8), and on images that move."""

from functools import cache

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.face import pose as head
from jaxfilters.models.face import recalculation
from jaxfilters.models.face.correlation import inside
from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.rig import jacobian, nominal, project_shape, triangulate

POSE = np.array([60.0, 0.0, 650.0, 0.05, -0.1, 0.08])
RHO, EPSILON = 4.0, 2000.0
normal_equations, recalculate = jax.jit(recalculation.normal_equations), jax.jit(recalculation.recalculate)
patches = jax.jit(recalculation.patches, static_argnames="size")


def textures(seed, scale=3.0):
    """Two smooth images of grey levels about 120 with a deviation of 40."""
    noise = np.random.default_rng(seed).normal(0, 1, (2, 480, 640))
    smooth = np.stack([cv2.GaussianBlur(plane, (0, 0), scale) for plane in noise])
    return 120 + 40 * smooth / smooth.std()


class Scene:
    """Windows that were cut about one shape, in images with noise, and another shape to start from."""

    def __init__(self):
        rng = np.random.default_rng(0)
        self.rig, self.pose = nominal(), jnp.asarray(POSE)
        self.true = jnp.asarray(MEAN_SHAPE)
        self.start = jnp.asarray(MEAN_SHAPE + rng.normal(0, 0.8, (10, 3)))
        self.estimated = jnp.asarray(MEAN_SHAPE + rng.normal(0, 0.8, (10, 3)))
        clean = textures(1)
        self.images = jnp.asarray(clean + rng.normal(0, 2, clean.shape))
        self.first = patches(jnp.asarray(clean), self.true, self.pose, self.rig)
        self.previous = self.first + jnp.asarray(rng.normal(0, 2, self.first.shape))
        self.linearised = self._linearised()

    @property
    def arguments(self):
        return self.images, self.previous, self.first, self.pose, self.rig

    def _linearised(self):
        """K-hat of each camera, landmark and pixel, and the two differences, by definition."""
        wide = np.asarray(patches(self.images, self.start, self.pose, self.rig, size=18))
        along_u = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) / 2
        along_v = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) / 2
        by_shape = np.asarray(jacobian(self.rig, self.start, self.pose)[0])
        K = along_u[..., None] * by_shape[:, :, None, None, 0] + along_v[..., None] * by_shape[:, :, None, None, 1]
        here = wide[..., 1:-1, 1:-1]
        return K, here - np.asarray(self.previous), here - np.asarray(self.first)

    def energy(self, step, epsilon=EPSILON):
        """[S3.10] and [S3.13]: the quadratic form in the step."""
        K, since_previous, since_first = self.linearised
        change = np.einsum("ckyxa,ka->ckyx", K, step)
        image = RHO * np.sum((change + since_previous) ** 2) + np.sum((change + since_first) ** 2)
        return image + epsilon * np.sum((step + self.start - self.estimated) ** 2)


@pytest.fixture
def scene(x64):
    return the_scene()


@cache
def the_scene():
    return Scene()


@pytest.mark.system
def test_the_vector_is_the_gradient_of_the_quadratic_energy(scene):
    """Oracle 8: central differences of a quadratic form are exact but for rounding."""
    found = np.asarray(normal_equations(scene.start, scene.estimated, *scene.arguments).vector)
    for k, axis in [(0, 0), (3, 1), (7, 2), (9, 0)]:
        step = np.zeros((10, 3))
        step[k, axis] = 0.5
        difference = scene.energy(step) - scene.energy(-step)
        assert difference == pytest.approx(found[k, axis], abs=1e-8 * np.abs(found).max())


def test_the_matrix_is_the_second_derivative_and_has_no_blocks_across_landmarks(scene):
    """Oracle 8: second differences of the whole energy in all 30 coordinates, against the blocks alone."""
    found = normal_equations(scene.start, scene.estimated, *scene.arguments).matrix
    whole = np.zeros((30, 30))
    for k in range(10):
        whole[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = found[k]
    rng, rest = np.random.default_rng(3), scene.energy(np.zeros((10, 3)))
    for step in rng.normal(0, 1, (12, 10, 3)):
        second = scene.energy(step) + scene.energy(-step) - 2 * rest
        assert second == pytest.approx(step.ravel() @ whole @ step.ravel(), rel=1e-10)


def test_the_printed_equations_are_the_exact_ones_with_half_of_epsilon(scene):
    """Oracle 8; the printed ones [S3.18], [S3.19] written out."""
    K, since_previous, since_first = scene.linearised
    D = 2 * (RHO + 1) * np.einsum("ckyxa,ckyxb->kab", K, K) + EPSILON * np.eye(3)
    d = 2 * np.einsum("ckyxa,ckyx->ka", K, RHO * since_previous + since_first)
    d = d + EPSILON * np.asarray(scene.start - scene.estimated)
    exact = normal_equations(scene.start, scene.estimated, *scene.arguments, epsilon=EPSILON / 2)
    np.testing.assert_allclose(exact.matrix, D, rtol=1e-10)
    np.testing.assert_allclose(exact.vector, d, rtol=1e-10, atol=1e-10 * np.abs(d).max())


def test_one_step_minimises_the_quadratic_energy(scene):
    shape, info = recalculate(scene.start, scene.estimated, *scene.arguments, max_iterations=1, step_mm=jnp.inf)
    step = np.asarray(shape - scene.start)
    least = scene.energy(step)
    for other in step + np.random.default_rng(4).normal(0, 1e-2, (10, 10, 3)):
        assert scene.energy(other) > least
    assert info.iterations == 1
    np.testing.assert_allclose(info.step_mm, np.abs(step).max(axis=1), rtol=1e-12)


def test_landmarks_return_to_where_the_windows_were_cut(scene):
    """With little weight on the estimate, to what grey noise of 2 allows: 1e-2 px, that is 0.05 mm of depth."""
    shape, info = recalculate(scene.start, scene.estimated, *scene.arguments, epsilon=1.0)
    error = np.abs(np.asarray(shape - scene.true)).max(axis=0)
    assert np.abs(np.asarray(scene.start - scene.true)).max() > 1.5
    assert np.all(error < [0.1, 0.1, 0.6])
    assert info.iterations <= 6
    assert np.all(np.asarray(info.step_mm) < 0.02)
    assert np.all(np.asarray(info.residual) < 5)


def test_the_result_is_a_stationary_point_of_the_energy(scene):
    shape, _ = recalculate(scene.start, scene.estimated, *scene.arguments, tolerance_mm=1e-9, max_iterations=100)
    there = normal_equations(shape, scene.estimated, *scene.arguments)
    left = np.linalg.solve(np.asarray(there.matrix), np.asarray(there.vector)[..., None])
    assert np.abs(left).max() < 1e-8


def test_a_heavy_estimate_holds_the_landmarks(scene):
    shape, _ = recalculate(scene.start, scene.estimated, *scene.arguments, epsilon=1e12)
    np.testing.assert_allclose(shape, scene.estimated, atol=1e-4)


def test_steps_are_no_longer_than_allowed(scene):
    away = scene.start + jnp.array([30.0, 0.0, 0.0])
    shape, _ = recalculate(away, scene.start, *scene.arguments, epsilon=1e12, max_iterations=1)
    np.testing.assert_allclose(jnp.linalg.norm(shape - away, axis=-1), 6, rtol=1e-12)
    np.testing.assert_allclose(shape - away, jnp.broadcast_to(jnp.array([-6.0, 0, 0]), (10, 3)), atol=1e-6)


def test_a_landmark_that_no_camera_sees_moves_to_its_estimate(scene):
    beyond = jnp.asarray(MEAN_SHAPE).at[0].set(jnp.array([900.0, 0, 0])).at[1].set(jnp.array([0.0, 0, -900]))
    start = beyond + 0.5
    shape, info = recalculate(start, beyond, *scene.arguments)
    np.testing.assert_allclose(shape[:2], beyond[:2], atol=1e-9)
    np.testing.assert_array_equal(np.isnan(info.residual), [True] * 2 + [False] * 8)
    assert np.all(np.isfinite(shape))


@pytest.mark.system
def test_a_landmark_in_one_image_alone_is_judged_by_that_one(scene):
    """Half of the first image is away: the equations of its landmarks are those of the second camera."""
    aside = scene.pose.at[0].set(-230.0)
    uv, _ = project_shape(scene.rig, scene.start, aside)
    observed = np.asarray(inside(scene.rig.shape, uv, 18))
    assert observed[0].any()
    assert not observed[1].all()
    images, previous, first, _, rig = scene.arguments
    both = normal_equations(scene.start, scene.estimated, images, previous, first, aside, rig)
    halves = [
        normal_equations(
            scene.start, scene.estimated, images[c : c + 1], previous[c : c + 1], first[c : c + 1], aside, part
        )
        for c, part in enumerate(one_camera_each(rig))
    ]
    prior = 2 * EPSILON * np.eye(3)
    np.testing.assert_allclose(both.matrix, halves[0].matrix + halves[1].matrix - prior, rtol=1e-10)
    only_left = ~observed[1] & observed[0]
    assert only_left.any()
    np.testing.assert_allclose(both.residual[only_left], halves[0].residual[only_left], rtol=1e-12)


def one_camera_each(rig):
    arrays = ("focal", "center", "rotation", "translation")
    return [type(rig)(*(getattr(rig, a)[c : c + 1] for a in arrays), shape=rig.shape) for c in range(2)]


@pytest.mark.system
def test_a_moved_image_is_followed(scene):
    """Both images moved by a known vector: landmarks move to where the moved pixels triangulate."""
    shift = np.array([3.0, -2.0])
    M = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    moved = np.stack([cv2.warpAffine(image, M, (640, 480)) for image in textures(1)])
    arguments = jnp.asarray(moved), scene.first, scene.first, scene.pose, scene.rig
    shape, info = recalculate(scene.true, scene.true, *arguments, epsilon=1e-3)
    uv, _ = project_shape(scene.rig, scene.true, scene.pose)
    expected = triangulate(scene.rig, uv + jnp.asarray(shift))
    assert info.iterations < 10
    np.testing.assert_allclose(head.place(shape, scene.pose), expected, atol=0.05)


@pytest.mark.system
def test_single_precision_and_8_bit_images_give_the_same(scene):
    exact, _ = recalculate(scene.start, scene.estimated, *scene.arguments)
    images = jnp.asarray(np.clip(np.round(np.asarray(scene.images)), 0, 255).astype(np.uint8))
    narrow = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (scene.previous, scene.first, scene.pose, scene.rig))
    start, estimated = (jnp.asarray(a, jnp.float32) for a in (scene.start, scene.estimated))
    shape, _ = recalculate(start, estimated, images, *narrow)
    assert shape.dtype == jnp.float32
    np.testing.assert_allclose(shape, exact, atol=0.05)


@pytest.mark.system
def test_results_follow_the_estimate_smoothly(scene):
    """Forward derivatives through the iterations, against central differences."""
    solve = lambda estimated: recalculate(scene.start, estimated, *scene.arguments, tolerance_mm=1e-10)[0]
    direction = jnp.asarray(np.random.default_rng(5).normal(size=(10, 3)))
    _, slope = jax.jvp(solve, (scene.estimated,), (direction,))
    difference = (solve(scene.estimated + 1e-4 * direction) - solve(scene.estimated - 1e-4 * direction)) / 2e-4
    np.testing.assert_allclose(slope, difference, atol=1e-4)
