"""Walkers: where their bodies end, against points on their surfaces turned by scipy, and how they go along routes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.synthetic.walkers import STRIDE_M, Walker, along_routes, body


def walker(*, xy=(0.0, 0.0), heading=0.0, phase=0.0, swing=0.0, height=1.75, width=0.45):
    return Walker(*(jnp.asarray(value, jnp.float32) for value in (xy, heading, phase, swing, height, width)))


def surface(one):
    """(parts, points, 3) of all ellipsoids in the world."""
    latitude, longitude = np.meshgrid(np.linspace(0, np.pi, 61), np.linspace(0, 2 * np.pi, 60, endpoint=False))
    sphere = np.stack([np.sin(latitude) * np.cos(longitude), np.sin(latitude) * np.sin(longitude), np.cos(latitude)])
    parts = body(one)
    points = np.asarray(parts.radii)[:, :, None] * sphere.reshape(3, -1)
    turns = Rotation.from_quat(np.asarray(parts.rotation), scalar_first=True).as_matrix()
    return np.einsum("pij,pjn->pni", turns, points) + np.asarray(parts.center)[:, None]


@pytest.mark.parametrize("height", [1.5, 1.75, 2.0])
def test_somebody_who_stands_reaches_from_the_floor_to_the_height(height):
    points = surface(walker(height=height))
    assert points[..., 2].max() == pytest.approx(height, abs=1e-3)
    assert points[..., 2].min() == pytest.approx(0.0, abs=0.03)


@pytest.mark.parametrize("phase", np.linspace(0, 2 * np.pi, 9))
def test_a_foot_is_on_the_floor_throughout_a_stride(phase):
    """The head sinks by less than a tenth, and no foot goes through the floor by more than 3 cm."""
    points = surface(walker(phase=phase, swing=1.0))
    assert points[..., 2].min() == pytest.approx(0.0, abs=0.03)
    assert 0.9 * 1.75 < points[..., 2].max() < 1.75 + 1e-3


def test_arms_are_as_far_apart_as_the_width():
    across = surface(walker(width=0.5))[..., 1]
    assert np.ptp(across) == pytest.approx(0.5, rel=0.05)


def test_legs_swing_along_the_heading_in_opposite_directions():
    """Heading +Y; both shanks are parts 3 and 6, and apart by a large share of a step in mid-stride."""
    apart = {}
    for phase in (0.0, np.pi / 2, 3 * np.pi / 2):
        shanks = np.asarray(body(walker(heading=np.pi / 2, phase=phase, swing=1.0)).center)[[3, 6]]
        apart[phase] = shanks[1] - shanks[0]
    np.testing.assert_allclose(apart[0.0][1], 0.0, atol=1e-6)
    assert abs(apart[np.pi / 2][1]) > 0.35 * STRIDE_M / 2
    np.testing.assert_allclose(apart[np.pi / 2][1], -apart[3 * np.pi / 2][1], atol=1e-6)
    sideways = [abs(difference[0]) for difference in apart.values()]
    np.testing.assert_allclose(sideways, sideways[0], rtol=1e-5)


def test_lower_ends_of_limbs_are_where_they_swing_to():
    """The foot of the leg that is ahead is ahead of its thigh: the turn of a limb has the sign of its displacement."""
    points, centers = (
        surface(walker(phase=np.pi / 2, swing=1.0)),
        np.asarray(body(walker(phase=1.5708, swing=1.0)).center),
    )
    for thigh, shank in ((2, 3), (5, 6)):
        lowest = points[shank][np.argmin(points[shank][:, 2])]
        assert np.sign(lowest[0] - centers[thigh, 0]) == np.sign(centers[shank, 0] - centers[thigh, 0])
        assert abs(lowest[0] - centers[thigh, 0]) > abs(centers[shank, 0] - centers[thigh, 0])


def test_place_and_heading_move_the_whole_body():
    plain = surface(walker(phase=1.0, swing=1.0))
    moved = surface(walker(xy=(2.0, -3.0), heading=0.7, phase=1.0, swing=1.0))
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    np.testing.assert_allclose(moved, plain @ turn.T + [2, -3, 0], atol=1e-5)


@pytest.mark.system
def test_bodies_can_be_had_in_batches():
    two = jax.tree.map(lambda a, b: jnp.stack([a, b]), walker(), walker(xy=(1.0, 2.0)))
    np.testing.assert_allclose(jax.vmap(body)(two).center[1], body(walker(xy=(1.0, 2.0))).center, atol=1e-6)


def test_routes_are_walked_steadily_from_start_to_end():
    """Along a straight line of 4 m at 1 m/s from second 1 on; corners are rounded, ends included, over 0.4 m."""
    routes = along_routes([np.array([(0.0, 0.0), (4.0, 0.0)])], [1.0], [1.0], 80, 10.0)
    assert routes.xy.shape == (80, 1, 2)
    x = routes.xy[:, 0, 0]
    assert np.ptp(x[:11]) == 0
    np.testing.assert_allclose(x[20:45], 0.1 * np.arange(10, 35), atol=1e-9)
    assert np.ptp(x[60:]) == 0
    np.testing.assert_allclose(routes.heading[:, 0], 0, atol=1e-9)
    np.testing.assert_allclose(routes.swing[[5, 30, 70], 0], [0, 1, 0])
    phase_per_m = (routes.phase[40, 0] - routes.phase[30, 0]) / (x[40] - x[30])
    assert phase_per_m == pytest.approx(2 * np.pi / STRIDE_M)


def test_people_look_where_they_go():
    """The heading is taken over 0.4 m of the way and the place over 0.8 m, so that they differ around a corner."""
    corners = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 3.0)])
    routes = along_routes([corners], [1.2], [0.0], 45, 10.0)
    moved = np.diff(routes.xy[:, 0], axis=0)
    heading = np.arctan2(moved[:, 1], moved[:, 0])
    turned = np.angle(np.exp(1j * (routes.heading[1:, 0] - heading)))
    assert np.abs(turned[3:40]).max() < np.deg2rad(25)
    assert np.linalg.norm(moved, axis=-1).max() < 1.2 / 10 + 1e-9
