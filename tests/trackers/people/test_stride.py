"""Strides: of states, and in silhouettes of bodies with jointed legs, which nothing of the tracker has drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.depth import render_ellipsoids
from jaxfilters.models.synthetic.room import floor_camera, looking
from jaxfilters.models.synthetic.walkers import HIP, LEG_SWING, Walker, body
from jaxfilters.trackers.people import stride
from jaxfilters.trackers.people.fit import fit_people
from jaxfilters.trackers.people.silhouettes import View
from jaxfilters.trackers.people.state import DETECTABILITY_PRIOR, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.stride import FULL_STRIDE, longest_stride, with_stride
from jaxfilters.trackers.people.tracker import people_scene

AT, HEIGHT_M = (0.3, 4.0), 1.8
PINHOLE = Pinhole.from_intrinsics(330.0, (239.5, 179.5), (360, 480))
T_CAMERA_WORLD = looking((0.0, -4.0, 2.9), 90.0, 15.0)
FLOOR = [(-4, -2), (4, -2), (4, 8), (-4, 8)]
APART = (0.2, 0.5, 0.8, 1.0)
"""Shares of a full stride; at 0, limbs one behind the other make a body as narrow as nobody."""


def moving(x, y):
    return jnp.array([1.0, 2.0, x, y, 1.7, 0.45, 0.0, 0.0, 0.0])


def test_strides_are_as_long_as_speed_says_and_forward():
    """None at the speed of drift, all of it from a walk on, half of it in the middle; heading is 3:4."""
    found = np.asarray(longest_stride(jnp.stack([moving(0.6 * v, 0.8 * v) for v in (0.0, 0.2, 0.5, 0.75, 3.0)])))
    share = np.array([0, 0, 0.5, 1, 1])[:, None]
    np.testing.assert_allclose(found, FULL_STRIDE * 1.7 * share * [0.6, 0.8], atol=1e-6)


def test_a_full_stride_is_that_of_the_walkers():
    """The end of a shank lies 0.9 of a leg below the hip, the model's leg 1 (body of 1.66 m)."""
    assert pytest.approx(0.9 / (HIP * 1.66) * HIP * np.sin(LEG_SWING), abs=0.005) == FULL_STRIDE


def test_legs_are_together_by_default():
    np.testing.assert_array_equal(with_stride(jnp.arange(8.0).reshape(2, 4)), [[0, 1, 2, 3, 0, 0], [4, 5, 6, 7, 0, 0]])


@pytest.mark.parametrize(("alone", "share"), [(True, 1.0), (False, 0.5)])
def test_beside_others_legs_are_half_a_stride_apart_whatever_the_image_shows(alone, share, monkeypatch):
    monkeypatch.setattr(stride, "log_likelihood", lambda scene, shape, views, contrasts: shape[4])
    shape, longest = jnp.array([1.0, 2.0, 1.7, 0.45, 0.1, 0.0]), jnp.array([0.4, 0.0])
    scene = people_scene([floor_camera(PINHOLE, T_CAMERA_WORLD)], FLOOR)
    views = View(*[jnp.zeros((1, 1))] * len(View._fields))
    chosen = stride.with_best_stride(scene, shape, longest, views, jnp.zeros((1, 1)), jnp.array(alone))
    np.testing.assert_allclose(chosen, [1.0, 2.0, 1.7, 0.45, share * 0.4, 0.0], rtol=1e-6)


def search_of(num_cameras, **config):
    """The search in silhouettes of somebody who walks to the right, with legs by a share of a full stride apart.

    All cameras are at the same place.
    """
    cameras = [floor_camera(PINHOLE, T_CAMERA_WORLD)] * num_cameras
    scene = people_scene(cameras, FLOOR, config=PeopleConfig(capacity=1, spread_px=0.0, **config))
    mean = jnp.array([[*AT, 1.2, 0.0, HEIGHT_M, 0.47, 0.0, 0.0, 0.0]])
    sd = jnp.array([0.3, 0.3, 0.3, 0.3, 0.02, 0.05, 0.1, 0.1, 0.1])
    nothing = jnp.zeros((1, num_cameras, 2)), jnp.array([DETECTABILITY_PRIOR]), jnp.ones(1, bool), jnp.zeros(1)
    search = jax.jit(lambda frames: fit_people(scene, Gaussian(mean, jnp.diag(sd**2)[None]), *nothing, frames))
    render = jax.jit(lambda walker: render_ellipsoids(PINHOLE, body(walker), T_CAMERA_WORLD))

    def run(share):
        phase = jnp.asarray(np.arcsin(share))
        walker = Walker(jnp.array(AT), jnp.zeros(()), phase, jnp.ones(()), jnp.array(HEIGHT_M), jnp.array(0.47))
        mask = np.isfinite(np.asarray(render(walker))).astype(np.uint8) * np.uint8(255)
        return search((CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True)),) * num_cameras)

    return run


@pytest.fixture(scope="module")
def found():
    return search_of(1)


@pytest.mark.system
@pytest.mark.parametrize(("error", "share"), [(0.0, 1.0), (0.005, 0.0)])
def test_where_a_second_image_may_be_shifted_legs_are_together(error, share):
    fit = search_of(2, calibration_error=error)(1.0)
    np.testing.assert_allclose(fit.stride[0, 0], share * FULL_STRIDE * HEIGHT_M, rtol=1e-5)


@pytest.mark.system
def test_people_are_found_where_they_are_at_every_moment_of_a_stride(found):
    """A pixel at the feet is 0.2 m of depth: 330 px * 2.9 m / (8 m)^2 to the metre of floor."""
    strides = []
    for share in APART:
        fit = found(share)
        strides.append(float(fit.stride[0, 0]))
        assert abs(float(fit.place[0, 1]) - AT[1]) < 0.2
        assert abs(float(fit.place[0, 0]) - AT[0]) < 0.05
    assert strides == sorted(strides)
    np.testing.assert_allclose([strides[0], strides[-1]], [0.0, FULL_STRIDE * HEIGHT_M], rtol=1e-5)


@pytest.mark.system
def test_legs_that_are_apart_put_somebody_too_far_who_is_searched_for_with_legs_together(found, monkeypatch):
    monkeypatch.setattr(stride, "STRIDES", (0.0,) * 4)
    jax.clear_caches()
    assert float(found(1.0).place[0, 1]) - AT[1] > 0.3
