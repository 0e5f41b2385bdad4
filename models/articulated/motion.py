"""How an articulated hand moves from one frame to the next: with constant velocity, or as hands do that move about.

Strategies with the same verbs. Frames are the unit of time; layouts are those of
`jaxfilters.models.articulated.layout`.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math.lie import quaternion_multiply, so3_exp
from jaxfilters.math.linalg import safe_norm, safe_sqrt
from jaxfilters.models.articulated.kinematics import turn, unit_rotation
from jaxfilters.models.articulated.layout import Layout, white_acceleration_root

FRAME_INTERVAL = 1 / 30
"""Seconds: what is called a frame here, whatever the camera's rate."""
MOVEMENT_TIME = 10.0
"""Frames: a third of a second, in which a movement of the hand runs down; a reach takes about twice that. One number
serves movements of any size: the duration of natural reaches hardly changes with their distance, their speed does
(M. Jeannerod, The timing of natural prehension movements, Journal of Motor Behavior 16, 1984, 235-254)."""
ANGLE_SPREAD = math.radians(20.0)
"""Standard deviation of a finger's angle about that at ease. Nine in ten postures of daily activities lie within 26, 32
and 27 degrees of the middle of their range, from the base of a finger out (G. I. Bain et al., The functional range of
motion of the finger joints, 2015): deviations of 16 to 19 degrees."""
SPEED = (0.08 / MOVEMENT_TIME, 0.5 * ANGLE_SPREAD / MOVEMENT_TIME, ANGLE_SPREAD / MOVEMENT_TIME)
"""Of wrist (metres), quaternion and angles (radians), per frame: a movement takes the wrist by a palm's width, and
turns palm and joints by the spread of an angle."""
LEAN_STD = 0.4
"""Of the sine of the angle between a hand's long axis and the image plane. Hands are held before cameras so that they
show: the root mean square of the sine is .44 in 17 recordings of hands before a depth camera, .50 with two in which
hands reach for it (D. Tzionas et al., Capturing hands in action using discriminative salient points and physics
simulation, IJCV 2016), and .58 where all rotations are alike. Chosen of .3, .4 and .5 on eight of these and the first
350 frames of ICVL and NYU. Without it a hand that faces the camera is taken for one that leans towards it, because
poses of which the image tells less have more room."""
REMEMBERED = 5.0
"""Times after which a push has run down."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)


@pytree_dataclass
class ConstantVelocity:
    """Everything moves on by its rate; accelerations are constant within a frame and independent between [6], [8]."""

    acceleration_std: Float[Array, " m"]
    """Of position, quaternion and angles, per frame squared, not negative."""

    def advance(self, x: Float[Array, " n"], layout: Layout, dt: Float[Array, ""] | float) -> Float[Array, " n"]:
        """The expected state `dt` frames later."""
        return x.at[layout.moving].add(dt * x[layout.rates])

    def noise_root(self, layout: Layout, dt: Float[Array, ""] | float) -> Float[Array, "n m"]:
        """A root of the covariance of what is added to it."""
        return white_acceleration_root(layout, self.acceleration_std, dt)


@pytree_dataclass
class AboutEase:
    """Rates die away, and angles return to those of a hand at ease; white accelerations keep both alive.

    With `a = 1 / time`, position and quaternion follow `p'' = -a p' + w`, angles `p'' = -2 a p' - a^2 (p - ease) + w`,
    solved exactly. What the image says nothing about comes to rest at the deviations of a hand of which nothing is
    known: `speed_std` of the rates and `time * speed_std` of the angles, however long a gap between frames is. With a
    correlation, the accelerations of the angles and with them the angles at rest have it.
    """

    ease: Float[Array, " angles"]
    """Angles of a hand at ease, radians."""
    speed_std: Float[Array, " m"]
    """Of the rates of position, quaternion and angles, per frame, not negative."""
    time: Float[Array, " m"]
    """Frames in which a rate of position, quaternion or angles falls to 1/e, positive."""
    lean_std: Float[Array, ""] | None = None
    """Standard deviation of the sine of the angle between the hand's long axis and the image plane, of a hand of which
    nothing is known; `None` where it points anywhere alike."""
    angle_root: Float[Array, "angles angles"] | None = None
    """Lower triangular root of the correlation of the angles of a hand of which nothing is known; `None` where each
    moves on its own."""

    def advance(self, x: Float[Array, " n"], layout: Layout, dt: Float[Array, ""] | float) -> Float[Array, " n"]:
        """The expected state `dt` frames later."""
        angles, rates = layout.angles, layout.angle_rates
        pose, pose_rates = _pose(layout)
        t = dt / self.time[pose]
        x = x.at[pose].add(-self.time[pose] * jnp.expm1(-t) * x[pose_rates]).at[pose_rates].multiply(jnp.exp(-t))
        if self.lean_std is not None:
            x = _turned_flat(x, layout, self._turning(layout) / self.lean_std**2 * dt)
        t = dt / self.time[angles]
        off, rate = x[angles] - self.ease, x[rates]
        x = x.at[angles].set(self.ease + jnp.exp(-t) * ((1 + t) * off + dt * rate))
        return x.at[rates].set(jnp.exp(-t) * ((1 - t) * rate - t / self.time[angles] * off))

    def noise_root(self, layout: Layout, dt: Float[Array, ""] | float) -> Float[Array, "n columns"]:
        """A root of the covariance of what is added to it: the noise of five moments, weighted as Gauss does.

        Its square is the integral over the frames, to one part in 10^5 for steps up to `time` and 2 % for any.
        """
        is_angle = np.arange(layout.num_moving) >= layout.angles.start
        dt = jnp.asarray(dt, self.speed_std.dtype)
        # What came earlier has left the rates and angles, and moved all else by as much as it ever will.
        recent = jnp.minimum(dt, REMEMBERED * self.time)
        push = self.speed_std * jnp.sqrt(np.where(is_angle, 4.0, 2.0) / self.time)
        nothing = jnp.zeros((layout.size - layout.static.start, layout.num_moving), push.dtype)
        together = jnp.eye(layout.num_moving, dtype=push.dtype)
        if self.angle_root is not None:
            together = together.at[layout.angles, layout.angles].set(self.angle_root)
        columns = []
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            since = 0.5 * (1 + float(node)) * recent
            kept = jnp.exp(-since / self.time)
            moved = jnp.where(is_angle, since * kept, -self.time * jnp.expm1(-since / self.time))
            rate = jnp.where(is_angle, (1 - since / self.time) * kept, kept)
            now = push * safe_sqrt(0.5 * float(weight) * recent)
            columns.append(
                jnp.concatenate([(now * moved)[:, None] * together, (now * rate)[:, None] * together, nothing])
            )
        before = jnp.where(is_angle, 0.0, push * self.time * safe_sqrt(dt - recent))
        columns.append(jnp.concatenate([jnp.diag(before), jnp.zeros_like(jnp.diag(before)), nothing]))
        return jnp.concatenate(columns, axis=1)

    def _turning(self, layout: Layout) -> Float[Array, ""]:
        """How fast the rotation diffuses, in squared radians per frame: a rate is twice that of the unit quaternion."""
        return jnp.mean(4 * self.speed_std[layout.quaternion] ** 2 * self.time[layout.quaternion])


def _turned_flat(x: Float[Array, " n"], layout: Layout, amount: Float[Array, ""]) -> Float[Array, " n"]:
    """The state with the hand's long axis turned towards the image plane.

    With the diffusion D of the rotation, a drift of D / lean_std^2 sin cos of the angle to the image plane has the
    density exp(-sin^2 / (2 lean_std^2)) of axes on the sphere in the long run: that of Watson, a girdle. The amount is
    D / lean_std^2 times the frames that have passed.
    """
    axis, sight = lean_axes(x, layout)
    turned = so3_exp(jnp.expm1(-amount) * jnp.sum(axis * sight) * jnp.cross(axis, sight))
    for block in (layout.quaternion, layout.quaternion_rate):
        x = x.at[block].set(quaternion_multiply(turned, x[block]))
    return x


def lean_axes(x: Float[Array, " n"], layout: Layout) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """Unit vectors of the hand's long axis and of the line of sight to its wrist, in the camera frame."""
    axis = turn(unit_rotation(x[layout.quaternion]), jnp.eye(3, dtype=x.dtype)[0])
    sight = x[layout.position] if layout.position_size == 3 else jnp.eye(3, dtype=x.dtype)[2]
    return axis, sight / safe_norm(sight)


Motion = ConstantVelocity | AboutEase


def about_ease(
    layout: Layout,
    ease: Float[Array | np.ndarray, " angles"],
    *,
    per_metre: float = 1.0,
    speed_std: tuple[float, float, float] = SPEED,
    time: float = MOVEMENT_TIME,
    lean_std: float | None = None,
    correlation: Float[Array | np.ndarray, "k k"] | None = None,
) -> AboutEase:
    """The motion of a hand about its angles at ease, with checked numbers.

    Args:
        layout: Of the state.
        ease: Angles of a hand at ease, radians.
        per_metre: Units of the position in a metre: 1 in space, pixels at the hand's distance in an image.
        speed_std: Of wrist (metres), quaternion and angles, per frame.
        time: Frames in which a rate falls to 1/e.
        lean_std: Of the sine of the angle between the hand's long axis and the image plane; `None` for any rotation.
        correlation: Of the angles; `None` where each moves on its own.

    Raises:
        ValueError: if the angles are not those of the layout, a number is not finite or has the wrong sign, or the
            correlation is not symmetric, positive definite and 1 on its diagonal.
    """
    expected = layout.angles.stop - layout.angles.start
    if np.shape(ease) != (expected,) or not np.all(np.isfinite(ease)):
        raise ValueError(f"ease must be {expected} finite angles (radians); got {ease}.")
    if len(speed_std) != 3 or not all(0 <= value < math.inf for value in speed_std):
        raise ValueError(f"speed_std must be three numbers, zero or more; got {speed_std}.")
    leans = () if lean_std is None else (("lean_std", lean_std),)
    for name, value in (("per_metre", per_metre), ("time", time), *leans):
        if not 0 < value < math.inf:
            raise ValueError(f"{name} must be positive; got {value}.")
    wrist, quaternion, angle = speed_std
    return AboutEase(
        ease=jnp.asarray(ease, dtype=float),
        speed_std=layout.per_moving(per_metre * wrist, quaternion, angle),
        time=layout.per_moving(time, time, time),
        lean_std=None if lean_std is None else jnp.asarray(lean_std, dtype=float),
        angle_root=None if correlation is None else jnp.asarray(_root_of(correlation, expected), dtype=float),
    )


def _root_of(correlation, size):
    """The Cholesky root of a correlation matrix (size, size)."""
    C = np.asarray(correlation, float)
    if C.shape != (size, size) or not np.allclose(C, C.T) or not np.allclose(np.diagonal(C), 1.0):
        raise ValueError(
            f"correlation must be symmetric ({size}, {size}) with ones on its diagonal; got {correlation}."
        )
    try:
        return np.linalg.cholesky(C)
    except np.linalg.LinAlgError as error:
        least = np.linalg.eigvalsh(C)[0]
        raise ValueError(f"correlation must be positive definite; its least eigenvalue is {least:.3g}.") from error


def _pose(layout):
    """Where position and quaternion are, and their rates."""
    size = layout.position_size + 4
    return slice(0, size), slice(layout.num_moving, layout.num_moving + size)
