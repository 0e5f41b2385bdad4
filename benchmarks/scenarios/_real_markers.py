"""Hands of which only markers are visible: points fixed to the palm or between the joints of a finger."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.kinematics import finger_points


@dataclass(frozen=True)
class Marker:
    """A point of a hand: on the palm, or a share of the way from one joint of a finger to the next."""

    name: str
    palm: tuple[float, float, float] | None = None
    """Shares of the palm's height, thickness (towards the inner side) and width (towards the thumb)."""
    finger: int = 0
    """From 0, the thumb."""
    along: float = 0.0
    """Joints from the finger's base: 0 is the base, 1.5 the middle of the second link, 3 the tip."""


@pytree_dataclass
class MarkedHand(ArticulatedHand):
    """An articulated hand whose observation is the image of its markers, (x, y) one after the other."""

    markers: tuple[Marker, ...] = field(metadata=dict(static=True))

    def marker_points(self, x: Float[Array, " n"]) -> Float[Array, "markers 3"]:
        """Markers in the camera frame: pixels from the wrist's depth, or metres."""
        width, height, thickness = x[self.layout.palm]
        joints = finger_points(x, self.layout, pivot=self.pivot)
        size = jnp.stack([height, thickness, width])
        points = [_place(marker, size, joints) for marker in self.markers]
        return self.projection.camera_points(x, self.layout, jnp.stack(points))

    def exact_features(self, x: Float[Array, " n"]) -> Float[Array, " rows"]:
        """Image of the markers, pixels."""
        return self.projection.image_points(self.marker_points(x)).ravel()

    def residual(self, y: Float[Array, " rows"], y_hat: Float[Array, " rows"]) -> Float[Array, " rows"]:
        """Observed minus predicted."""
        return y - y_hat


def marked_hand(hand: ArticulatedHand, markers: Sequence[Marker]) -> MarkedHand:
    """The hand with markers for its features."""
    parts = {part.name: getattr(hand, part.name) for part in dataclasses.fields(hand)}
    return MarkedHand(**parts, markers=tuple(markers))


def _place(marker, size, joints):
    if marker.palm is not None:
        return jnp.asarray(marker.palm, size.dtype) * size
    before = min(int(np.floor(marker.along)), joints.shape[1] - 2)
    share = marker.along - before
    return (1 - share) * joints[marker.finger, before] + share * joints[marker.finger, before + 1]
