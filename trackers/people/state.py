"""The scene of the people tracker, its state from frame to frame, and its report."""

from dataclasses import field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, Num, UInt8

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.trackers.people.config import PeopleConfig as PeopleConfig

FREE, TENTATIVE, TRACKED, DORMANT = range(4)
MODE_NAMES = ("free", "tentative", "tracked", "dormant")
"""Slots: unused; a person who may be a mistake; a person; a person who was lost sight of and may come back."""
APPEARANCE = 128
"""Numbers that describe clothes: joint histograms of three colours in four steps, of the upper and the lower half."""
NUM_BIASES = 3
STATE = 6 + NUM_BIASES
"""X, Y, velocity along X and Y, height, width: metres and metres per second; normalised biases of the silhouette."""
HEIGHT, WIDTH = 4, 5
BIAS = slice(6, STATE)
PLACE = (0, 1, HEIGHT, WIDTH)
"""X, Y, height and width in a state: what one image shows."""
STRIDE = slice(4, 6)
"""After X, Y, height and width of a silhouette: from the middle to the front foot along X and Y, metres."""
DETECTABILITIES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
"""Possible factors on the probability that a person makes a pixel foreground (`detectability`)."""
DETECTABILITY_PRIOR = (0.0, -2.0, -2.0, -2.0, -2.0, -2.0)
"""Log weights of these without an image, up to a constant."""


@pytree_dataclass
class PeopleScene:
    """Cameras, furniture and floor: one entry a camera, in the order of the images."""

    cameras: tuple[FloorCamera, ...]
    furniture: tuple[Float[Array, "rows cols"], ...]
    """Depth of what stands in front of people, metres; `inf` where nothing does."""
    floor: Float[Array, "corners 2"]
    """Polygon in which people can walk, metres."""
    cells: "Cells"
    config: PeopleConfig = field(metadata=dict(static=True))

    def projections(self) -> Float[Array, "cameras 3 4"]:
        """The matrices of the cameras."""
        return jnp.stack([camera.P for camera in self.cameras])

    def centers(self) -> Float[Array, "cameras 2"]:
        """Where the cameras are above the floor, metres."""
        return _centers(self.cameras)


@jax.jit  # also within programs of a caller, which compile it as themselves
def _centers(cameras: tuple[FloorCamera, ...]) -> Float[Array, "cameras 2"]:
    return jnp.stack([camera.position()[:2] for camera in cameras])


class Cells(NamedTuple):
    """Floor points at which births are looked for, and the pixels to look at for each camera."""

    xy: Float[Array, "cells 2"]
    """Metres."""
    pixels: tuple[Int32[Array, "cells samples"], ...]
    """Into the reduced image of each camera, flattened; the last entry stands for pixels outside."""
    presence: tuple[Float[Array, "cells samples"], ...]
    """Of a person at the samples."""
    share: tuple[Float[Array, " cells"], ...]
    """Of the samples that lie in each image and in front of furniture; 0 for cells that only fill up their number."""
    area: tuple[Float[Array, " cells"], ...]
    """Of a person's outline, in pixels of the reduced images."""


class CameraFrame(NamedTuple):
    """What one camera delivers at one time, without lens distortion."""

    foreground: Num[Array | np.ndarray, "rows cols"]
    """Probability of foreground times 255, as bytes."""
    image: UInt8[Array | np.ndarray, "rows cols 3"]
    """Blue, green, red."""
    present: Bool[Array | np.ndarray, ""] | bool | np.bool_
    """False where the camera has nothing new; the images are then not looked at."""


class Meetings(NamedTuple):
    """Pairs of slots that were close and have not been distinguished since; symmetric matrices."""

    is_open: Bool[Array, "slots slots"]
    evidence: Float[Array, "slots slots"]
    """For an exchange; positive says that identities changed hands."""
    clear_s: Float[Array, "slots slots"]
    """Seconds during which both were observed well."""


def no_meetings(slots: int) -> Meetings:
    """Nobody has met anybody."""
    none = jnp.zeros((slots, slots))
    return Meetings(none.astype(bool), none, none)


class People(NamedTuple):
    """Everybody, one slot each."""

    belief: Gaussian
    """Mean (slots, STATE) and covariance (slots, STATE, STATE)."""
    mode: Int32[Array, " slots"]
    identity: Int32[Array, " slots"]
    """-1 where there is none yet."""
    log_odds: Float[Array, " slots"]
    """Of being a person."""
    unseen_s: Float[Array, " slots"]
    """Seconds since an image showed anything of them."""
    appearance: Float[Array, "slots 128"]
    appearance_frames: Int32[Array, " slots"]
    """How many frames went into it."""
    meetings: Meetings
    next_identity: Int32[Array, ""]
    shift: Float[Array, "slots cameras 2"]
    """Of their silhouettes in the image of each camera, pixels (`image_shift`)."""
    detectability: Float[Array, "slots values"]
    """Log weights of `DETECTABILITIES`, up to a constant."""


class Report(NamedTuple):
    """What is known after a frame, one row a slot."""

    identity: Int32[Array, " slots"]
    mode: Int32[Array, " slots"]
    xy: Float[Array, "slots 2"]
    """Metres."""
    sd_radial: Float[Array, " slots"]
    """Metres, along the line of sight of the nearest camera."""
    height: Float[Array, " slots"]
    """Metres."""
    score: Float[Array, " slots"]
    """Mean log likelihood ratio a pixel, against nobody being there."""
    share_seen: Float[Array, " slots"]
    """Of the silhouette, in an image, not behind furniture, and not shared with anybody before or behind."""
    flatness: Float[Array, " slots"]
    """How much the score drops 0.3 m nearer or farther along the line of sight: small where depth cannot be
    measured."""
    has_depth: Bool[Array, " slots"]
    """False where the distance from the camera cannot be measured, as with head and feet hidden (section 4, E2)."""
    nis: Float[Array, " slots"]
    """Normalised innovation squared of the update, over its four coordinates."""
    innovations: Int32[Array, "slots 2"]
    """How many coordinates were compared with their prediction, and how many of these lie within its 95 % band."""


def nobody(config: PeopleConfig, cameras: int = 1) -> People:
    """The state before anybody has come."""
    return _empty(config.capacity, cameras)


@partial(jax.jit, static_argnums=(0, 1))
def _empty(n: int, cameras: int) -> People:
    return People(
        Gaussian(jnp.zeros((n, STATE)), jnp.broadcast_to(jnp.eye(STATE), (n, STATE, STATE))),
        jnp.full(n, FREE, jnp.int32),
        jnp.full(n, -1, jnp.int32),
        jnp.zeros(n),
        jnp.zeros(n),
        jnp.full((n, APPEARANCE), 2 / APPEARANCE, float),
        jnp.zeros(n, jnp.int32),
        no_meetings(n),
        jnp.zeros((), jnp.int32),
        jnp.zeros((n, cameras, 2)),
        jnp.tile(jnp.array(DETECTABILITY_PRIOR), (n, 1)),
    )


def chosen(mask: Bool[Array, " slots"], yes: Any, no: Any) -> Any:
    """`yes` in the slots of the mask, `no` elsewhere, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (jnp.ndim(b) - 1)), a, b), yes, no)
