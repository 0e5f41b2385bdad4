"""Every visible pixel of every part lies in its window, whatever the bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.rendering.quadrics import capsule_parts
from jaxfilters.models.rendering.windows import COARSE, FINE, plan_windows

SHAPE = (90, 120)


def random_boxes(seed, count):
    rng = np.random.default_rng(seed)
    middle = rng.uniform((-40, -40), (160, 130), (count, 2))
    half = rng.uniform(0, 1, (count, 2)) ** 2 * rng.choice([2, 10, 40, 200], (count, 1))
    boxes = np.concatenate([middle - half, middle + half], axis=1)
    boxes[0], boxes[1] = (np.inf, np.inf, -np.inf, -np.inf), (-np.inf, -np.inf, np.inf, np.inf)
    return boxes


def pixels_of(box):
    rows, cols = np.indices(SHAPE)
    return (cols >= box[0]) & (cols <= box[2]) & (rows >= box[1]) & (rows <= box[3])


@pytest.mark.parametrize("sides", [FINE, COARSE], ids=["fine", "coarse"])
@pytest.mark.parametrize(("seed", "count"), [(0, 40), (1, 40), (2, 40), (3, 200)])
def test_windows_hold_the_visible_pixels(sides, seed, count):
    boxes = random_boxes(seed, count)
    plan = plan_windows(jnp.asarray(boxes), SHAPE, sides)
    order, bounds, start = (np.asarray(value) for value in (plan.order, plan.bounds, plan.start))
    assert sorted(order) == list(range(len(boxes)))
    drawn = {}
    for index, (rows, cols) in enumerate(plan.sizes):
        for part in order[bounds[index] : bounds[index + 1]]:
            window = np.zeros(SHAPE, bool)
            row, col = start[part]
            assert 0 <= row <= SHAPE[0] - rows
            assert 0 <= col <= SHAPE[1] - cols
            window[row : row + rows, col : col + cols] = True
            drawn[part] = window
    for part, box in enumerate(boxes):
        visible = pixels_of(box)
        assert (part in drawn) == visible.any()
        assert part not in drawn or np.all(drawn[part] | ~visible)


def test_parts_take_the_smallest_window_that_holds_them():
    boxes = jnp.asarray([[10.0, 10, 25, 25], [10, 10, 26, 25], [10, 10, 25, 26], [0, 0, 119, 89]])
    plan = plan_windows(boxes, SHAPE, FINE)
    held = [plan.sizes[int(np.sum(np.asarray(plan.bounds[1:]) <= place))] for place in range(4)]
    windows = dict(zip(np.asarray(plan.order).tolist(), held, strict=True))
    assert windows == {0: (16, 16), 1: (16, 32), 2: (32, 16), 3: SHAPE}


def test_bounds_of_capsules_are_exact(x64, camera, random_capsules):
    """Bounds touch the outline: sampled tangent points of the spheres at both ends lie within, and reach them."""
    capsules = random_capsules(3)
    box = np.asarray(jax.jit(capsule_parts)(camera, capsules).box)
    angles = np.linspace(0, 2 * np.pi, 20001)
    for part in range(len(box)):
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        for center in (capsules.start[part], capsules.end[part]):
            center, radius = np.asarray(center), float(capsules.radius[part])
            distance = np.linalg.norm(center)
            axis = center / distance
            side = np.linalg.svd(axis[None])[2][1:]
            circle = np.cos(angles)[:, None] * side[0] + np.sin(angles)[:, None] * side[1]
            sine = radius / distance
            points = center - radius * sine * axis + radius * np.sqrt(1 - sine**2) * circle
            uv = np.asarray(camera.project(jnp.asarray(points)))
            low, high = np.minimum(low, uv.min(axis=0)), np.maximum(high, uv.max(axis=0))
        np.testing.assert_allclose(box[part], [*low, *high], atol=1e-5)


def test_an_image_smaller_than_the_smallest_window_is_drawn_whole():
    box = jnp.array([[0.0, 0.0, 3.0, 3.0], [20.0, 0.0, 30.0, 3.0]])
    plan = plan_windows(box, (8, 8), ((16, 16), (64, 64)))
    assert plan.sizes == ((8, 8),)
    np.testing.assert_array_equal(plan.order, [1, 0])
    np.testing.assert_array_equal(plan.bounds, [1, 2])
