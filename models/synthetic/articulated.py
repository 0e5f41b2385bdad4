"""Articulated hands with known truth: the paper's sequence, its critical pose, a held pose, a single link.

Source: Shimada et al., tables 1 and 2, figures 2, 3 and 8 to 16; motions that satisfy table 1, where the paper prints
none, are of this library. Frame n is at time n.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters.math.lie import quaternion_multiply, so3_exp
from jaxfilters.models.articulated.features import FULL, PAPER_EXPERIMENT, FeatureSet
from jaxfilters.models.articulated.hand import ArticulatedHand, articulated_hand
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.typing import AnyKey

NUM_FRAMES = 55
CRITICAL_FRAME = 18
"""Of `simulate_critical`: here the last link of the first finger lies in the image plane."""
LAYOUT = Layout(2)
PALM_TO_CAMERA = (0.5, -0.5, 0.5, -0.5)
"""Quaternion of the palm facing the camera with the fingers up in the image."""
SHAPES = {
    1: (62.0, 42.0, 35.0, 60.0, 40.0, 33.0, 60.0, 80.0, 20.0),
    2: (66.0, 46.0, 40.0, 64.0, 44.0, 38.0, 70.0, 80.0, 20.0),
}
"""True lengths and palm of the two hands, pixels at scale 1."""
INITIAL_SHAPE = (70.0, 36.0, 45.0, 56.0, 50.0, 43.0, 65.0, 75.0, 15.0)
"""What is believed of either hand at the start."""
ROTATION_ERROR, ROTATION_STD = math.radians(8.0), math.radians(15.0)
"""About each axis: of the rotation believed at the start, and of the belief in it."""
RATE_STD = (4.0, 0.03, math.radians(4.0))
"""Of the belief in the rates of wrist (pixels), quaternion and angles at the start, per frame."""


class StartErrors(NamedTuple):
    """How wrong the belief at the start is, by a fixed amount of random sign, and how wrong it thinks it is."""

    wrist: float
    """Pixels."""
    wrist_variance: float
    length: float
    """Pixels."""
    length_variance: float
    thickness_variance: float
    angle: float
    """Radians."""
    angle_variance: float


TABLE_2 = StartErrors(5.0, 50.0, 10.0, 800.0, 100.0, math.radians(15.0), math.radians(40.0) ** 2)
NEARLY_RIGHT = StartErrors(5.0, 50.0, 4.0, 16.0, 16.0, math.radians(6.0), math.radians(6.0) ** 2)
"""Lengths within 4 pixels, angles within 6 degrees; the deviations believed are these amounts."""


class ArticulatedSequence(NamedTuple):
    """A hand in motion, what a camera measures of it, and what is believed before the first frame."""

    states: Float[Array, "frames n"]
    """Truth; the rates are derivatives at the frame."""
    features: Float[Array, "frames rows"]
    """Measured, in the order of `hand.feature_names`."""
    masks: Bool[Array, "frames rows"]
    """False where a line was too short to be detected."""
    noise_std: Float[Array, " rows"]
    initial_mean: Float[Array, " n"]
    initial_covariance: Float[Array, "n n"]
    """Singular: the scale is known to be 1, which fixes the unit of length."""


def paper_hand(features: FeatureSet = FULL) -> ArticulatedHand:
    """The model of two fingers with the noise of the synthetic sequences."""
    return articulated_hand(LAYOUT, features=features)


def paper_states(shape: int = 1, num_frames: int = NUM_FRAMES) -> Float[Array, "{num_frames} 37"]:
    """Truth of figures 10 to 16 for one of the `SHAPES`; it satisfies table 1 at every frame.

    Raises:
        ValueError: if `shape` is not one of `SHAPES`, or `num_frames` < 1.
    """
    return _states(_paper_pose, shape, num_frames)


def critical_states(num_frames: int = 2 * CRITICAL_FRAME + 1) -> Float[Array, "{num_frames} 37"]:
    """Truth of figures 8 and 9: the palm tilted by 60 degrees, first shape; fingers bend through the critical pose.

    Raises:
        ValueError: if `num_frames` < 1.
    """
    return _states(_critical_pose, 1, num_frames)


def held_states(shape: int = 1, num_frames: int = 500, frame: int = 0) -> Float[Array, "{num_frames} 37"]:
    """Truth of a hand that stays in the pose of one frame of `paper_states`, at scale 1.

    Raises:
        ValueError: if `shape` is not one of `SHAPES`, `num_frames` < 1 or `frame` < 0.
    """
    if frame < 0 or num_frames < 1:
        raise ValueError(f"frame must be 0 or more and num_frames 1 or more; got {frame} and {num_frames}.")
    x = paper_states(shape, frame + 1)[-1].at[LAYOUT.rates].set(0.0)
    q = x[LAYOUT.quaternion]
    x = x.at[LAYOUT.quaternion].set(q / jnp.linalg.norm(q))
    return jnp.broadcast_to(x, (num_frames, LAYOUT.size))


@compiled_fully
def record(
    key: AnyKey, states: Float[Array, "frames n"], hand: ArticulatedHand
) -> tuple[Float[Array, "frames rows"], Bool[Array, "frames rows"]]:
    """Features of a hand in these states with Gaussian noise, and their masks: lines too short are not detected."""
    exact = jax.vmap(hand.observe)(states)
    noise = hand.observation_std().astype(exact.dtype) * jax.random.normal(key, exact.shape, exact.dtype)
    return exact + noise, jax.vmap(hand.usable)(states)


@partial(compiled_fully, static_argnames=("errors", "shape"))
def initial_belief(
    key: AnyKey,
    x: Float[Array, " 37"],
    *,
    errors: StartErrors = TABLE_2,
    shape: tuple[float, ...] | None = None,
) -> tuple[Float[Array, " 37"], Float[Array, "37 37"]]:
    """Mean and covariance of what is believed at the start about a hand in state `x` with scale 1.

    Wrist, angles and lengths are off by the amounts in `errors` with random signs, the rotation by a Gaussian rotation
    vector, the rates are believed to be zero. The variance of the scale is zero (table 2).

    Args:
        key: Random key.
        x: Truth.
        errors: Amounts and variances.
        shape: Lengths and palm that are believed instead of wrong ones; the variances stay.
    """
    sign_key, rotation_key = jax.random.split(key)
    layout, dtype = LAYOUT, x.dtype
    sizes = np.array([layout.position_size, layout.angles.stop - layout.angles.start, layout.num_static])
    amounts = jnp.asarray(np.repeat([errors.wrist, errors.angle, errors.length], sizes), dtype)
    off = amounts * jax.random.rademacher(sign_key, (int(sizes.sum()),), dtype)
    wrist_off, angles_off, shape_off = jnp.split(off, np.cumsum(sizes)[:-1])
    turned = so3_exp(ROTATION_ERROR * jax.random.normal(rotation_key, (3,), dtype))
    q = quaternion_multiply(turned, x[layout.quaternion] / jnp.linalg.norm(x[layout.quaternion]))
    mean = jnp.zeros_like(x).at[layout.position].set(x[layout.position] + wrist_off)
    mean = mean.at[layout.quaternion].set(q).at[layout.angles].set(x[layout.angles] + angles_off)
    believed = x[layout.static] + shape_off if shape is None else jnp.asarray(shape, dtype)
    return mean.at[layout.static].set(believed), _initial_covariance(q, errors)


@jax.jit
def drawn_belief(key: AnyKey, x: Float[Array, " 37"]) -> tuple[Float[Array, " 37"], Float[Array, "37 37"]]:
    """Mean and covariance at the start that belong together: the mean is off by a sample of the covariance.

    The variances are those of table 2; the rates are believed to be zero.

    Args:
        key: Random key.
        x: Truth.
    """
    key, rotation_key = jax.random.split(key)
    layout, dtype = LAYOUT, x.dtype
    q = x[layout.quaternion] / jnp.linalg.norm(x[layout.quaternion])
    turned = so3_exp(ROTATION_STD * jax.random.normal(rotation_key, (3,), dtype))
    q = quaternion_multiply(turned, q)
    covariance = _initial_covariance(q, TABLE_2)
    off = jnp.sqrt(jnp.diag(covariance)) * jax.random.normal(key, x.shape, dtype)
    mean = jnp.zeros_like(x).at[layout.quaternion].set(q)
    for part in (layout.position, layout.angles, layout.static):
        mean = mean.at[part].set((x + off)[part])
    return mean, covariance


def simulate_paper(key: AnyKey, shape: int = 1, *, num_frames: int = NUM_FRAMES) -> ArticulatedSequence:
    """The paper's sequence of one of the `SHAPES` with all features; the same lengths are believed of either.

    Raises:
        ValueError: if `shape` is not one of `SHAPES`, or `num_frames` < 1.
    """
    return _simulate(key, paper_states(shape, num_frames), FULL, _wrong_lengths)


def simulate_drawn(key: AnyKey, shape: int = 1, *, num_frames: int = NUM_FRAMES) -> ArticulatedSequence:
    """The paper's sequence of one of the `SHAPES`, begun at a sample of what is believed: see `drawn_belief`.

    Raises:
        ValueError: as `simulate_paper`.
    """
    return _simulate(key, paper_states(shape, num_frames), FULL, drawn_belief)


def simulate_held(key: AnyKey, shape: int = 1, *, num_frames: int = 500, frame: int = 0) -> ArticulatedSequence:
    """The same pose repeated: nothing new is in it after the first frames; the start is that of `simulate_paper`.

    Raises:
        ValueError: as `held_states`.
    """
    return _simulate(key, held_states(shape, num_frames, frame), FULL, _wrong_lengths)


def simulate_critical(key: AnyKey, *, num_frames: int = 2 * CRITICAL_FRAME + 1) -> ArticulatedSequence:
    """The critical pose of figures 8 and 9, observed as axes, tips, outline and wrist; the start is nearly right.

    Raises:
        ValueError: if `num_frames` < 1.
    """
    return _simulate(key, critical_states(num_frames), PAPER_EXPERIMENT, partial(initial_belief, errors=NEARLY_RIGHT))


class OneLink(NamedTuple):
    """A link of length r at an angle theta to the image plane, measured by the length of its image, `r cos(theta)`."""

    mean: Float[Array, " 2"]
    """Of (r, theta): pixels, radians."""
    covariance: Float[Array, "2 2"]
    y: Float[Array, " 1"]
    """Pixels."""
    noise_std: Float[Array, " 1"]
    lower: Float[Array, " 2"]
    """Of r and theta, -inf where there is no bound."""
    upper: Float[Array, " 2"]


def one_link(longest: float = math.inf) -> OneLink:
    """Figures 2 and 3: length and angle both unknown, the angle in [0, 90] degrees, and `r <= longest` pixels."""
    return OneLink(
        mean=jnp.array([60.0, math.radians(45.0)]),
        covariance=jnp.diag(jnp.array([20.0, math.radians(40.0)]) ** 2),
        y=jnp.array([40.0]),
        noise_std=jnp.array([0.5]),
        lower=jnp.array([-jnp.inf, 0.0]),
        upper=jnp.array([longest, math.radians(90.0)]),
    )


def one_link_near_image_plane() -> OneLink:
    """A link of known length 35 pixels at 20 degrees to the image plane, believed to be at 2 +- 15: two solutions."""
    return OneLink(
        mean=jnp.array([35.0, math.radians(2.0)]),
        covariance=jnp.diag(jnp.array([0.0, math.radians(15.0)]) ** 2),
        y=jnp.array([35.0 * math.cos(math.radians(20.0))]),
        noise_std=jnp.array([0.3]),
        lower=jnp.full(2, -jnp.inf),
        upper=jnp.full(2, jnp.inf),
    )


def one_link_length(x: Float[Array, " 2"]) -> Float[Array, " 1"]:
    """Length of the link's image, pixels."""
    return (x[0] * jnp.cos(x[1]))[None]


def _simulate(key, states, features, believed):
    """A recording of these states, begun at what is `believed` of the first of them."""
    record_key, belief_key = jax.random.split(key)
    hand = paper_hand(features)
    measured, masks = record(record_key, states, hand)
    return ArticulatedSequence(states, measured, masks, hand.observation_std(), *believed(belief_key, states[0]))


_wrong_lengths = partial(initial_belief, shape=INITIAL_SHAPE)


def _initial_covariance(q, errors):
    layout = LAYOUT
    variances = jnp.concatenate(
        [
            layout.per_moving(errors.wrist_variance, 0.0, errors.angle_variance),
            layout.per_moving(*RATE_STD) ** 2,
            jnp.full(layout.num_static - 1, errors.length_variance),
            jnp.array([errors.thickness_variance]),
        ]
    ).astype(q.dtype)
    # A small rotation moves a unit quaternion by half its angle, across itself; along itself would be the scale.
    across = jnp.eye(4, dtype=q.dtype) - jnp.outer(q, q)
    quaternion = layout.quaternion
    return jnp.diag(variances).at[quaternion, quaternion].set((0.5 * ROTATION_STD) ** 2 * across)


def _states(pose, shape, num_frames):
    if shape not in SHAPES:
        raise ValueError(f"shape must be one of {', '.join(map(str, SHAPES))}; got {shape}.")
    if num_frames < 1:
        raise ValueError(f"num_frames must be 1 or more; got {num_frames}.")
    return _motion(pose, SHAPES[shape], num_frames)


@partial(jax.jit, static_argnames=("pose", "shape", "num_frames"))
def _motion(pose, shape, num_frames):
    frames = jnp.arange(num_frames, dtype=float)
    moving, rates = jax.vmap(lambda n: jax.jvp(pose, (n,), (jnp.ones_like(n),)))(frames)
    static = jnp.broadcast_to(jnp.array(shape), (num_frames, LAYOUT.num_static))
    return jnp.concatenate([moving, rates, static], axis=1)


def _paper_pose(n):
    def wave(amplitude, period, phase=0.0, of=jnp.sin):
        return amplitude * of(2 * jnp.pi * n / period + phase)

    wrist = [wave(20, 50), 90 + wave(15, 37)]
    rotation = [wave(22, 45), wave(28, 33, 0.4), wave(15, 60)]
    scale = 1 + wave(0.12, 55)
    first_bend = 30 - wave(25, 29, of=jnp.cos)
    second_bend = 32 - wave(24, 29, -0.3, of=jnp.cos)
    first = [-10 + wave(6, 40), 35 - wave(30, 36, of=jnp.cos), first_bend, first_bend + wave(5, 23)]
    second = [10 + wave(6, 44), 38 - wave(28, 36, -0.35, of=jnp.cos), second_bend, second_bend - wave(5, 25)]
    return _pose(wrist, rotation, scale, first + second)


def _critical_pose(n):
    bend = 25 + 21 * jnp.sin(2 * jnp.pi * (n - CRITICAL_FRAME) / 36)
    zero = jnp.zeros_like(n)
    wrist, rotation = [zero, 90 + zero], [-60 + zero, zero, zero]
    return _pose(wrist, rotation, 1 + zero, [-8 + zero, 10 + zero, bend, bend, 8 + zero, 15 + zero, bend, bend])


def _pose(wrist, rotation, scale, angles):
    """The moving entries of a state from the wrist (pixels), a rotation vector and angles (degrees)."""
    turned = so3_exp(jnp.deg2rad(jnp.stack(rotation)))
    q = jnp.sqrt(scale) * quaternion_multiply(turned, jnp.array(PALM_TO_CAMERA, turned.dtype))
    return jnp.concatenate([jnp.stack(wrist), q, jnp.deg2rad(jnp.stack(angles))])
