"""The two projections: against OpenCV's arithmetic, each other in the limit, and the gauges of weak perspective."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.articulated.features import KEYPOINTS
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.layout import Layout, five_fingers
from jaxfilters.models.articulated.projection import Perspective, WeakPerspective
from jaxfilters.models.camera import Pinhole

pytestmark = pytest.mark.usefixtures("x64")


def pinhole(focal=500.0):
    return Pinhole.from_intrinsics((focal, focal), (320.0, 240.0), (480, 640))


def perspective_hand(layout, camera, **options):
    return articulated_hand(layout, projection=Perspective(camera), **options)


def in_space(x, weak, space, distance):
    """The state in front of a far camera whose hand, one metre a pixel, has the same image as that of `x`."""
    q = x[weak.quaternion]
    scale = np.sum(q**2)
    y = np.zeros(space.size)
    y[space.position] = [*(x[weak.position] / scale), distance]
    y[space.quaternion] = q
    y[space.angles] = x[weak.angles]
    y[space.static] = x[weak.static]
    return y, distance * scale


@pytest.mark.system
@pytest.mark.parametrize("layouts", [(Layout(2), Layout(2, 3)), (five_fingers(), five_fingers(3))])
def test_perspective_is_weak_perspective_for_a_far_camera(layouts, random_state):
    weak, space = layouts
    for seed in range(3):
        x = random_state(np.random.default_rng(seed), weak)
        expected = np.asarray(articulated_hand(weak).observe(jnp.asarray(x)))
        errors = []
        for distance in (1e5, 1e7):
            y, focal = in_space(x, weak, space, distance)
            camera = pinhole(focal)
            hand = perspective_hand(space, camera)
            shifted = [i for i, name in enumerate(hand.feature_names) if name.startswith(("wrist", "p_"))]
            observed = np.array(hand.observe(jnp.asarray(y)))
            observed[shifted] -= np.tile(camera.center, len(shifted) // 2)
            errors.append(np.max(np.abs(hand.residual(jnp.asarray(observed), jnp.asarray(expected)))))
        # A point 300 pixels off the axis and 300 deep moves by 300^2 / distance; the rest is its effect on short lines.
        assert errors[1] < 0.1
        assert errors[1] < errors[0] / 50


def test_perspective_points_are_projected_by_the_camera(random_state):
    layout = Layout(2, 3)
    x = random_state(np.random.default_rng(0), layout)
    hand = perspective_hand(layout, pinhole(), features=KEYPOINTS)
    R = Rotation.from_quat(x[layout.quaternion], scalar_first=True).as_matrix()
    # The first finger begins at the palm's end, a quarter of its width from the middle.
    width, height, _ = x[layout.palm]
    base = R @ (height, 0, width / 4) + x[layout.position]
    observed = dict(zip(hand.feature_names, np.asarray(hand.observe(jnp.asarray(x))), strict=True))
    expected = 500 * base[:2] / base[2] + (320, 240)
    np.testing.assert_allclose([observed["p_10_x"], observed["p_10_y"]], expected, rtol=1e-12)
    wrist = 500 * x[:2] / x[2] + (320, 240)
    np.testing.assert_allclose([observed["wrist_x"], observed["wrist_y"]], wrist, rtol=1e-12)


def test_perspective_ignores_the_length_of_the_quaternion(random_state):
    layout = Layout(2, 3)
    x = random_state(np.random.default_rng(1), layout)
    longer = x.copy()
    longer[layout.quaternion] *= 1.7
    hand = perspective_hand(layout, pinhole())
    np.testing.assert_allclose(hand.observe(jnp.asarray(longer)), hand.observe(jnp.asarray(x)), atol=1e-10)


def test_prediction_in_perspective_keeps_the_quaternion_on_the_sphere(random_state):
    layout = Layout(2, 3)
    x = random_state(np.random.default_rng(2), layout)
    hand = perspective_hand(layout, pinhole())
    moved = np.asarray(hand.transition(jnp.asarray(x), 0.5))
    q, rate = moved[layout.quaternion], moved[layout.quaternion_rate]
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-14)
    assert q @ rate == pytest.approx(0, abs=1e-14)
    expected = x[layout.quaternion] + 0.5 * x[layout.quaternion_rate]
    np.testing.assert_allclose(q, expected / np.linalg.norm(expected), atol=1e-14)
    rest = np.r_[layout.position, layout.angles]
    np.testing.assert_allclose(moved[rest], x[rest] + 0.5 * x[rest + layout.num_moving], atol=1e-14)
    np.testing.assert_array_equal(moved[layout.static], x[layout.static])


def test_image_directions_are_derivatives_of_the_image():
    rng = np.random.default_rng(0)
    point, vector = jnp.asarray(rng.normal(size=3) * 0.1 + (0, 0, 0.8)), jnp.asarray(rng.normal(size=3))
    for projection in (WeakPerspective(), Perspective(replace(pinhole(), focal=jnp.array([500.0, 600.0])))):
        _, expected = jax.jvp(projection.image_points, (point,), (vector,))
        np.testing.assert_allclose(projection.image_direction(point, vector), expected, rtol=1e-12)


def test_lines_of_sight_lead_from_the_camera_through_the_point():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)) * 0.1 + (0, 0, 0.8))
    projection = Perspective(pinhole())
    sight = projection.line_of_sight(points)
    np.testing.assert_allclose(np.linalg.norm(sight, axis=1), 1, rtol=1e-14)
    farther = projection.image_points(points + 0.3 * sight)
    np.testing.assert_allclose(farther, projection.image_points(points), rtol=1e-12)
    np.testing.assert_array_equal(WeakPerspective().line_of_sight(points), np.broadcast_to((0, 0, 1), (5, 3)))


@pytest.mark.parametrize("seed", range(3))
def test_size_and_scale_cannot_be_told_apart(seed, random_state):
    """Lengths times g, quaternion over the root of g: the first gauge of the specification."""
    layout = Layout(2)
    x = random_state(np.random.default_rng(seed), layout)
    g, other = 1.37, x.copy()
    other[layout.static] *= g
    other[layout.quaternion] /= np.sqrt(g)
    hand = articulated_hand(layout)
    np.testing.assert_allclose(hand.observe(jnp.asarray(other)), hand.observe(jnp.asarray(x)), atol=1e-10)


@pytest.mark.parametrize("seed", range(3))
def test_without_the_wrist_the_palm_height_cannot_be_seen(seed, random_state):
    """Height less delta, wrist moved on by delta along the palm: the second gauge; only the wrist's rows notice."""
    layout = Layout(2)
    x = random_state(np.random.default_rng(seed), layout)
    q, delta, other = x[layout.quaternion], 7.0, x.copy()
    along = np.sum(q**2) * Rotation.from_quat(q, scalar_first=True).as_matrix()[:2, 0]
    other[layout.position] += delta * along
    other[layout.size - 2] -= delta
    hand = articulated_hand(layout)
    difference = np.asarray(hand.observe(jnp.asarray(other)) - hand.observe(jnp.asarray(x)))
    np.testing.assert_allclose(difference[2:], 0, atol=1e-10)
    np.testing.assert_allclose(difference[:2], delta * along, atol=1e-10)
