"""The articulated hand as one model: how its state moves, what is visible of it, and with how much noise."""

from dataclasses import field, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.gauss_markov import GaussMarkov
from jaxfilters.math.linalg import matmul, safe_norm, safe_sqrt
from jaxfilters.models.articulated.features import (
    FULL,
    SHORTEST_LINK,
    FeatureSet,
    ImagedHand,
    Residual,
    palm_outline,
    undirected_residual,
)
from jaxfilters.models.articulated.kinematics import Pivot, finger_points, pivot_base, turn, unit_rotation
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.models.articulated.motion import ConstantVelocity, Motion
from jaxfilters.models.articulated.projection import Projection, WeakPerspective

Hand = TypeVar("Hand", bound="ArticulatedHand")
POINT_STD, ALPHA_STD, RHO_STD = 1.0, float(np.deg2rad(2.0)), 1.0
"""Pixels, radians, pixels."""


@pytree_dataclass
class ArticulatedHand:
    """Links observed by one camera, for any Gaussian filter; made by `articulated_hand`.

    `transition`, `process_noise`, `observe`, `observation_noise` and `residual` are what the filters take. Frames are
    the unit of time; the `inputs` of a step are the time since the last state in frames, `None` for one.
    """

    projection: Projection
    motion: Motion
    """How the state moves."""
    point_std: Float[Array, ""]
    """Noise of each coordinate of a point, pixels, positive."""
    alpha_std: Float[Array, ""]
    """Noise of a line's angle, radians, positive."""
    rho_std: Float[Array, ""]
    """Noise of a line's distance from the origin, pixels, positive."""
    origin: Float[Array, " 2"]
    """The pixel that distances of lines are measured from; near the hand, as a line's noise grows with its distance."""
    errors: GaussMarkov | None
    """Errors of the measured rows that last, in frames and in the units of the rows; `None` without."""
    layout: Layout = field(metadata=dict(static=True))
    features: FeatureSet = field(metadata=dict(static=True))
    pivot: Pivot = field(metadata=dict(static=True))
    """`pivot_base` or `pivot_wrist`."""
    compare: Residual = field(metadata=dict(static=True))
    """`undirected_residual` or `directed_residual`."""

    def transition(self, x: Float[Array, " n"], inputs: Float[Array, ""] | float | None = None) -> Float[Array, " n"]:
        """The expected state after a frame, or after `inputs` frames."""
        dt = 1.0 if inputs is None else inputs
        moved = self.motion.advance(x, self.layout, dt)
        if self.errors is not None:
            moved = moved.at[self.layout.errors].multiply(self.errors.decay(dt))
        return self.projection.settle(moved, self.layout)

    def process_noise(self, inputs: Float[Array, ""] | float | None = None) -> Float[Array, "n n"]:
        """Covariance of what accelerations add to a transition."""
        root = self.process_noise_root(inputs)
        return matmul(root, root.T)

    def process_noise_root(self, inputs: Float[Array, ""] | float | None = None) -> Float[Array, "n columns"]:
        """A root of `process_noise`."""
        dt = 1.0 if inputs is None else inputs
        root = self.motion.noise_root(self.layout, dt)
        if self.errors is None:
            return root
        added = jnp.diag(safe_sqrt(self.errors.added(dt)))
        pushed = jnp.zeros((self.layout.size, self.layout.num_errors), root.dtype).at[self.layout.errors].set(added)
        return jnp.concatenate([root, pushed], axis=1)

    def points(self, x: Float[Array, " n"]) -> Float[Array, "fingers 4 3"]:
        """Joints of every finger from base to tip in the camera frame: pixels from the wrist's depth, or metres."""
        points = finger_points(x, self.layout, pivot=self.pivot)
        return self.projection.camera_points(x, self.layout, points)

    def wrist(self, x: Float[Array, " n"]) -> Float[Array, " 3"]:
        """The wrist in the frame and unit of `points`."""
        return self.projection.camera_points(x, self.layout, jnp.zeros(3, x.dtype))

    def image_points(self, x: Float[Array, " n"]) -> Float[Array, "fingers 4 2"]:
        """Pixels of `points`."""
        return self.projection.image_points(self.points(x))

    def image(self, x: Float[Array, " n"]) -> ImagedHand:
        """Everything that a camera could measure of a hand in this state."""
        width, height, thickness = x[self.layout.palm]
        zero = jnp.zeros_like(height)
        corners = [(a * thickness, b * width) for a in (-0.5, 0.5) for b in (-0.5, 0.5)]
        # In perspective the palm's edges are not parallel: each is taken along the axis, through its middle.
        middles = [jnp.stack([0.5 * height, inward, across]) for inward, across in corners]
        center = jnp.stack([0.5 * height, zero, zero])
        palm = jnp.stack([jnp.zeros_like(center), center, 2 * center, *middles])
        palm = self.projection.camera_points(x, self.layout, palm)
        axis = turn(unit_rotation(x[self.layout.quaternion]), jnp.eye(3, dtype=x.dtype)[0])
        image = self.projection.image_points(palm)
        return ImagedHand(
            wrist=image[0],
            points=self.image_points(x),
            palm=palm_outline(self.projection.image_direction(palm[1], axis), image[3:] - self.origin),
            palm_length=safe_norm(image[2] - image[0]),
            origin=self.origin,
        )

    def observe(self, x: Float[Array, " n"]) -> Float[Array, " rows"]:
        """h(x) [7]: the chosen features of a hand in this state with their lasting errors, pixels and radians."""
        exact = self.exact_features(x)
        return exact if self.errors is None else exact + x[self.layout.errors]

    def exact_features(self, x: Float[Array, " n"]) -> Float[Array, " rows"]:
        """The chosen features of a hand in this state, pixels and radians."""
        return self.features.stack(self.image(x))

    def usable(self, x: Float[Array, " n"], shortest: float = SHORTEST_LINK) -> Bool[Array, " rows"]:
        """False for rows that are lines too short to have a direction in this state."""
        return self.features.usable(self.image(x), shortest)

    def residual(self, y: Float[Array, " rows"], y_hat: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """Observed minus predicted features, for lines the shorter way round."""
        return self.compare(y, y_hat, self.features, self.layout.num_fingers)

    def observation_std(self) -> Float[Array, " rows"]:
        """Standard deviations of the noise of the features."""
        return self.features.std(self.layout.num_fingers, self.point_std, self.alpha_std, self.rho_std)

    def observation_noise(self) -> Float[Array, "rows rows"]:
        """Covariance W [7] of the noise of the features."""
        return jnp.diag(self.observation_std() ** 2)

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Of the rows of `observe`."""
        return self.features.names(self.layout.num_fingers)


def articulated_hand(
    layout: Layout,
    *,
    projection: Projection | None = None,
    features: FeatureSet = FULL,
    pivot: Pivot = pivot_base,
    compare: Residual = undirected_residual,
    motion: Motion | None = None,
    point_std: float = POINT_STD,
    alpha_std: float = ALPHA_STD,
    rho_std: float = RHO_STD,
    origin: tuple[float, float] | None = None,
) -> ArticulatedHand:
    """The model with checked numbers; the defaults are weak perspective, motion and noise of Shimada et al.

    Args:
        layout: Of the state.
        projection: `WeakPerspective()` unless given.
        features: What is observed.
        pivot: What abduction turns a finger about.
        compare: How observed and predicted features are subtracted.
        motion: How the state moves; with constant velocity and the projection's accelerations unless given.
        point_std: Noise of a point's coordinates, pixels.
        alpha_std: Noise of a line's angle, radians.
        rho_std: Noise of a line's distance, pixels.
        origin: The pixel that distances of lines are measured from; the optical axis unless given.

    Raises:
        ValueError: if the layout is not one for the projection, or a number is not finite or has the wrong sign.
    """
    projection = WeakPerspective() if projection is None else projection
    center = projection.center() if origin is None else np.asarray(origin)
    if layout.position_size != projection.position_size:
        raise ValueError(
            f"layout.position_size must be {projection.position_size} for {type(projection).__name__}; "
            f"got {layout.position_size}."
        )
    for name, value in (("point_std", point_std), ("alpha_std", alpha_std), ("rho_std", rho_std)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive; got {value}.")
    if center.shape != (2,) or not np.all(np.isfinite(center)):
        raise ValueError(f"origin must be two finite numbers (pixels); got {origin}.")
    return ArticulatedHand(
        projection=projection,
        motion=ConstantVelocity(layout.per_moving(*projection.acceleration_std)) if motion is None else motion,
        point_std=jnp.asarray(point_std, dtype=float),
        alpha_std=jnp.asarray(alpha_std, dtype=float),
        rho_std=jnp.asarray(rho_std, dtype=float),
        origin=jnp.asarray(center, dtype=float),
        errors=None,
        layout=layout,
        features=features,
        pivot=pivot,
        compare=compare,
    )


def with_lasting_errors(hand: Hand, errors: GaussMarkov) -> Hand:
    """The hand with an error of each measured row in its state that lasts from frame to frame.

    A detector, a marker on the skin or a chain of hinges in place of a finger errs by the pose, which hardly changes
    from one frame to the next. Such errors are no fresh noise, and do not average out (A. E. Bryson and L. J.
    Henrikson, "Estimation using sampled data containing sequentially correlated noise", 1968). Limits and beliefs are
    those of the layout of the hand that is returned; a belief about the errors begins with their covariance.

    Args:
        hand: The hand, without such errors.
        errors: Independent errors of the rows of `observe`: variances (pixels and radians) and time constants (frames).

    Raises:
        ValueError: if there is not one variance for each row, or the hand has such errors already.
    """
    rows = jax.eval_shape(hand.observe, jnp.zeros(hand.layout.size)).shape
    if hand.errors is not None or errors.covariance.shape != rows:
        raise ValueError(f"errors must have {rows[0]} variances for a hand without; got {errors.covariance.shape}.")
    return replace(hand, errors=errors, layout=replace(hand.layout, num_errors=rows[0]))
