"""What a state looks like: how walking lowers somebody, against the bodies of walkers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import outline
from jaxfilters.models.synthetic.walkers import Walker, body
from jaxfilters.trackers.people.silhouettes import (
    SINK,
    body_of,
    overlapping,
    place_of,
    presence_of,
    stature,
    unexplained_of,
    views_of,
)
from jaxfilters.trackers.people.state import CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene


def moving(speed, height=1.7):
    return jnp.array([1.0, 2.0, 0.6 * speed, 0.8 * speed, height, 0.45, 0.0, 0.0, 0.0])


def test_walkers_sink_as_much_over_a_step_as_the_constant_says():
    """The middle of the head over a whole stride, against that of somebody who stands."""
    phases = jnp.linspace(0, 2 * jnp.pi, 64, endpoint=False)

    def head(phase, swing):
        still = jnp.zeros(())
        return body(Walker(jnp.zeros(2), still, phase, swing, jnp.asarray(1.7), jnp.asarray(0.45))).center[0, 2]

    heights = jax.jit(jax.vmap(head, in_axes=(0, None)))
    walking, standing = (np.asarray(heights(phases, jnp.asarray(swing))).mean() for swing in (1.0, 0.0))
    assert (standing - walking) / 1.7 == pytest.approx(SINK, abs=0.001)


def test_somebody_at_rest_looks_taller_than_on_the_way():
    """Half of it either way; slow drift is rest, and nothing changes beyond a walk."""
    factors = [float(stature(moving(speed))) for speed in (0.0, 0.2, 0.5, 0.75, 3.0)]
    np.testing.assert_allclose(factors, 1 + SINK * np.array([0.5, 0.5, 0, -0.5, -0.5]), rtol=1e-6)


@pytest.mark.system
def test_the_place_is_that_of_the_state_but_for_the_height():
    states = jnp.stack([moving(0.0), moving(2.0)])
    found = np.asarray(place_of(states))
    np.testing.assert_allclose(found[:, [0, 1, 3]], [[1.0, 2.0, 0.45]] * 2, rtol=1e-6)
    np.testing.assert_allclose(found[:, 2], 1.7 * np.asarray(stature(states)), rtol=1e-6)
    assert np.isfinite(jax.jacfwd(place_of)(moving(1.0))).all()


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
