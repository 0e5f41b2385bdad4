"""The synthetic default: the same for a seed, people who keep clear of the furniture, views that overlap."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfilters.models.person.scene import mesh_depth, walkable
from jaxfilters.trackers.people.demo_room import BOXES, FLOOR_M, PLACES, SHAPE, demo_room

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def room():
    return demo_room(3, cameras=2, frames=240)


def test_images_are_those_of_the_seed(room):
    first = room.image(1, 40)
    assert first.shape == (*SHAPE, 3)
    np.testing.assert_array_equal(first, room.image(1, 40))
    assert np.any(first != room.image(1, 41))
    assert len(room) == len(room.routes.xy) == 240


def test_seeds_differ_in_speeds(room):
    other = demo_room(4, frames=240)
    assert np.abs(other.routes.xy - room.routes.xy).max() > 0.3


def test_people_appear_in_the_images(room):
    """Frame 0 is empty, later ones are not; noise differs by a few grey values only."""
    assert not room.present(0).any()
    assert room.present(60).any()
    empty, busy = (room.image(0, i).astype(float) for i in (0, 60))
    assert np.mean(np.abs(busy - empty).max(axis=-1) > 30) > 0.005


def test_everybody_walks_through_the_room_and_around_the_furniture(room):
    """No box is nearer than half a width; everybody is on the floor for a while and outside at the start."""
    on_floor = np.asarray(walkable(jnp.asarray(FLOOR_M), jnp.asarray(room.routes.xy)))
    assert np.all(on_floor.sum(axis=0) > 60)
    assert not on_floor[0].any()
    for size, center in BOXES:
        beyond = np.abs(room.routes.xy - np.array(center[:2])) - np.array(size[:2]) / 2
        assert np.all(np.max(beyond, axis=-1)[on_floor] > 0.24)


def test_furniture_stands_in_front_of_some_floor_in_every_view(room):
    for camera, depth in zip(room.cameras, room.furniture, strict=True):
        observed = np.isfinite(depth)
        assert 0.01 < observed.mean() < 0.5
        assert depth.shape == camera.shape
        box = np.array([center for _, center in BOXES])
        uv, far = (np.asarray(a) for a in camera.project(jnp.asarray(box, jnp.float32)))
        inside = np.all((uv > 0) & (uv < (SHAPE[1] - 1, SHAPE[0] - 1)), axis=-1)
        for (u, v), distance in zip(uv[inside].astype(int), far[inside], strict=True):
            assert distance - 0.8 < depth[v, u] < distance


@pytest.mark.parametrize("cameras", [0, len(PLACES) + 1])
def test_a_wrong_number_of_cameras_is_named(cameras):
    with pytest.raises(ValueError, match=f"cameras must be 1 to 4; got {cameras}"):
        demo_room(0, cameras=cameras)


def test_furniture_has_the_depth_of_boxes_as_meshes(room):
    boxes = [trimesh.creation.box(size, trimesh.transformations.translation_matrix(at)) for size, at in BOXES]
    both = trimesh.util.concatenate(boxes)
    for camera, found in zip(room.cameras, room.furniture, strict=True):
        # Both are rounded to float32 at distances of some metres, by different products.
        np.testing.assert_allclose(found, mesh_depth(camera, both.vertices, both.faces), rtol=0, atol=1e-4)
