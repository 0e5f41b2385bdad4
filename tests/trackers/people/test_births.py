"""Newcomers: found where silhouettes are drawn, and not where somebody explains them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.trackers.people import lifecycle
from jaxfilters.trackers.people.lifecycle import LEAST_CELLS, LEAST_SHARE, birth, cells_of, padded, stride
from jaxfilters.trackers.people.state import CameraFrame, Cells, PeopleConfig
from jaxfilters.trackers.people.tracker import people_scene

CONFIG = PeopleConfig(capacity=2)
SOMEBODY = (0.7, 1.1, 1.75, 0.45)


@pytest.fixture(scope="module")
def found(camera, floor):
    """Looks for a births where somebody is drawn, given one person who is known or nobody."""
    scene = people_scene([camera], floor, config=CONFIG)
    search = jax.jit(birth)

    def run(mask, known=None, present=True):
        places = jnp.array([known or (0.0, 0.0, 1.7, 0.45), (1.0, 1.0, 1.7, 0.45)])
        frame = CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(present))
        return search(scene, places, jnp.array([known is not None, False]), (frame,))

    return run


def check_near(new, place):
    """Sideways within a step of the lattice; in depth a pixel is 0.1 m, and 0.1 m of wrong height are 0.25 m."""
    assert bool(new.found)
    assert abs(float(new.xy[0]) - place[0]) < CONFIG.cell_m
    assert abs(float(new.xy[1]) - place[1]) < 0.9


@pytest.mark.system
@pytest.mark.parametrize("place", [SOMEBODY, (-1.6, 2.5, 1.6, 0.4), (0.0, -0.6, 1.85, 0.5)])
def test_somebody_new_is_found(found, draw, camera, place):
    check_near(found(draw(camera, [place])[0]), place)


def test_nobody_is_found_in_an_empty_image_or_without_one(found, draw, camera):
    mask = draw(camera, [SOMEBODY])[0]
    assert not found(np.zeros_like(mask)).found
    assert not found(mask, present=False).found


def test_whoever_is_known_is_nobody_new(found, draw, camera):
    mask = draw(camera, [SOMEBODY])[0]
    assert not found(mask, known=SOMEBODY).found
    both = draw(camera, [SOMEBODY, (-1.0, 0.2, 1.7, 0.45)])[0]
    check_near(found(both, known=SOMEBODY), (-1.0, 0.2))


@pytest.mark.system
def test_windows_of_people_cover_what_whole_images_would(camera, floor, monkeypatch):
    """Far, near, half outside the image and behind the camera; against the same with windows as large as the image."""
    scene = people_scene([camera], floor, config=replace(CONFIG, capacity=4))
    at = jnp.array([[-1.0, 6.0], [0.3, -1.5], [3.2, 2.0], [0.0, -9.0]])
    places = jnp.concatenate([at, jnp.tile(jnp.array([1.7, 0.45]), (4, 1))], axis=1)
    frame = CameraFrame(np.full(camera.shape, 200, np.uint8), np.zeros((*camera.shape, 3), np.uint8), np.bool_(True))
    inputs = scene, camera, scene.furniture[0], places, jnp.ones(4, bool), frame
    found = np.asarray(lifecycle._reduced_contrast(*inputs))
    monkeypatch.setattr(lifecycle, "_WINDOW", (1, 1))
    np.testing.assert_allclose(found, lifecycle._reduced_contrast(*inputs), atol=3e-3)
    assert np.ptp(found) > 0.3


def test_small_things_are_nobody(found, camera):
    mask = np.zeros(camera.shape, np.uint8)
    mask[60:70, 80:86] = 255
    assert not found(mask).found


@pytest.mark.system
def test_cells_are_those_of_the_floor_that_a_camera_sees(camera):
    """A triangle of which the camera sees a part; furniture hides half of the image."""
    triangle = np.array([(-9.0, -2.0), (9.0, -2.0), (0.0, 7.0)])
    empty = jnp.full(camera.shape, jnp.inf)
    cells = cells_of((camera,), (empty,), triangle, CONFIG)
    x, y = np.asarray(cells.xy).T
    assert np.all((y > -2) & (y < 7.001 - np.abs(x)))
    uv, depth = camera.project(jnp.stack([x, y, np.full(len(x), 0.86)], axis=-1))
    assert np.all((depth > 0) & (uv[:, 0] > -3) & (uv[:, 0] < 162))
    assert len(x) < 81 / 0.3**2 * 0.8
    assert np.min(cells.share[0]) >= LEAST_SHARE
    left_hidden = empty.at[:, :80].set(1.0)
    rest = cells_of((camera,), (left_hidden,), triangle, CONFIG)
    assert np.asarray(rest.xy)[:, 0].min() > -0.5
    assert len(rest.xy) == pytest.approx(len(cells.xy) / 2, rel=0.15)


@pytest.mark.system
def test_cells_that_only_fill_up_change_nothing(camera, draw, floor):
    """A scene finds the same births as with its own number of cells."""
    scene = people_scene([camera], floor, config=CONFIG)
    own = cells_of(scene.cameras, scene.furniture, np.asarray(floor, float), CONFIG)
    assert 0 < len(own.xy) < LEAST_CELLS == len(scene.cells.xy)
    places, nobody = jnp.tile(jnp.array([0.0, 0.0, 1.7, 0.45]), (2, 1)), jnp.zeros(2, bool)
    both = draw(camera, [SOMEBODY, (-1.0, 0.2, 1.7, 0.45)])[0]
    shown = [both, draw(camera, [SOMEBODY])[0], np.zeros_like(both)]
    search = jax.jit(birth)
    frames = [(CameraFrame(mask, np.zeros((*mask.shape, 3), np.uint8), np.bool_(True)),) for mask in shown]
    filled, plain = (
        [search(replace(scene, cells=cells), places, nobody, frame) for frame in frames] for cells in (scene.cells, own)
    )
    assert [bool(new.found) for new in plain] == [True, True, False]
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(filled), jax.tree.leaves(plain), strict=True))


@pytest.mark.parametrize(("count", "expected"), [(1, 1024), (1024, 1024), (1025, 2048), (5000, 8192)])
def test_cells_are_filled_up_to_a_few_numbers(count, expected):
    ones = np.ones((count, 2), np.float32)
    filled = padded(Cells(ones, (ones.astype(np.int32),), (ones,), (ones[:, 0],), (ones[:, 0],)))
    assert {len(leaf) for leaf in jax.tree.leaves(filled)} == {expected}
    assert all(np.all(np.asarray(leaf)[:count] == 1) for leaf in jax.tree.leaves(filled))
    assert not np.asarray(filled.share[0])[count:].any()


@pytest.mark.system
def test_a_floor_that_no_camera_sees_is_named(camera):
    behind = np.array([(-4.0, -20.0), (4.0, -20.0), (4.0, -10.0)])
    with pytest.raises(ValueError, match="floor: no camera sees half of a person"):
        cells_of((camera,), (jnp.full(camera.shape, jnp.inf),), behind, CONFIG)
    narrow = np.array([(0.0, 0.0), (0.01, 0.0), (0.0, 0.01)])
    with pytest.raises(ValueError, match="floor: no camera sees half of a person"):
        cells_of((camera,), (jnp.full(camera.shape, jnp.inf),), narrow, CONFIG)


@pytest.mark.parametrize(("cols", "expected"), [(80, 1), (160, 1), (161, 2), (480, 3), (1920, 12)])
def test_large_images_are_looked_at_in_steps(cols, expected):
    assert stride((cols * 3 // 4, cols)) == expected
