"""Displacements by silhouettes that are off, against angles that are differentiated numerically."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.trackers.people.silhouette_bias import bias_factor, pixel_m
from jaxfilters.trackers.people.state import STATE, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene


def measured(position, place):
    """Angles of the side, the feet and the head of X, Y, height from a camera, times their distances, metres."""
    x, y, height = place
    away = np.array([x, y]) - position[:2]
    distance = np.linalg.norm(away)
    feet, head = (np.hypot(distance, position[2] - z) for z in (0.0, height))
    angles = [np.arctan2(away[1], away[0])] + [np.arctan2(position[2] - z, distance) for z in (0.0, height)]
    return np.array(angles), np.array([distance, feet, head])


def test_the_covariance_is_that_of_places_from_displaced_edges(camera, camera_at, floor):
    """Of one and of two cameras, by central differences of the angles under which edges appear (1e-6 m steps)."""
    other = camera_at(position=(1.0, -6.0, 4.0), pitch_deg=30.0)
    config = PeopleConfig(capacity=2, cell_m=2.0, silhouette_bias_m=0.03, silhouette_bias_px=0.5)
    place = np.array([0.4, 1.2, 1.8])
    mean = jnp.zeros(STATE).at[:2].set(place[:2]).at[4].set(place[2])
    for cameras in ([camera], [camera, other]):
        information = np.eye(3)
        for one in cameras:
            position = np.asarray(one.position(), float)
            _, distances = measured(position, place)
            steps = 1e-6 * np.eye(3)
            slopes = [(measured(position, place + d)[0] - measured(position, place - d)[0]) / 2e-6 for d in steps]
            jacobian = distances[:, None] * np.transpose(slopes)
            variance = 0.03**2 + (0.5 * float(pixel_m(one, mean[:2]))) ** 2
            information += jacobian.T @ jacobian / variance
        factor = np.asarray(jax.jit(bias_factor)(people_scene(cameras, floor, config=config), mean))
        np.testing.assert_allclose(factor[:3] @ factor[:3].T, np.linalg.inv(information), rtol=2e-3)
        assert not factor[3].any()


def test_a_pixel_is_as_wide_as_the_projection_says(camera):
    """Points a decimetre apart across the line of sight, 1 m above the floor."""
    ends = np.array([(-0.05, 1.0, 1.0), (0.05, 1.0, 1.0)])
    (a, b), _ = camera.project(jnp.asarray(ends))
    found = float(pixel_m(camera, jnp.array([0.0, 1.0])))
    np.testing.assert_allclose(found, 0.1 / np.linalg.norm(np.asarray(b - a)), rtol=1e-3)
