"""What one camera cannot tell: a link, or the whole hand, mirrored in depth.

Source: Shimada et al., section on several estimates, equation [30]; the formulas are derived in closed form. A link of
finger i points along u = a cos psi + b sin psi in the camera frame, where a and b span the plane in which the finger
bends. Its part along the line of sight is A cos(psi - psi_0). The mirrored link keeps its projected length and has the
opposite part along the line of sight; it has the same image exactly where the finger's plane holds the line of sight,
A = 1. In perspective the line of sight is that of the link's first point.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.math.lie import quaternion_multiply
from jaxfilters.math.linalg import safe_norm
from jaxfilters.models.articulated.features import wrap
from jaxfilters.models.articulated.hand import ArticulatedHand
from jaxfilters.models.articulated.kinematics import finger_frames, flexion_sums, turn, unit_rotation
from jaxfilters.models.articulated.layout import LINKS, Layout

SMALLEST_AMPLITUDE = 0.9
NEAR_IMAGE_PLANE = float(np.deg2rad(20.0))
"""Of a link whose image tells its length: there an error of 10 degrees changes its projected length by 6 % or less."""
LARGEST_CHANGE = float(np.deg2rad(60.0))
LARGEST_SEPARATION = float(np.deg2rad(25.0))
STDS_TO_MIRROR = 1.25
STDS_TO_STRAIGHT = 2.0

Index = int | Int[Array, ""]


class DepthMirrors(NamedTuple):
    """For every link, what mirroring it in depth takes."""

    change: Float[Array, "fingers 3"]
    """Of the link's own joint angle, radians in (-pi, pi]."""
    amplitude: Float[Array, "fingers 3"]
    """A: cosine between the line of sight and the finger's plane; the image stays the same where it is 1."""


class MirroredLink(NamedTuple):
    """A state with one link mirrored in depth."""

    x: Float[Array, " n"]
    change: Float[Array, ""]
    """Of the link's joint angle, radians."""
    amplitude: Float[Array, ""]


def turn_link(
    x: Float[Array, " n"], layout: Layout, finger: Index, link: Index, angle: Float[Array, ""]
) -> Float[Array, " n"]:
    """The state with the joint before a link turned; the links beyond it turn along, as in the paper."""
    return x.at[layout.flexion_index(finger, link)].add(angle)


def depth_mirrors(x: Float[Array, " n"], hand: ArticulatedHand) -> DepthMirrors:
    """Change `wrap(pi + 2 psi_0 - 2 psi)` of every link's joint angle that mirrors it in depth, and A."""
    frames = finger_frames(x, hand.layout, pivot=hand.pivot)
    rotation = unit_rotation(x[hand.layout.quaternion])
    sight = hand.projection.line_of_sight(hand.points(x)[:, :LINKS])
    a = jnp.sum(turn(rotation, frames.along)[:, None] * sight, axis=-1)
    b = jnp.sum(turn(rotation, frames.bend)[:, None] * sight, axis=-1)
    amplitude = safe_norm(jnp.stack([a, b], axis=-1))
    across = amplitude > 0
    nearest = jnp.arctan2(jnp.where(across, b, 0.0), jnp.where(across, a, 1.0))
    return DepthMirrors(wrap(jnp.pi + 2 * nearest - 2 * flexion_sums(x, hand.layout)), amplitude)


def depth_mirror(x: Float[Array, " n"], hand: ArticulatedHand, finger: Index, link: Index) -> MirroredLink:
    """The state with one link mirrored in depth by its own joint alone; finger and link counted from 0."""
    change, amplitude = (value[finger, link] for value in depth_mirrors(x, hand))
    return MirroredLink(turn_link(x, hand.layout, finger, link, change), change, amplitude)


def shows_length(x: Float[Array, " n"], hand: ArticulatedHand) -> Bool[Array, "fingers 3"]:
    """Links that lie within `NEAR_IMAGE_PLANE` of the image plane: their image tells how long they are.

    The projected length r cos(phi) hardly depends on a small inclination phi; that of a foreshortened link tells r
    only as well as phi is known, which one camera takes from the limits and from the model of the hand.
    """
    points = hand.points(x)
    link = points[:, 1:] - points[:, :-1]
    depth = jnp.abs(jnp.sum(link * hand.projection.line_of_sight(points[:, :-1]), axis=-1))
    return depth <= np.sin(NEAR_IMAGE_PLANE) * safe_norm(link)


def mirror_trigger(x: Float[Array, " n"], std: Float[Array, " n"], hand: ArticulatedHand) -> Bool[Array, "fingers 3"]:
    """Links whose mirrored pose deserves a hypothesis: the image hardly differs, and the angle is within reach [30].

    A > 0.9, half the change below 1.25 standard deviations of the joint angle, and the change below 60 degrees.
    """
    change, amplitude = depth_mirrors(x, hand)
    sigma = hand.layout.angles_of(std)[:, 1:]
    near = 0.5 * jnp.abs(change) < STDS_TO_MIRROR * sigma
    return (amplitude > SMALLEST_AMPLITUDE) & near & (jnp.abs(change) < LARGEST_CHANGE)


def separated_points(
    x: Float[Array, " n"], std: Float[Array, " n"], hand: ArticulatedHand, finger: Index, link: Index
) -> Float[Array, "2 n"]:
    """Where to linearise for the two poses of a link: first on the side of `x`, then on the mirrored side.

    The joint angle is set to theta_c -+ max(|change| / 2, min(sigma, 25 degrees)) about the middle theta_c of the two
    poses: at the middle the image does not depend on the angle, and close to it a step overshoots.
    """
    change = depth_mirrors(x, hand).change[finger, link]
    sigma = std[hand.layout.flexion_index(finger, link)]
    half = jnp.maximum(0.5 * jnp.abs(change), jnp.minimum(sigma, LARGEST_SEPARATION))
    half = jnp.where(change < 0, -half, half)
    turns = (0.5 * change - half, 0.5 * change + half)
    return jnp.stack([turn_link(x, hand.layout, finger, link, angle) for angle in turns])


def reverse_depth(x: Float[Array, " n"], hand: ArticulatedHand) -> Float[Array, " n"]:
    """The whole hand mirrored in depth: rotation J R M, flexions and their rates negated, all else kept.

    J mirrors along the line of sight to the wrist, M along the palm's normal. In weak perspective it is a linear map,
    a signed permutation, under which every feature stays exactly the same, unless a finger's frame is turned otherwise
    than about the palm's normal. In perspective it is an approximation for a hand far away.
    """
    layout = hand.layout
    sight = jnp.concatenate([jnp.zeros(1, x.dtype), hand.projection.line_of_sight(hand.wrist(x))])
    normal = jnp.array([0.0, 0.0, 1.0, 0.0], x.dtype)
    for block in (layout.quaternion, layout.quaternion_rate):
        x = x.at[block].set(quaternion_multiply(sight, quaternion_multiply(x[block], normal)))
    for block in (layout.angles, layout.angle_rates):
        signs = jnp.tile(jnp.array([1.0, -1.0, -1.0, -1.0], x.dtype), layout.num_fingers)
        x = x.at[block].multiply(signs)
    return x


def reversal_trigger(x: Float[Array, " n"], std: Float[Array, " n"], layout: Layout) -> Bool[Array, ""]:
    """Whether the reversed hand deserves a hypothesis: all flexions within two standard deviations of straight."""
    flexions, sigma = layout.angles_of(x)[:, 1:], layout.angles_of(std)[:, 1:]
    return jnp.all(jnp.abs(flexions) <= STDS_TO_STRAIGHT * sigma)
