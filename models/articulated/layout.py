"""What the entries of an articulated hand's state mean, and how they move with constant velocity.

Source: N. Shimada, Y. Shirai, Y. Kuno, J. Miura, "Shape and Pose Estimation of An Articulated Object from A Monocular
Image Sequence Based on Loose Constraints", Osaka University, c. 1997; equation numbers in brackets are its. The state
[5] of F fingers has the blocks

    position       wrist: 2 image coordinates in pixels, or 3 coordinates in metres
    quaternion     camera from palm, (w, x, y, z), unnormalised
    angles         finger by finger: abduction, then three flexions from the base out, radians
    (rates)        of position, quaternion and angles, the same order, per frame
    lengths        finger by finger, three links from the base out; pixels at scale 1, or metres
    palm           width, height, thickness in the unit of the lengths
    (errors)       of the measured rows, where these last from frame to frame; none unless a model has them

so that m = position + 4 + 4 F entries move, as many are rates, and 3 F + 3 are constant. Palm frame: origin at the
wrist, x to the fingers, y out of the palm's inner side, z = x cross y across the palm; fingers bend from x towards y.
With the palm to the camera and the fingers up, z points to the right of the image: the thumb's side of a right hand.
"""

import dataclasses
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

LINKS = 3
"""Links of a finger."""
PALM_NAMES = ("r_w", "r_h", "r_d")
"""Width, height, thickness."""


@dataclass(frozen=True)
class Layout:
    """Where everything is in the state of a hand with `num_fingers` fingers, and where the fingers grow.

    Hashable: a static argument. Fingers and links are counted from 0 in arguments and from 1 in names.

    Raises:
        ValueError: if there is no finger, `position_size` is not 2 or 3, or `bases` or `frames` are not finite numbers,
            one pair or triple a finger.
    """

    num_fingers: int
    position_size: int = 2
    """2 for weak perspective, 3 for full perspective."""
    bases: tuple[tuple[float, float], ...] | None = None
    """Of each finger: how far along the palm's height and across its width it begins, as shares of these; across is 0
    in the middle and 1/2 on the thumb's edge. `None`: at the end of the palm, evenly spread from the thumb's side."""
    frames: tuple[tuple[float, float, float], ...] | None = None
    """Rotation vectors, palm from finger, radians: how each finger's frame is turned at zero angles. `None`: not."""
    num_errors: int = 0
    """Of measured rows whose error lasts; see `jaxfilters.models.articulated.hand.with_lasting_errors`."""

    def __post_init__(self):
        """Refuse what is no hand."""
        if self.num_fingers < 1:
            raise ValueError(f"num_fingers must be 1 or more; got {self.num_fingers}.")
        if self.num_errors < 0:
            raise ValueError(f"num_errors must be 0 or more; got {self.num_errors}.")
        if self.position_size not in (2, 3):
            raise ValueError(f"position_size must be 2 (image) or 3 (space); got {self.position_size}.")
        for name, value, width in (("bases", self.bases, 2), ("frames", self.frames, 3)):
            if value is None:
                continue
            if np.shape(value) != (self.num_fingers, width) or not np.all(np.isfinite(value)):
                raise ValueError(
                    f"{name} must be {width} finite numbers for each of {self.num_fingers} fingers: {value}."
                )

    @property
    def num_moving(self) -> int:
        """Size m of position, quaternion and angles together."""
        return self.position_size + 4 + 4 * self.num_fingers

    @property
    def num_static(self) -> int:
        """Size n_s of lengths and palm together."""
        return LINKS * self.num_fingers + len(PALM_NAMES)

    @property
    def size(self) -> int:
        """Size of the state."""
        return 2 * self.num_moving + self.num_static + self.num_errors

    @property
    def body(self) -> "Layout":
        """The layout of the hand alone, without the errors of what is measured; states begin alike."""
        return dataclasses.replace(self, num_errors=0)

    @property
    def moving(self) -> slice:
        """Position, quaternion and angles."""
        return slice(0, self.num_moving)

    @property
    def rates(self) -> slice:
        """The rates of all that moves."""
        return slice(self.num_moving, 2 * self.num_moving)

    @property
    def static(self) -> slice:
        """Lengths and palm."""
        return slice(2 * self.num_moving, 2 * self.num_moving + self.num_static)

    @property
    def errors(self) -> slice:
        """Lasting errors of the measured rows."""
        return slice(self.static.stop, self.size)

    @property
    def position(self) -> slice:
        """Of the wrist."""
        return slice(0, self.position_size)

    @property
    def quaternion(self) -> slice:
        """Camera from palm."""
        return slice(self.position_size, self.position_size + 4)

    @property
    def angles(self) -> slice:
        """Abduction and flexions, finger by finger."""
        return slice(self.position_size + 4, self.num_moving)

    @property
    def quaternion_rate(self) -> slice:
        """Rate of the quaternion."""
        return slice(self.num_moving + self.position_size, self.num_moving + self.position_size + 4)

    @property
    def angle_rates(self) -> slice:
        """Rates of the angles."""
        return slice(self.num_moving + self.position_size + 4, 2 * self.num_moving)

    @property
    def lengths(self) -> slice:
        """Of the links, finger by finger."""
        return slice(self.static.start, self.static.stop - len(PALM_NAMES))

    @property
    def palm(self) -> slice:
        """Width, height, thickness."""
        return slice(self.static.stop - len(PALM_NAMES), self.static.stop)

    @property
    def names(self) -> tuple[str, ...]:
        """Of all entries: `wrist_x`, `q_w`, `theta_10`, `theta_10_rate`, `r_11`, `r_w`, `error_1` and so on."""
        fingers = range(1, self.num_fingers + 1)
        moving = [f"wrist_{axis}" for axis in "xyz"[: self.position_size]]
        moving += [f"q_{axis}" for axis in "wxyz"]
        moving += [f"theta_{finger}{joint}" for finger in fingers for joint in range(LINKS + 1)]
        lengths = [f"r_{finger}{link}" for finger in fingers for link in range(1, LINKS + 1)]
        errors = (f"error_{row + 1}" for row in range(self.num_errors))
        return (*moving, *(f"{name}_rate" for name in moving), *lengths, *PALM_NAMES, *errors)

    @property
    def base_shares(self) -> np.ndarray:
        """(F, 2): where the fingers begin, along the palm's height and across its width."""
        if self.bases is not None:
            return np.array(self.bases, dtype=float)
        across = 0.5 - (np.arange(self.num_fingers) + 0.5) / self.num_fingers
        return np.stack([np.ones(self.num_fingers), across], axis=1)

    @property
    def frame_matrices(self) -> np.ndarray:
        """(F, 3, 3): palm from finger at zero angles."""
        vectors = np.zeros((self.num_fingers, 3)) if self.frames is None else np.array(self.frames, dtype=float)
        return Rotation.from_rotvec(vectors).as_matrix()

    def angles_of(self, x: Float[Array, " n"]) -> Float[Array, "fingers 4"]:
        """Abduction and three flexions of each finger, radians."""
        return x[self.angles].reshape(self.num_fingers, LINKS + 1)

    def lengths_of(self, x: Float[Array, " n"]) -> Float[Array, "fingers 3"]:
        """Link lengths of each finger from the base out."""
        return x[self.lengths].reshape(self.num_fingers, LINKS)

    def flexion_index(self, finger: int | Int[Array, ""], link: int | Int[Array, ""]) -> int | Int[Array, ""]:
        """Where the state holds the angle of the joint before a link; finger and link from 0, traced or not."""
        return self.angles.start + (LINKS + 1) * finger + 1 + link

    def per_moving(self, position: float, quaternion: float, angle: float) -> Float[Array, " m"]:
        """One number each for position, quaternion and angles, spread over all that moves."""
        sizes = (self.position_size, 4, (LINKS + 1) * self.num_fingers)
        return jnp.asarray(np.repeat([position, quaternion, angle], sizes), dtype=float)


def five_fingers(position_size: int = 2, side: float = 1.0) -> Layout:
    """Thumb, index, middle, ring and little finger of a right (side +1) or left (side -1) hand.

    Places and the thumb's frame are those of the average hand of `jaxfilters.models.hand.skeleton`, with the palm's
    height up to the middle finger's base and a width of 80 mm.
    """
    height, width = 95.0, 80.0
    along = np.array([22.0, 92.0, 95.0, 88.0, 78.0]) / height
    across = side * np.array([22.0, 24.0, 3.0, -17.0, -35.0]) / width
    # The skeleton's axes are the thumb's side, the forearm, the back of the hand; a mirror turns two of three signs.
    x, y, z = Rotation.from_euler("ZXY", [45.0, 20.0, 60.0], degrees=True).as_rotvec()
    thumb = (float(-side * y), float(-side * z), float(x))
    rest = (0.0, 0.0, 0.0)
    bases = tuple((float(a), float(b)) for a, b in zip(along, across, strict=True))
    return Layout(5, position_size, bases, (thumb, rest, rest, rest, rest))


def transition_matrix(layout: Layout, dt: float | Float[Array, ""] = 1.0) -> Float[Array, "n n"]:
    """A of `x' = A x` [8]: what moves does so with its rate for `dt` frames, the rest stays."""
    driven = np.zeros((layout.size, layout.size))
    driven[layout.moving, layout.rates] = np.eye(layout.num_moving)
    return jnp.eye(layout.size) + dt * jnp.asarray(driven, dtype=float)


def white_acceleration_root(
    layout: Layout, std: Float[Array, " m"], dt: float | Float[Array, ""] = 1.0
) -> Float[Array, "n m"]:
    """G with `G G^T = U`, the process noise of accelerations that are constant within a frame and independent between.

    Args:
        layout: Of the state.
        std: Standard deviation of the acceleration of all that moves, per frame squared; not negative.
        dt: Frames.
    """
    static = jnp.zeros((layout.size - layout.static.start, layout.num_moving), std.dtype)
    return jnp.concatenate([jnp.diag(0.5 * dt**2 * std), jnp.diag(dt * std), static])
