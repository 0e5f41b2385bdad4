"""How far apart the feet of people who walk are: the silhouette of a stride, in the direction of the velocity.

A person who walks across the line of sight shows a gap between the legs for most of the time, and is displaced by
decimetres where one shape stands for all moments of a stride. How far a stride has got is a nuisance of each image,
over which the likelihood is maximised together with the place (a profile likelihood). Where another person is in the
window as well, a free stride would also explain that person, and people who meet change places: there it is half.
Where calibrations may disagree, images are shifted, and a stride displaces a silhouette as a shift does: it is 0 there.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.trackers.people.silhouettes import View, log_likelihood
from jaxfilters.trackers.people.state import HEIGHT, STRIDE, PeopleScene

STANDING_M_PER_S, WALKING_M_PER_S = 0.25, 0.75
"""Up to the first, speed is taken for error; from the second on, strides are full ones."""
FULL_STRIDE = 0.22
"""From the middle of the body to the front foot at most, in body heights: legs that swing by 24 degrees."""
STRIDES = (0.0, 1 / 3, 2 / 3, 1.0)
"""Shares of a full stride that are tried in every image."""
_LEAST_M_PER_S = 1e-3


def longest_stride(mean: Float[Array, "*slots 9"]) -> Float[Array, "*slots 2"]:
    """From the middle to the front foot along X and Y at most, metres: in the direction of walking, 0 at rest."""
    speed = jnp.linalg.norm(mean[..., 2:4], axis=-1)
    share = jnp.clip((speed - STANDING_M_PER_S) / (WALKING_M_PER_S - STANDING_M_PER_S), 0.0, 1.0)
    length = FULL_STRIDE * mean[..., HEIGHT] * share
    return (length / jnp.maximum(speed, _LEAST_M_PER_S))[..., None] * mean[..., 2:4]


def with_stride(place: Float[Array, "*slots 4"]) -> Float[Array, "*slots 6"]:
    """X, Y, height and width, followed by the stride of a person whose legs are together."""
    return jnp.pad(place, [(0, 0)] * (place.ndim - 1) + [(0, 2)])


def with_best_stride(
    scene: PeopleScene,
    shape: Float[Array, " 6"],
    longest: Float[Array, " 2"],
    views: View,
    contrasts: Float[Array, "cameras samples"],
    alone: Bool[Array, ""],
) -> Float[Array, " 6"]:
    """A silhouette with the stride under which the images are most likely, or half the largest beside others.

    Args:
        scene: Cameras and constants.
        shape: X, Y, height, width and stride so far, metres.
        longest: The largest stride, metres.
        views: The windows of the person.
        contrasts: What candidates are compared with.
        alone: Whether nobody else may make the window foreground.
    """
    strides = jnp.array(STRIDES)[:, None] * longest
    candidates = jnp.broadcast_to(shape, (len(STRIDES), *shape.shape)).at[:, STRIDE].set(strides)
    scores = jax.vmap(log_likelihood, in_axes=(None, 0, None, None))(scene, candidates, views, contrasts)
    return jnp.where(alone, candidates[jnp.argmax(scores)], shape.at[STRIDE].set(longest / 2))
