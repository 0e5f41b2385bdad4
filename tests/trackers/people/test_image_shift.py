"""Silhouettes that a wrong calibration puts beside those of the first camera: drawn in cameras that are right."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.trackers.people.fit import fit_people
from jaxfilters.trackers.people.image_shift import displacement_by_shift, shift_sd, weighted
from jaxfilters.trackers.people.silhouettes import views_of
from jaxfilters.trackers.people.state import DETECTABILITY_PRIOR, STATE, CameraFrame, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

PLACE = (0.2, 1.0, 1.70, 0.45)
SHIFT = (1.5, -1.0)
FRAMES = 8


def moved(camera, u, v):
    """A camera whose image lies some pixels farther right and down."""
    return replace(camera, P=jnp.array([[1.0, 0, u], [0, 1, v], [0, 0, 1]]) @ camera.P)


@pytest.mark.system
def test_the_place_is_that_of_the_first_camera_and_the_second_is_shifted(camera, camera_at, draw, floor):
    """The second camera is believed to be where its silhouettes are not: 1.5 and -1 pixels, of a prior of 0.8."""
    true = (camera, camera_at((0.0, -4.0, 2.0), 18.0))
    scenes = [
        people_scene(cameras, floor, config=PeopleConfig(capacity=1, spread_px=0.0, calibration_error=0.005))
        for cameras in (true, (true[0], moved(true[1], -SHIFT[0], -SHIFT[1])))
    ]
    frames = tuple(
        CameraFrame(draw(one, (PLACE,))[0], np.zeros((*one.shape, 3), np.uint8), np.bool_(True)) for one in true
    )
    mean = jnp.zeros((1, STATE)).at[0, :6].set(jnp.array([*PLACE[:2], 0, 0, *PLACE[2:]]))
    sd = jnp.array([0.3, 0.3, 0.5, 0.5, 0.08, 0.05, 0.1, 0.1, 0.1])
    belief = Gaussian(mean, jnp.diag(sd**2)[None])
    unchanged = jnp.array([DETECTABILITY_PRIOR]), jnp.ones(1, bool), jnp.zeros(1)
    search = jax.jit(fit_people)
    found = []
    for scene in scenes:
        shifts = jnp.zeros((1, 2, 2))
        for _ in range(FRAMES):
            fit = search(scene, belief, shifts, *unchanged, frames)
            shifts = fit.shift
        found.append(fit)
    exact, wrong = (np.asarray(fit.shift[0, 1]) for fit in found)
    np.testing.assert_array_equal(found[1].shift[0, 0], 0.0)
    assert np.abs(wrong - exact - SHIFT).max() < 0.75
    assert np.linalg.norm(found[1].place[0, :2] - jnp.array(PLACE[:2])) < 0.12


@pytest.mark.usefixtures("x64")
def test_a_shift_moves_a_person_as_its_pixels_say(camera):
    """Along u a person at right angles to the line of sight moves by depth / focal length; the camera looks along Y."""
    place = jnp.array([0.0, 1.0])
    by_shift = np.asarray(displacement_by_shift(camera, place, jnp.asarray(1.7)))
    feet, depth = camera.project(jnp.array([[0.0, 1.0, 0.0], [0.0, 1.0, 1.7]]))
    assert by_shift[0, 0] == pytest.approx(float(jnp.mean(depth)) / 150, rel=0.05)
    assert abs(by_shift[1, 0]) < 1e-3
    there, _ = camera.project(jnp.array([[0.0, 1.0 + by_shift[1, 1], 0.0]]))
    assert there[0, 1] - feet[0, 1] == pytest.approx(1.0, abs=0.1)


@pytest.mark.system
def test_the_first_camera_counts_in_full_and_another_one_alone_does_so_too(camera, floor):
    scene = people_scene((camera, camera), floor, config=PeopleConfig(capacity=1, calibration_error=0.005))
    blank = np.zeros(camera.shape, np.uint8)
    image = np.zeros((*camera.shape, 3), np.uint8)
    found = {}
    for present in ((True, True), (False, True)):
        frames = tuple(CameraFrame(blank, image, np.bool_(one)) for one in present)
        views = views_of(scene, frames, jnp.array(PLACE), jnp.eye(4), jnp.array([0.2, 0.2]))
        found[present] = np.asarray(views.area / weighted(scene, jnp.array(PLACE), views).area)
    assert found[True, True][0] == pytest.approx(1.0)
    assert 0.2 < found[True, True][1] < 0.9
    assert found[False, True][1] == pytest.approx(1.0)
    assert np.asarray(shift_sd(scene)).tolist() == pytest.approx([0.0, 0.8])
