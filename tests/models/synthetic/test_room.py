"""The synthetic room: who is seen where against hulls of projected points, shadows against the floor they fall on."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.synthetic import room
from jaxfilters.models.synthetic.room import floor_camera, looking, room_camera, room_image
from jaxfilters.models.synthetic.walkers import Walker, body

pytestmark = pytest.mark.system

SHAPE = (120, 160)
POSITION = (0.5, -4.0, 2.5)
CLOTHES = jnp.array([((10.0, 10, 250), (250, 10, 10)), ((10.0, 250, 10), (250, 250, 10))])
PLACES = np.array([(-0.6, 0.8), (1.3, 1.6)])
SIZES = np.array([(1.75, 0.45), (1.60, 0.40)])


@pytest.fixture(scope="module")
def pinhole():
    return Pinhole.from_intrinsics(150.0, (79.5, 59.5), SHAPE)


@pytest.fixture(scope="module")
def empty_room(pinhole):
    return room_camera(jax.random.key(0), pinhole, looking(POSITION, 90.0, 20.0), jnp.full(SHAPE, jnp.inf))


@pytest.fixture(scope="module")
def people():
    leaves = (PLACES, [0.5, 2.0], [1.0, 0.0], [1.0, 0.0], *SIZES.T)
    return Walker(*(jnp.asarray(leaf, jnp.float32) for leaf in leaves))


def image_of(camera, people, here=(True, True), key=1):
    image, visible_person = room_image(jax.random.key(key), camera, people, CLOTHES, jnp.array(here))
    return np.asarray(image, float), np.asarray(visible_person)


def hulls(people, P):
    """(people, rows, cols): filled hulls of the projected surface of every part, through the matrix of the camera."""
    latitude, longitude = np.meshgrid(np.linspace(0, np.pi, 30), np.linspace(0, 2 * np.pi, 40))
    sphere = np.stack([np.sin(latitude) * np.cos(longitude), np.sin(latitude) * np.sin(longitude), np.cos(latitude)])
    masks = np.zeros((len(PLACES), *SHAPE), np.uint8)
    for k, mask in enumerate(masks):
        parts = body(jax.tree.map(lambda leaf, k=k: leaf[k], people))
        for center, quaternion, radii in zip(
            *map(np.asarray, (parts.center, parts.rotation, parts.radii)), strict=True
        ):
            turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
            u, v, w = P @ np.vstack([turn @ (radii[:, None] * sphere.reshape(3, -1)) + center[:, None], np.ones(1200)])
            # Sixteenths of a pixel: edges are not rounded to pixels.
            hull = cv2.convexHull(np.round(16 * np.stack([u / w, v / w], axis=-1)).astype(np.int32))
            cv2.fillConvexPoly(mask, hull, 1, shift=4)
    return masks


def test_the_matrix_of_a_camera_projects_as_its_pinhole_does(pinhole):
    transform = looking(POSITION, 70.0, 25.0)
    points = np.random.default_rng(0).uniform((-1, 0, 0), (2, 4, 2), (50, 3))
    observed = pinhole.project(transform.apply(jnp.asarray(points, jnp.float32)))
    uv, depth = floor_camera(pinhole, transform).project(jnp.asarray(points, jnp.float32))
    np.testing.assert_allclose(uv, observed, atol=1e-2)
    np.testing.assert_allclose(depth, transform.apply(jnp.asarray(points, jnp.float32))[:, 2], atol=1e-4)


def test_a_camera_looks_where_it_is_told(pinhole):
    """What lies on the optical axis is in the middle of the image; what is higher is above it."""
    camera = floor_camera(pinhole, looking(POSITION, 70.0, 25.0))
    np.testing.assert_allclose(camera.position(), POSITION, atol=1e-4)
    a, b = np.deg2rad([70.0, 25.0])
    axis = np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), -np.sin(b)])
    (middle, above), _ = camera.project(
        jnp.asarray(POSITION + 3 * axis + np.array([(0, 0, 0), (0, 0, 0.3)]), jnp.float32)
    )
    np.testing.assert_allclose(middle, (79.5, 59.5), atol=1e-2)
    assert above[1] < 55
    assert above[0] == pytest.approx(79.5, abs=0.01)


def test_people_are_seen_where_they_project_to(pinhole, empty_room, people):
    """They do not overlap in this image. OpenCV also fills pixels that the border only touches, of every part."""
    _, visible_person = image_of(empty_room, people)
    expected = hulls(people, np.asarray(floor_camera(pinhole, looking(POSITION, 90.0, 20.0)).P, float))
    assert not np.any(expected.all(axis=0))
    for k, mask in enumerate(expected):
        mine = visible_person == k
        assert not np.any(mine & ~mask.astype(bool))
        inner = cv2.erode(mask, np.ones((3, 3), np.uint8)).astype(bool)
        assert np.mean(mine[inner]) > 0.98
        assert mine.sum() > 200


def test_clothes_and_heads_are_in_their_places(empty_room, people):
    image, visible_person = image_of(empty_room, people)
    rows, cols = np.nonzero(visible_person == 1)
    top, bottom = rows.min(), rows.max()
    middle = cols[rows < top + 5].mean().round().astype(int)
    np.testing.assert_allclose(image[top + 2, middle], room.SKIN, atol=15)
    shirt, trousers = image[int(top + 0.3 * (bottom - top)), middle], image[int(bottom - 0.3 * (bottom - top))]
    np.testing.assert_allclose(shirt, CLOTHES[1, 0], atol=15)
    legs = cols[rows == int(bottom - 0.3 * (bottom - top))]
    np.testing.assert_allclose(trousers[legs].mean(axis=0), CLOTHES[1, 1], atol=15)


def test_shadows_lie_on_the_floor_beside_the_feet(pinhole, empty_room, people):
    """What is darkened is exactly the ellipse of each shadow, where nobody stands in front of it."""
    with_people, visible_person = image_of(empty_room, people)
    without, _ = image_of(empty_room, people, here=(False, False))
    v, u = np.meshgrid(*[np.arange(n, dtype=float) for n in SHAPE], indexing="ij")
    camera = floor_camera(pinhole, looking(POSITION, 90.0, 20.0))
    H = np.linalg.inv(np.asarray(camera.P, float)[:, [0, 1, 3]])
    x, y, w = np.einsum("ij,jrc->irc", H, np.stack([u, v, np.ones_like(u)]))
    floor = np.stack([x / w, y / w], axis=-1)
    away = (floor[None] - (PLACES + room.SHADOW_AWAY_M)[:, None, None]) / np.array(room.SHADOW_AXES_M)
    radius = np.min(np.linalg.norm(away, axis=-1), axis=0)
    ratio = with_people.sum(axis=-1) / without.sum(axis=-1)
    inside, outside = (radius < 0.95) & (visible_person < 0), (radius > 1.05) & (visible_person < 0)
    assert inside.sum() > 60
    np.testing.assert_allclose(ratio[inside], room.SHADOW, atol=0.02)
    np.testing.assert_allclose(ratio[outside], 1, atol=1e-6)


def test_furniture_hides_people_and_shadows(pinhole, people):
    wall = jnp.full(SHAPE, jnp.inf).at[:, 40:].set(1.0)
    camera = room_camera(jax.random.key(0), pinhole, looking(POSITION, 90.0, 20.0), wall)
    image, visible_person = image_of(camera, people)
    without, _ = image_of(camera, people, here=(False, False))
    assert np.all(visible_person[:, 40:] == -1)
    np.testing.assert_array_equal(image[:, 40:], without[:, 40:])


def test_who_is_not_here_is_not_seen_and_noise_is_as_stated(empty_room, people):
    image, visible_person = image_of(empty_room, people, here=(False, True))
    assert set(np.unique(visible_person)) == {-1, 1}
    other, _ = image_of(empty_room, people, here=(False, True), key=2)
    assert np.std(image - other) == pytest.approx(room.NOISE_STD * np.sqrt(2), rel=0.03)
    again, _ = image_of(empty_room, people, here=(False, True))
    np.testing.assert_array_equal(image, again)
