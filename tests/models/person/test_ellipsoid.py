"""Outlines and depths of ellipsoids: the oracles 1 to 8 of the specification, section 7."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.floor_camera import FloorCamera, canonical
from jaxfilters.models.person import ellipsoid
from jaxfilters.models.person.ellipsoid import (
    BEHIND,
    CROSSING,
    INSIDE,
    VISIBLE,
    Ellipsoid,
    Outline,
    near_depth,
    pixel_grid,
    soft_ellipse_mask,
    standing,
)

outline = jax.jit(ellipsoid.outline)
outline_radius = jax.jit(ellipsoid.outline_radius)
ellipse_of = jax.jit(ellipsoid.ellipse_of)
ellipse_mask = jax.jit(ellipsoid.ellipse_mask, static_argnums=1)
ellipsoid_depth = jax.jit(ellipsoid.ellipsoid_depth, static_argnums=2)
GOLDEN = np.array(
    [
        [46.66907927, 21.31720088, -16.06366306, 126.16907927],
        [0, -12.13176997, -49.29407389, 109.02707531],
        [0, 0.26814089, -0.20205865, 1],
    ]
)
SHAPE = (120, 160)


@pytest.fixture
def camera(x64):
    return FloorCamera.from_matrix(GOLDEN, SHAPE)


@pytest.fixture
def person(x64):
    return standing(jnp.array([-0.6, 1.2]), jnp.array(1.65), jnp.array(0.40))


def conic_to_ellipse(dual_conic):
    """Parameters of the ellipse of a dual conic of any scale; NaN where it is no ellipse."""
    C = dual_conic / dual_conic[2, 2]
    center = C[:2, 2]
    shape = jnp.outer(center, center) - C[:2, :2]
    return ellipse_of(Outline(center, shape, jnp.zeros(()), jnp.asarray(VISIBLE)))


def dual_quadric(body):
    """`Q*` (4, 4), all planes tangent to the ellipsoid: `T diag(r^2, -1) T^T`."""
    T = jnp.eye(4).at[:3, 3].set(body.center)
    return T @ jnp.diag(jnp.append(body.semi_axes**2, -1.0)) @ T.T


def outline_coefficients(P, body):
    """(K1 .. K6) of `K1 u^2 + K2 v^2 + K3 u v + K4 u + K5 v + K6`, not negative inside the outline ([4] and appendix).

    The paper's body has equal horizontal semi-axes; the scale is its own, `Ra^2 Rb^2` times the discriminant.
    """
    Ra2, Rb2 = body.semi_axes[0] ** 2, body.semi_axes[2] ** 2
    D = jnp.linalg.inv(jnp.concatenate([P, jnp.array([[0.0, 0.0, 0.0, 1.0]], P.dtype)]))
    weights = jnp.stack([Rb2, Rb2, Ra2])
    directions, away = D[:3, :3], D[:3, 3] - body.center
    a = directions.T @ (weights[:, None] * directions)
    b = directions.T @ (weights * away)
    c = away @ (weights * away) - Ra2 * Rb2
    K = jnp.outer(b, b) - a * c
    return jnp.stack([K[0, 0], K[1, 1], 2 * K[0, 1], 2 * K[0, 2], 2 * K[1, 2], K[2, 2]])


def sphere(center, radius):
    return Ellipsoid(jnp.asarray(center, float), jnp.full(3, radius))


def surface(body, n=1000):
    """(n * n, 3) points."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, n, endpoint=False))
    unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    return (np.asarray(body.center) + unit * np.asarray(body.semi_axes)).reshape(-1, 3)


def random_camera(rng):
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    R *= np.linalg.det(R)
    K = np.array([[rng.uniform(50, 900), rng.normal(), 80], [0, rng.uniform(50, 900), 60], [0, 0, 1]])
    return K @ np.column_stack([R, -R @ rng.uniform([-3, -3, 0.5], [3, 3, 4])]) * rng.uniform(-2, 2)


@pytest.mark.system
def test_the_outline_holds_a_million_projected_points_tightly(camera, person):
    uv, _ = camera.project(jnp.asarray(surface(person)))
    contour = outline(camera.P, person)
    assert float(jnp.max(outline_radius(contour, uv))) <= 1 + 1e-9
    angles = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    normals = np.stack([np.cos(angles), np.sin(angles)])
    support = np.asarray(contour.center) @ normals + np.sqrt(
        np.sum(normals * (np.asarray(contour.shape) @ normals), axis=0)
    )
    # A million points are 0.003 rad apart: they miss the outline by up to 30 px * 0.003^2 / 8.
    np.testing.assert_allclose((np.asarray(uv) @ normals).max(axis=0), support, atol=1e-3)


@pytest.mark.system
def test_ray_form_and_dual_form_agree_for_500_cameras(x64):
    """K = -Ra^2 Rb^2 c1 (C*)^-1, section 2.4."""
    rng = np.random.default_rng(0)
    coefficients, conic = jax.jit(outline_coefficients), jax.jit(lambda P, b: P @ dual_quadric(b) @ P.T)
    for _ in range(500):
        P, (Ra, Rb) = random_camera(rng), rng.uniform(0.1, 1.2, 2)
        body = Ellipsoid(jnp.asarray(np.append(rng.uniform(-3, 3, 2), Rb)), jnp.array([Ra, Ra, Rb]))
        K1, K2, K3, K4, K5, K6 = np.asarray(coefficients(jnp.asarray(P), body))
        found = np.array([[K1, K3 / 2, K4 / 2], [K3 / 2, K2, K5 / 2], [K4 / 2, K5 / 2, K6]])
        away = (-np.linalg.solve(P[:, :3], P[:, 3]) - np.asarray(body.center)) / np.asarray(body.semi_axes)
        c1 = Ra**2 * Rb**2 * (away @ away - 1)
        expected = -(Ra**2) * Rb**2 * c1 * np.linalg.inv(np.asarray(conic(jnp.asarray(P), body)))
        scale = np.abs(expected).max()
        # Rounding grows with the condition of the conic, of which pixels of some hundreds are a part.
        np.testing.assert_allclose(found / scale, expected / scale, atol=1e-10)


@pytest.mark.system
def test_golden_case(camera, person):
    K = np.asarray(outline_coefficients(camera.P, person))
    expected = [1.00650704e-4, 8.50688007e-6, 1.54149702e-5, -1.99895842e-2, -2.20481015e-3, 1]
    np.testing.assert_allclose(K / K[5], expected, rtol=1e-6)
    ellipse = ellipse_of(outline(camera.P, person))
    np.testing.assert_allclose(ellipse.center, [96.0416479, 42.57324684], rtol=1e-6)
    np.testing.assert_allclose(ellipse.semi_axes, [29.50718399, 8.22312128], rtol=1e-6)
    np.testing.assert_allclose(ellipse.box, [87.4904, 13.1595, 104.5929, 71.9870], atol=6e-5)
    away = (camera.position() - person.center) / person.semi_axes
    np.testing.assert_allclose(away @ away, 224.93, atol=5e-3)


def test_single_precision_keeps_the_outline():
    camera = FloorCamera.from_matrix(GOLDEN, SHAPE)
    ellipse = ellipse_of(outline(camera.P, standing(jnp.array([-0.6, 1.2]), jnp.array(1.65), jnp.array(0.40))))
    np.testing.assert_allclose(ellipse.center, [96.0416479, 42.57324684], atol=2e-4)
    np.testing.assert_allclose(ellipse.semi_axes, [29.50718399, 8.22312128], atol=2e-4)


def ellipse_points(ellipse, n=400):
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    a, b = ellipse.semi_axes
    c, s = np.cos(ellipse.angle), np.sin(ellipse.angle)
    return np.asarray(ellipse.center) + np.stack([a * np.cos(t), b * np.sin(t)], axis=-1) @ np.array([[c, s], [-s, c]])


def test_points_of_the_ellipse_satisfy_the_papers_equation(camera, person):
    u, v = ellipse_points(ellipse_of(outline(camera.P, person))).T
    K1, K2, K3, K4, K5, K6 = np.asarray(outline_coefficients(camera.P, person))
    residual = K1 * u**2 + K2 * v**2 + K3 * u * v + K4 * u + K5 * v + K6
    assert np.abs(residual).max() <= 1e-10 * abs(K6)
    assert K1 * 96 * 96 + K2 * 42.5**2 + K3 * 96 * 42.5 + K4 * 96 + K5 * 42.5 + K6 > 0


@pytest.mark.system
def test_ellipse_parameters_agree_with_opencv(camera, person):
    ellipse = conic_to_ellipse(camera.P @ dual_quadric(person) @ camera.P.T)
    (x, y), sizes, degrees = cv2.fitEllipse(ellipse_points(ellipse).astype(np.float32))
    np.testing.assert_allclose(ellipse.center, [x, y], atol=0.05)
    np.testing.assert_allclose(np.asarray(ellipse.semi_axes)[::-1], np.asarray(sizes) / 2, atol=0.05)
    # OpenCV's angle is that of its first, here the shorter, side; both are known up to half a turn.
    assert abs((np.rad2deg(float(ellipse.angle)) - degrees - 90 + 90) % 180 - 90) < 0.1


def test_dual_conic_and_outline_are_the_same_ellipse(camera, person):
    for one, other in zip(
        conic_to_ellipse(camera.P @ dual_quadric(person) @ camera.P.T * -3.0),
        ellipse_of(outline(camera.P, person)),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9)


def test_the_mask_agrees_with_opencv_and_with_its_area(camera, person):
    contour = outline(camera.P, person)
    mask, ellipse = np.asarray(ellipse_mask(contour, SHAPE)), ellipse_of(contour)
    drawn = np.zeros(SHAPE, np.uint8)
    center, axes = (tuple(round(256 * float(x)) for x in pair) for pair in (ellipse.center, ellipse.semi_axes))
    cv2.ellipse(drawn, center, axes, np.rad2deg(float(ellipse.angle)), 0, 360, 1, -1, shift=8)
    assert (mask & (drawn > 0)).sum() / (mask | (drawn > 0)).sum() >= 0.90
    assert mask.sum() == 766
    np.testing.assert_allclose(mask.sum(), np.pi * np.prod(ellipse.semi_axes), rtol=0.02)


def test_a_sphere_on_the_optical_axis_is_a_circle(x64):
    focal, distance, radius = 200.0, 4.0, 0.7
    P = np.array([[focal, 0, 80, 0], [0, focal, 60, 0], [0, 0, 1, 0]])
    ellipse = ellipse_of(outline(jnp.asarray(P), sphere([0, 0, distance], radius)))
    expected = focal * radius / np.sqrt(distance**2 - radius**2)
    np.testing.assert_allclose(ellipse.semi_axes, [expected, expected], atol=1e-9)
    np.testing.assert_allclose(ellipse.center, [80, 60], atol=1e-9)


@pytest.mark.parametrize("scale", [-1.0, 1e-3, 55.0])
def test_the_scale_of_the_camera_changes_neither_mask_nor_depth(camera, person, scale):
    other = FloorCamera.from_matrix(scale * GOLDEN, SHAPE)
    np.testing.assert_array_equal(
        ellipse_mask(outline(other.P, person), SHAPE), ellipse_mask(outline(camera.P, person), SHAPE)
    )
    np.testing.assert_allclose(
        ellipsoid_depth(other.P, person, SHAPE), ellipsoid_depth(camera.P, person, SHAPE), rtol=1e-10
    )


def test_a_camera_in_front_of_the_origin_sees_the_same(camera, person):
    """The world moved by 5 m along Y, so that its origin is behind the camera and C34 = 1 turns the sign of depths."""
    shift = np.eye(4)
    shift[1, 3] = -5.0
    P = GOLDEN @ np.linalg.inv(shift)
    assert canonical(P)[2, 3] * canonical(GOLDEN)[2, 3] > 0
    shift[1, 3] = 5.0
    P = GOLDEN @ np.linalg.inv(shift)
    assert canonical(P)[2, 3] < 0
    moved = Ellipsoid(person.center + jnp.array([0.0, 5.0, 0.0]), person.semi_axes)
    other = FloorCamera.from_matrix(P / P[2, 3], SHAPE)
    np.testing.assert_array_equal(
        ellipse_mask(outline(other.P, moved), SHAPE), ellipse_mask(outline(camera.P, person), SHAPE)
    )


@pytest.mark.system
def test_depth_is_that_of_the_nearer_intersection(camera, person):
    depth = np.asarray(ellipsoid_depth(camera.P, person, SHAPE))
    mask = np.asarray(ellipse_mask(outline(camera.P, person), SHAPE))
    np.testing.assert_array_equal(np.isfinite(depth), mask)
    rays, origin = np.asarray(camera.rays(pixel_grid(SHAPE)))[mask], np.asarray(camera.position())

    def level(h):
        points = origin + h[..., None] * rays
        return np.sum(((points - np.asarray(person.center)) / np.asarray(person.semi_axes)) ** 2, axis=-1) - 1

    # Rays that graze have a double root, where rounding is amplified: the residual is that of the quadratic form.
    np.testing.assert_allclose(level(depth[mask]), 0, atol=1e-10)
    marched = np.stack([level(np.full(mask.sum(), h)) for h in np.linspace(0, 10, 4001)])
    first = np.argmax(marched <= 0, axis=0)
    hit = marched.min(axis=0) <= 0
    assert hit.mean() > 0.95
    np.testing.assert_allclose(depth[mask][hit], np.linspace(0, 10, 4001)[first][hit], atol=10 / 4000)


def test_depth_outside_is_where_rays_pass_nearest(camera, person):
    uv = jnp.array([[120.0, 40.0], [20.0, 100.0]])
    rays, origin = np.asarray(camera.rays(uv)), np.asarray(camera.position())
    h = np.linspace(0, 10, 100001)
    points = (origin + h[:, None, None] * rays - np.asarray(person.center)) / np.asarray(person.semi_axes)
    np.testing.assert_allclose(near_depth(camera.P, person, uv), h[np.argmin(np.sum(points**2, -1), 0)], atol=1e-4)


@pytest.mark.parametrize(
    ("center", "radius", "code", "pixels"),
    [
        ([0.0, 0.0, 0.3], 0.5, INSIDE, 120 * 160),
        ([0.0, 0.0, -3.0], 0.5, BEHIND, 0),
        ([0.6, 0.0, 0.1], 0.5, CROSSING, 0),
        ([0.0, 0.0, 3.0], 0.5, VISIBLE, None),
    ],
)
def test_bodies_that_are_no_ellipse_are_told(x64, center, radius, code, pixels):
    P = jnp.array([[139.0, 0, 79.5, 0], [0, 139, 59.5, 0], [0, 0, 1, 0]])
    contour = outline(P, sphere(center, radius))
    assert int(contour.code) == code
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(contour))
    count = int(ellipse_mask(contour, SHAPE).sum())
    assert count == pixels if pixels is not None else 0 < count < 120 * 160


def test_c1_is_positive_exactly_outside(x64):
    P = np.array([[139.0, 0, 79.5, 0], [0, 139, 59.5, 0], [0, 0, 1, 0]])
    rng = np.random.default_rng(3)
    for center in rng.uniform(-1, 1, (50, 3)):
        body = sphere(center, 0.8)
        assert (int(outline(jnp.asarray(P), body).code) == INSIDE) == (np.linalg.norm(center) <= 0.8)


@pytest.mark.system
def test_the_soft_mask_is_one_half_on_the_outline_and_differentiable(camera, person):
    contour = outline(camera.P, person)
    soft = np.asarray(soft_ellipse_mask(contour, SHAPE, 8.0))
    np.testing.assert_array_equal(soft >= 0.5, np.asarray(ellipse_mask(contour, SHAPE)))
    assert soft[43, 96] > 0.99

    @jax.jit
    def total(xy, height):
        body = standing(xy, height, jnp.array(0.40))
        return jnp.sum(soft_ellipse_mask(outline(camera.P, body), SHAPE) * jnp.linspace(0, 1, 160))

    xy, height, d = jnp.array([-0.6, 1.2]), jnp.array(1.65), 1e-5
    by_xy, by_height = jax.jit(jax.grad(total, argnums=(0, 1)))(xy, height)
    for axis in (0, 1):
        step = d * jnp.eye(2)[axis]
        numeric = (total(xy + step, height) - total(xy - step, height)) / (2 * d)
        np.testing.assert_allclose(by_xy[axis], numeric, rtol=1e-5)
    np.testing.assert_allclose(by_height, (total(xy, height + d) - total(xy, height - d)) / (2 * d), rtol=1e-5)


def test_gradients_are_finite_where_there_is_no_outline(x64):
    P = jnp.array([[139.0, 0, 79.5, 0], [0, 139, 59.5, 0], [0, 0, 1, 0]])

    @jax.jit
    @jax.grad
    def slope(center):
        return jnp.sum(soft_ellipse_mask(outline(P, Ellipsoid(center, jnp.full(3, 0.5))), (4, 5)))

    for center in ([0.0, 0.0, 0.3], [0.0, 0.0, -3.0], [0.6, 0.0, 0.1], [0.0, 0.0, 3.0]):
        assert np.all(np.isfinite(slope(jnp.array(center))))


def test_people_stand_on_the_floor(x64):
    bodies = standing(jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array(1.6), jnp.array([0.4, 0.5]))
    np.testing.assert_allclose(bodies.center, [[1, 2, 0.8], [3, 4, 0.8]])
    np.testing.assert_allclose(bodies.semi_axes, [[0.2, 0.2, 0.8], [0.25, 0.25, 0.8]])
