"""The 22-number hand: pose on a manifold, geometry with a size, joints and capsules by forward kinematics.

Source: Kajihara and Tanaka, "A method for 3D hand pose tracking using a Rao-Blackwellized particle filter",
appendix A.1, with lengths of an average adult. Pose entries:

    0:3    wrist position in the camera frame, metres (x right, y down, z forward)
    3:7    wrist rotation quaternion (w, x, y, z), camera from palm
    7      thumb CMC flexion                      8, 9     thumb MCP flexion, thumb MCP spread
    10:13  index MCP flexion, spread, PIP flexion     then middle 13:16, ring 16:19, little 19:22 alike

Coupling: DIP = PIP / 2, thumb IP = thumb MCP flexion / 2. At identity rotation the palm faces the camera: +x of the
palm points to the thumb side of a right hand, +y to the forearm, +z to the back of the hand. Positive flexion
brings a tip towards the palm side (-z), positive spread towards the thumb side. Angles mean the same for a left hand.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math.lie import quaternion_normalize, quaternion_to_matrix, so3_local, so3_retract
from jaxfilters.models.rendering.geometry import Capsules

POSE_SIZE = 22
TANGENT_SIZE = 21
DIGITS = ("thumb", "index", "middle", "ring", "little")

JOINT_NAMES = ("wrist", *(f"{digit}_{number}" for digit in DIGITS for number in range(1, 5)))
"""Order of `HandKinematics.joints`: the wrist, then each digit from its base to its tip."""

PART_NAMES = (
    *(f"{digit}_phalanx_{number}" for digit in DIGITS for number in range(1, 4)),
    *(f"{digit}_metacarpal" for digit in DIGITS[1:]),
)
"""Order of the 19 capsules and rigid parts: phalanges digit by digit from the base out, then metacarpals."""

_FINGER_LIMITS = ((-10, 90), (-20, 20), (0, 105))
ANGLE_LIMITS = np.deg2rad([(-20, 60), (-5, 55), (-30, 30), *(_FINGER_LIMITS * 4)])
"""Lowest and highest value of the 15 angles, radians, (15, 2)."""


# Field shapes are those of one hand; under `vmap` the leaves carry one axis more, so they are not checked at run time.
@pytree_dataclass
class HandGeometry:
    """Sizes of one hand in metres, in the palm frame of a right hand; `side` mirrors it."""

    bases: Float[Array, "5 3"]
    """First joint of each digit (thumb CMC, finger MCP)."""
    lengths: Float[Array, "5 3"]
    """Phalanx lengths from the base out, positive."""
    radii: Float[Array, "5 3"]
    """Capsule radii of the phalanges, positive."""
    metacarpal_starts: Float[Array, "4 3"]
    """Wrist ends of the metacarpals of the four fingers; they end at the finger bases."""
    metacarpal_radius: Float[Array, ""]
    thumb_frame: Float[Array, " 4"]
    """Unit quaternion, palm from thumb: the thumb's frame at zero angles."""
    side: Float[Array, ""]
    """+1 for a right hand, -1 for a left hand: the factor on x of everything in the palm frame."""
    tip_reach: Float[Array, ""]
    """Where the joint called tip lies beyond the end of the last capsule's axis, as a share of its radius: 0 is the
    middle of the rounded end, as in the paper, 1 is the skin, as in recordings with marked joints."""

    def scaled(self, scale: float | Float[Array, ""]) -> "HandGeometry":
        """The same hand with every length multiplied by `scale` (may be traced; 1 = as it is)."""
        return replace(
            self,
            bases=self.bases * scale,
            lengths=self.lengths * scale,
            radii=self.radii * scale,
            metacarpal_starts=self.metacarpal_starts * scale,
            metacarpal_radius=self.metacarpal_radius * scale,
        )


@pytree_dataclass
class HandKinematics:
    """A posed hand in the camera frame, metres."""

    joints: Float[Array, "21 3"]
    """In the order of `JOINT_NAMES`."""
    capsules: Capsules
    """The 19 capsules in the order of `PART_NAMES`."""


@jax.jit
def hand_geometry() -> HandGeometry:
    """The average adult right hand: 190 mm from the wrist to the middle fingertip."""
    millimetre = 1e-3
    bases = [(22, -22, -8), (24, -92, 0), (3, -95, 0), (-17, -88, 0), (-35, -78, 0)]
    lengths = [(46, 32, 27), (42, 24, 20), (46, 28, 21), (42, 27, 21), (33, 20, 19)]
    radii = [(14, 10.5, 9), (9.5, 8.5, 7.5), (9.5, 8.5, 7.5), (9, 8, 7), (8, 7, 6)]
    metacarpal_starts = [(12, -14, 0), (4, -14, 0), (-5, -14, 0), (-13, -14, 0)]
    return HandGeometry(
        bases=jnp.array(bases, dtype=float) * millimetre,
        lengths=jnp.array(lengths, dtype=float) * millimetre,
        radii=jnp.array(radii, dtype=float) * millimetre,
        metacarpal_starts=jnp.array(metacarpal_starts, dtype=float) * millimetre,
        metacarpal_radius=jnp.array(13 * millimetre, dtype=float),
        thumb_frame=jnp.array(_thumb_frame(), dtype=float),
        side=jnp.array(1.0, dtype=float),
        tip_reach=jnp.array(0.0, dtype=float),
    )


@jax.jit
def anatomical_hand() -> HandGeometry:
    """The average adult right hand with bones of measured lengths, whose tips are on the skin.

    Bones of `hand_geometry` are as long as measured ones with the soft tissue of the tip, to which the round end of the
    capsule then adds a second time. Here the lengths of all bones, and the soft tissue beyond the last one, are the
    means of 66 adults (A. Buryanov and V. Kotiuk, "Proportions of hand segments", Int. J. Morphol. 28 (3), 2010). The
    knuckles of index and little finger lie 4.5 mm nearer the palm than the two between them, by the transverse arch.
    """
    published, millimetre = hand_geometry(), 1e-3
    bones = [
        (46.22, 31.57, 21.67 + 3.92),
        (39.78, 22.38, 15.82 + 3.84),
        (44.63, 26.33, 17.40 + 3.95),
        (41.37, 25.65, 17.30 + 3.95),
        (32.74, 18.11, 15.96 + 3.73),
    ]
    arch = jnp.array([0.0, -2.25, 2.25, 2.25, -2.25], dtype=float) * millimetre
    lengths = jnp.array(bones, dtype=float) * millimetre
    return replace(
        published,
        bases=published.bases.at[:, 2].add(arch),
        lengths=lengths.at[:, 2].add(-published.radii[:, 2]),
        tip_reach=jnp.array(1.0, dtype=float),
    )


def mirrored(geometry: HandGeometry) -> HandGeometry:
    """The hand of the other side: x of all offsets mirrored, spread angles and the thumb's frame with it."""
    return replace(geometry, side=-geometry.side)


def check_geometry(geometry: HandGeometry) -> None:
    """Raise `ValueError` for a (concrete) geometry with wrong shapes or non-positive lengths or radii."""
    shapes = {"bases": (5, 3), "lengths": (5, 3), "radii": (5, 3), "metacarpal_starts": (4, 3), "thumb_frame": (4,)}
    for name, shape in shapes.items():
        if jnp.shape(getattr(geometry, name)) != shape:
            raise ValueError(f"geometry.{name} must be {shape}; got {jnp.shape(getattr(geometry, name))}.")
    for name in ("lengths", "radii", "metacarpal_radius"):
        smallest = float(jnp.min(getattr(geometry, name)))
        if not smallest > 0:
            raise ValueError(f"geometry.{name} must be positive (metres); its smallest entry is {smallest}.")


@jax.jit
def open_palm(position: Float[Array, " 3"]) -> Float[Array, " 22"]:
    """The pose (22,) with the palm to the camera, fingers up and straight, wrist at `position` (metres)."""
    quaternion_and_angles = jnp.zeros(POSE_SIZE - 3, dtype=position.dtype).at[0].set(1.0)
    return jnp.concatenate([position, quaternion_and_angles])


def retract(pose: Float[Array, " 22"], delta: Float[Array, " 21"]) -> Float[Array, " 22"]:
    """The pose moved by a tangent vector: 3 position, 3 rotation (body frame, q * exp), 15 angles."""
    return jnp.concatenate([pose[:3] + delta[:3], so3_retract(pose[3:7], delta[3:6]), pose[7:] + delta[6:]])


def local(pose: Float[Array, " 22"], other: Float[Array, " 22"]) -> Float[Array, " 21"]:
    """Tangent vector that leads from `pose` to `other`: the inverse of `retract` in its second argument."""
    return jnp.concatenate([other[:3] - pose[:3], so3_local(pose[3:7], other[3:7]), other[7:] - pose[7:]])


@jax.jit
def hand_center(pose: Float[Array, " 22"], scale: float | Float[Array, ""] = 1.0) -> Float[Array, " 3"]:
    """A point (metres, camera frame) in the middle of the open hand, 90 mm from the wrist: where to look for the hand.

    A window centred on the wrist itself would cut the fingers.
    """
    rotation = quaternion_to_matrix(quaternion_normalize(pose[3:7]))
    return pose[:3] - 0.09 * scale * rotation[:, 1]


def forward_kinematics(pose: Float[Array, " 22"], geometry: HandGeometry) -> HandKinematics:
    """Joints and capsules of one hand in the camera frame; the quaternion is normalised here.

    The rotations after a digit's first are about one axis, so every phalanx direction is closed-form in sums of
    flexion angles. Written by components: a batch of 3x3 products vectorises badly over an ensemble.
    """
    digits = _digit_points(pose[7:], geometry)
    starts = tuple(geometry.metacarpal_starts[:, i] for i in range(3))
    palm_points = [jnp.concatenate([d.reshape(20), s]) for d, s in zip(digits, starts, strict=True)]
    palm_points[0] = palm_points[0] * geometry.side
    rotation = quaternion_to_matrix(quaternion_normalize(pose[3:7]))
    camera_points = jnp.stack([pose[i] + sum(rotation[i, j] * palm_points[j] for j in range(3)) for i in range(3)], -1)
    return _assemble(pose[:3], camera_points, geometry)


def _assemble(wrist, points, geometry) -> HandKinematics:
    """Joints and capsules from the wrist and 24 points: 4 of each of the 5 digits, 4 metacarpal starts."""
    chains = points[:20].reshape(5, 4, 3)
    reach = geometry.tip_reach * geometry.radii[:, 2] / geometry.lengths[:, 2]
    tips = chains[:, 3] + reach[:, None] * (chains[:, 3] - chains[:, 2])
    joints = jnp.concatenate([chains[:, :3], tips[:, None]], axis=1).reshape(20, 3)
    capsules = Capsules(
        start=jnp.concatenate([chains[:, :3].reshape(15, 3), points[20:]]),
        end=jnp.concatenate([chains[:, 1:].reshape(15, 3), chains[1:, 0]]),
        radius=jnp.concatenate([geometry.radii.reshape(15), jnp.broadcast_to(geometry.metacarpal_radius, (4,))]),
    )
    return HandKinematics(joints=jnp.concatenate([wrist[None], joints]), capsules=capsules)


def phalanx_angles(angles: Float[Array, " 15"]) -> tuple[Float[Array, "5 3"], Float[Array, "5 3"]]:
    """Total flexion and spread of every phalanx (rows thumb to little, columns from the base out), radians.

    Each phalanx is turned by R_z(spread) R_x(flexion) against the palm; those of the thumb against its metacarpal,
    which the CMC angle turns. Here and only here are the last joints coupled to the ones before them.
    """
    _, thumb_flexion, thumb_spread = angles[:3]
    flexion, spread, pip = angles[3:].reshape(4, 3).T
    thumb_row = jnp.stack([jnp.zeros_like(thumb_flexion), thumb_flexion, 1.5 * thumb_flexion])
    finger_rows = jnp.stack([flexion, flexion + pip, flexion + 1.5 * pip], axis=1)
    thumb_spreads = jnp.stack([jnp.zeros_like(thumb_spread), thumb_spread, thumb_spread])
    finger_spreads = jnp.stack([spread, spread, spread], axis=1)
    return jnp.concatenate([thumb_row[None], finger_rows]), jnp.concatenate([thumb_spreads[None], finger_spreads])


def _digit_points(angles, geometry):
    """x, y and z (each (5, 4)) of every digit's joints from base to tip, right-hand palm frame."""
    flexion, spread = phalanx_angles(angles)
    cos_flexion = jnp.cos(flexion)
    directions = jnp.sin(spread) * cos_flexion, -jnp.cos(spread) * cos_flexion, -jnp.sin(flexion)
    thumb = _thumb_to_palm(angles[0], geometry.thumb_frame, *(d[0] for d in directions))
    points = []
    for axis in range(3):
        steps = geometry.lengths * jnp.concatenate([thumb[axis][None], directions[axis][1:]])
        chain = [geometry.bases[:, axis]]
        for k in range(3):
            chain.append(chain[-1] + steps[:, k])
        points.append(jnp.stack(chain, axis=1))
    return points


def _thumb_to_palm(cmc, thumb_frame, x, y, z):
    """Components in the palm frame of vectors given in the frame of the thumb's metacarpal."""
    frame = quaternion_to_matrix(thumb_frame)
    sin, cos = jnp.sin(cmc), jnp.cos(cmc)
    y, z = cos * y - sin * z, sin * y + cos * z
    return [frame[i, 0] * x + frame[i, 1] * y + frame[i, 2] * z for i in range(3)]


def _thumb_frame() -> np.ndarray:
    """Quaternion of R_z(45 deg) R_x(20 deg) R_y(60 deg)."""
    (cz, cx, cy), (sz, sx, sy) = (f(np.deg2rad([45.0, 20.0, 60.0]) / 2) for f in (np.cos, np.sin))
    w, x, y, z = cz * cx, cz * sx, sz * sx, sz * cx
    return np.array([w * cy - y * sy, x * cy - z * sy, w * sy + y * cy, z * cy + x * sy])
