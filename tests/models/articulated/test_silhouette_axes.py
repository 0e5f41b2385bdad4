"""Figures 17 and 18 (E5): joint angles and finger lengths from axes that are cut out of a silhouette.

The palm is known and the camera all but orthographic; fingers are drawn as capsules, and where they stick out far
enough to show both of their edges, the middle between these is the axis. What is measured has the errors of pixels, of
a rough pose that says where to look, and of fingers in front of each other: none of them what the filter believes in.
"""

import math
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

import jaxfilters
from jaxfilters import Gaussian
from jaxfilters.models.articulated import filters
from jaxfilters.models.articulated.features import FeatureSet
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.limits import limit_rows, table_1
from jaxfilters.models.articulated.motion import ConstantVelocity
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.geometry import Capsules
from jaxfilters.models.rendering.silhouette import soft_silhouette
from jaxfilters.models.synthetic.articulated import INITIAL_SHAPE, LAYOUT, PALM_TO_CAMERA, initial_belief, paper_states

RADIUS, PALM_RADIUS = 5.0, 15.0
"""Pixels: of fingers, and of the lines from the wrist to their bases."""
CENTER = np.array([100.0, 130.0])
FAR = 1e4
"""Pixels: distance and focal length, so that the fingers' depth of 100 pixels changes the scale by 1 %."""
ROUGH = 2.0
"""Pixels: error of each coordinate of the joints of the rough pose."""


@pytest.fixture(scope="module")
def hand():
    motion = ConstantVelocity(LAYOUT.per_moving(0.0, 0.0, math.radians(1.5)))
    return articulated_hand(LAYOUT, features=FeatureSet(("tips", "lines")), motion=motion)


@pytest.fixture(scope="module")
def states():
    """The fingers of the paper's sequence on a palm that stands still, turned by 40 degrees about its long axis."""
    x = np.array(paper_states(1))
    turned = Rotation.from_euler("y", 40, degrees=True) * Rotation.from_quat(PALM_TO_CAMERA, scalar_first=True)
    x[:, LAYOUT.position], x[:, LAYOUT.quaternion] = (0, 90), turned.as_quat(scalar_first=True)
    x[:, LAYOUT.rates.start : LAYOUT.angle_rates.start] = 0
    return jnp.asarray(x)


@pytest.fixture(scope="module")
def measured(hand, states):
    """(frames, rows) features and masks, from images."""
    rng = np.random.default_rng(0)
    joints = np.asarray(jax.vmap(hand.image_points)(states))
    rough = joints + rng.normal(scale=ROUGH, size=joints.shape)
    rows = [features_of(image, pose) for image, pose in zip(np.asarray(silhouettes(hand, states)), rough, strict=True)]
    y = np.array([[row.get(name, 0.0) for name in hand.feature_names] for row in rows])
    return jnp.asarray(y, dtype=float), jnp.array([[name in row for name in hand.feature_names] for row in rows])


@jax.jit
def silhouettes(hand, states):
    camera = Pinhole(jnp.full(2, FAR), jnp.asarray(CENTER, dtype=float), (220, 200))
    radius = jnp.array([RADIUS] * 6 + [PALM_RADIUS] * 2)

    def draw(x):
        joints = hand.points(x) + jnp.array([0.0, 0.0, FAR])
        wrist = jnp.broadcast_to(jnp.append(x[LAYOUT.position], FAR), (2, 3))
        start = jnp.concatenate([joints[:, :-1].reshape(-1, 3), wrist])
        end = jnp.concatenate([joints[:, 1:].reshape(-1, 3), joints[:, 0]])
        return soft_silhouette(camera, Capsules(start, end, radius), softness=0.4)

    return jax.lax.map(draw, states)


def covered(image, points):
    return map_coordinates(image, np.moveaxis(points + CENTER, -1, 0)[::-1], order=1)


def axis_of(image, start, end):
    """A point on a link's axis and its direction, or None where fewer than six sections show both edges."""
    length = np.linalg.norm(end - start)
    along = (end - start) / length
    normal = np.array([-along[1], along[0]])
    step = 0.5
    places, across = np.arange(0.25 * length, 0.75 * length, 2.0), np.arange(-1.8 * RADIUS, 1.8 * RADIUS, step)
    sections = covered(image, start + places[:, None, None] * along + across[:, None] * normal)
    width = step * sections.sum(axis=1)
    clear = (abs(width - 2 * RADIUS) < 0.3 * RADIUS) & (sections[:, [0, -1]] < 0.5).all(axis=1)
    if clear.sum() < 6:
        return None
    offset = (sections @ across / sections.sum(axis=1))[clear]
    middle = start + places[clear, None] * along + offset[:, None] * normal
    direction = np.linalg.svd(middle - middle.mean(axis=0))[2][0]
    return middle.mean(axis=0), direction * np.sign(direction @ along)


def tip_on(image, point, direction, near):
    """Where the axis ends: a radius before it leaves the silhouette, or None where it does not do so here."""
    places = (near - point) @ direction + np.arange(-2 * RADIUS, 3 * RADIUS, 0.25)
    inside = covered(image, point + places[:, None] * direction) > 0.5
    if inside.all() or not inside[0]:
        return None
    return point + (places[np.argmin(inside)] - 0.125 - RADIUS) * direction


def features_of(image, pose):
    """Rows by name; those that cannot be seen are left out."""
    rows = {}
    for finger, joints in enumerate(pose, start=1):
        for link, (start, end) in enumerate(pairwise(joints), start=1):
            if (axis := axis_of(image, start, end)) is None:
                continue
            (x, y), (cos, sin) = axis
            rows[f"alpha_{finger}{link}"], rows[f"rho_{finger}{link}"] = math.atan2(sin, cos), cos * y - sin * x
            if link == 3 and (tip := tip_on(image, *axis, end)) is not None:
                rows[f"p_{finger}3_x"], rows[f"p_{finger}3_y"] = tip
    return rows


@pytest.mark.system
def test_axes_and_tips_of_protrusions_are_those_of_the_fingers(hand, states, measured):
    y, mask = measured
    residual = np.asarray(jax.vmap(hand.residual)(y, jax.vmap(hand.observe)(states)))
    residual = np.where(mask, residual, np.nan)
    kinds = np.array([name.split("_")[0] for name in hand.feature_names])
    rms = {kind: np.sqrt(np.nanmean(residual[:, kinds == kind] ** 2)) for kind in ("alpha", "rho", "p")}
    # Well inside the noise of the specification: 2 degrees, 1 pixel, 1 pixel.
    assert rms["alpha"] < math.radians(1.0)
    assert rms["rho"] < 0.6
    assert rms["p"] < 1.0
    assert np.asarray(mask)[:, kinds == "alpha"].mean(axis=0).min() > 0.6


@pytest.mark.system
def test_lengths_and_angles_are_found_from_a_silhouette(hand, states, measured):
    y, mask = measured
    free = np.zeros(LAYOUT.size, bool)
    for block in (LAYOUT.angles, LAYOUT.angle_rates, LAYOUT.lengths):
        free[block] = True
    mean, covariance = initial_belief(jax.random.key(0), states[0], shape=INITIAL_SHAPE)
    mean, covariance = jnp.where(free, mean, states[0]), jnp.where(free[:, None] & free, covariance, 0.0)
    limits = filters.inequalities(limit_rows(LAYOUT, table_1()))

    @jax.jit
    def follow(mean, covariance, y, mask):
        filter = filters.recommended(hand, Gaussian(mean, covariance), limits)
        look = filters.Look(y, mask, jnp.broadcast_to(hand.observation_std(), y.shape))
        inputs = jnp.ones(len(y)).at[0].set(0.0)
        _, beliefs = jaxfilters.run(
            filter, jax.random.key(0), look, inputs, collect=lambda state, info: filters.belief_of(state)
        )
        return beliefs.mean, jnp.sqrt(jnp.diagonal(beliefs.covariance, axis1=1, axis2=2))

    means, deviations = map(np.asarray, follow(mean, covariance, y, mask))
    errors = means - np.asarray(states)
    np.testing.assert_allclose(errors[:, ~free], 0, atol=1e-3)
    lengths = errors[:, LAYOUT.lengths]
    assert np.abs(lengths[0]).max() > 3  # the start is wrong by up to 10 pixels
    assert np.abs(lengths[-1]).max() < 2
    assert np.all(np.abs(lengths[-1]) <= 2 * deviations[-1, LAYOUT.lengths])
    angles = np.rad2deg(np.abs(errors[-15:, LAYOUT.angles]))
    assert np.median(angles) < 2
    assert angles.max() < 15
