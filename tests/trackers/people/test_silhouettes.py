"""What others leave of a window, against the product over all of them."""

import jax.numpy as jnp
import numpy as np

from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import outline
from jaxfilters.trackers.people.silhouettes import (
    body_of,
    overlapping,
    presence_of,
    unexplained_of,
    views_of,
)
from jaxfilters.trackers.people.state import CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene


def test_whoever_is_left_out_would_have_explained_nothing(camera, floor):
    """Nine people from beside the window to far away, one behind the camera: against the product over all of them."""
    scene = people_scene([camera], floor, config=PeopleConfig(capacity=9))
    at = np.random.default_rng(0).uniform([-2.5, -0.5], [2.5, 5.0], (8, 2))
    places = jnp.asarray(np.column_stack([np.vstack([at, [[0.0, -9.0]]]), np.full(9, 1.7), np.full(9, 0.45)]))
    others = jnp.arange(9) > 0
    blank = CameraFrame(np.zeros(camera.shape, np.uint8), np.zeros((*camera.shape, 3), np.uint8), np.bool_(True))
    view = views_of(scene, (blank,), places[0], jnp.eye(4), jnp.array([0.3, 0.2]))
    P, uv = camera.P, view.window.uv[0]
    free = np.full(len(uv), 1 - foreground.CLUTTER)
    for place in places[1:]:
        ahead = np.asarray(outline(P, body_of(place)).depth < view.depth[0])
        free = free * (1 - np.asarray(presence_of(scene.config, P, place, uv)) * ahead)
    found = np.asarray(unexplained_of(scene, places, others, view))[0]
    np.testing.assert_allclose(found, free, atol=2e-3)
    assert 0 < int(jnp.sum(overlapping(P, places, others, uv))) < 7
    assert free.min() < 0.3
