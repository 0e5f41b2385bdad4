"""Recalculated pixels against the energy and its equations written out, and on rendered faces (oracle 14)."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face import point_recalculation
from jaxfilters.models.face.point_recalculation import point_windows
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_motion import motion
from jaxfilters.models.synthetic.face_sequence import face_sequence

RHO, EPSILON = 4.0, 4000.0
point_equations = jax.jit(point_recalculation.point_equations)
recalculate_points = jax.jit(point_recalculation.recalculate_points)
POINTS = np.random.default_rng(2).uniform(40, 160, (10, 2))


class Scene:
    """Windows that were cut about ten points, in an image with noise, and other points to start from."""

    def __init__(self):
        rng = np.random.default_rng(0)
        smooth = cv2.GaussianBlur(rng.normal(0, 1, (200, 200)), (0, 0), 3.0)
        clean = 120 + 40 * smooth / smooth.std()
        self.image = jnp.asarray(clean + rng.normal(0, 2, clean.shape))
        self.first = point_windows(jnp.asarray(clean), jnp.asarray(POINTS))
        self.previous = self.first + jnp.asarray(rng.normal(0, 2, self.first.shape))
        self.start, self.estimated = (jnp.asarray(POINTS + rng.normal(0, 0.8, (10, 2))) for _ in range(2))
        wide = np.asarray(point_windows(self.image, self.start, size=18))
        across, down = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2, (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
        self.K, here = np.stack([across, down], axis=-1), wide[:, 1:-1, 1:-1]
        self.since_previous, self.since_first = here - np.asarray(self.previous), here - np.asarray(self.first)

    @property
    def arguments(self):
        return self.start, self.estimated, self.image, self.previous, self.first

    def energy(self, step):
        """[4.45] and [4.49]."""
        change = np.einsum("kyxi,ki->kyx", self.K, step)
        image = RHO * np.sum((change + self.since_previous) ** 2) + np.sum((change + self.since_first) ** 2)
        return image + EPSILON * np.sum((step + self.start - self.estimated) ** 2)


@pytest.fixture
def scene(x64):
    return Scene()


@pytest.mark.system
def test_the_equations_are_the_derivatives_of_the_energy(scene):
    """A quadratic form: central differences are exact but for rounding."""
    found = point_equations(*scene.arguments)
    rest = scene.energy(np.zeros((10, 2)))
    for k, axis in [(0, 0), (4, 1), (9, 0)]:
        step = np.zeros((10, 2))
        step[k, axis] = 0.5
        ahead, back = scene.energy(step), scene.energy(-step)
        assert ahead - back == pytest.approx(float(found.vector[k, axis]), abs=1e-7 * float(np.abs(found.vector).max()))
        assert ahead + back - 2 * rest == pytest.approx(0.25 * float(found.matrix[k, axis, axis]), rel=1e-8)


def test_the_printed_equations_are_the_exact_ones_with_half_of_epsilon(scene):
    """[4.51] and [4.52] written out."""
    D = 2 * (RHO + 1) * np.einsum("kyxa,kyxb->kab", scene.K, scene.K) + EPSILON * np.eye(2)
    d = 2 * np.einsum("kyxa,kyx->ka", scene.K, RHO * scene.since_previous + scene.since_first)
    d = d + EPSILON * np.asarray(scene.start - scene.estimated)
    exact = point_equations(*scene.arguments, epsilon=EPSILON / 2)
    np.testing.assert_allclose(exact.matrix, D, rtol=1e-10)
    np.testing.assert_allclose(exact.vector, d, rtol=1e-10, atol=1e-10 * np.abs(d).max())


def test_one_step_minimises_the_quadratic_energy(scene):
    points, info = recalculate_points(*scene.arguments, max_iterations=1, step_px=jnp.inf)
    step = np.asarray(points - scene.start)
    least = scene.energy(step)
    for other in step + np.random.default_rng(4).normal(0, 1e-2, (10, 10, 2)):
        assert scene.energy(other) > least
    assert info.iterations == 1


def test_an_infinite_weight_of_the_estimate_returns_it(scene):
    points, _ = recalculate_points(*scene.arguments, epsilon=1e15)
    np.testing.assert_allclose(points, scene.estimated, atol=1e-6)


def test_a_window_beyond_the_border_stays_at_the_estimate(scene):
    start, estimated, image, previous, first = scene.arguments
    outside = jnp.array([2.0, 3.0])
    points, info = recalculate_points(
        start.at[0].set(outside), estimated.at[0].set(outside), image, previous, first, tolerance_px=1e-9
    )
    np.testing.assert_allclose(points[0], outside, atol=1e-9)
    assert np.isnan(info.residual[0])
    assert np.isfinite(info.residual[1:]).all()


@pytest.mark.system
def test_rendered_landmarks_are_found_from_four_pixels_away():
    """Oracle 14: one face, and another frame of it a moment later; 0.27 px were reached by the specification's."""
    rig = monocular(Pinhole.from_intrinsics(800.0, (319.5, 239.5), (480, 640)))
    sequence = face_sequence(jax.random.key(5), motion("slow", 8, 3, place_mm=(0.0, 0.0, 650.0)), rig=rig)
    images = sequence.frames(0, 8)
    first, now = (jnp.asarray(images[i, 0], float) for i in (0, 7))
    there, here = (jnp.asarray(sequence.uv[i, 0], float) for i in (0, 7))
    windows = point_windows(first, there)
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(20):
        angle = rng.uniform(0, 2 * np.pi, 10)
        start = here + 4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        # The estimate's pull is set aside: its weight is for estimates that are better than this.
        points, _ = recalculate_points(start, start, now, windows, windows, epsilon=10.0)
        errors.append(np.linalg.norm(points - here, axis=-1))
    assert np.mean(errors) <= 0.5
