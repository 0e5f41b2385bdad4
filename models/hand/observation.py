"""What a depth camera says about a hand: the part of the frame that is compared, and the log-likelihood of a pose."""

from collections.abc import Callable
from dataclasses import field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.math.lie import quaternion_normalize, quaternion_to_matrix
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import count_observed, rendered_cost, union_cost
from jaxfilters.models.hand.limits import limit_log_likelihood
from jaxfilters.models.hand.skeleton import DIGITS, HandGeometry, hand_center
from jaxfilters.models.hand.surface import HandSurface
from jaxfilters.models.rendering.comparison import DepthTerms

REACH = 0.14
"""Radius in metres of the ball about the middle of an average hand that holds it in any pose."""
FOREARM_BEGINS = 0.0
"""Metres below the wrist, in the palm's direction of the forearm, from which a reading is arm rather than hand. Where
the model itself ends: readings beyond it would draw the palm down the arm, frame by frame."""

FINEST_STRIDE, COARSEST_STRIDE = 0.5, 16.0
"""Pixels of the frame for one of a window: below the first, readings are only repeated."""
HOLE = 5
"""Pixels of a window, rows and columns: what has a reading among so many about it is not hidden."""
FEWEST_READ = 2
"""Of the three outer joints of a digit that is not hidden."""


class HandImage(NamedTuple):
    """A window of a depth frame, with everything but the hand taken out."""

    camera: Pinhole
    """Of the window."""
    observed: Float[Array, "rows cols"]
    """Metres; `inf` is background, NaN says nothing."""
    observed_count: Int[Array, ""]
    """Hand pixels among them."""


def crop(
    camera: Pinhole,
    frame: Float[Array, "rows cols"],
    center: Float[Array, " 3"],
    shape: tuple[int, int],
    stride: int | float | Float[Array, ""],
) -> tuple[Pinhole, Float[Array, "height width"]]:
    """The window of `shape` pixels, `stride` pixels of the frame apart, about the projection of `center` (metres).

    A stride that is no whole number takes the reading nearest to each pixel of the window; it may be traced. Pixels
    beyond the border of the frame are NaN. `center` must lie in front of the camera.
    """
    rows, cols = shape
    corner = jnp.round(camera.project(center) - 0.5 * stride * jnp.array([cols - 1, rows - 1]))
    u = jnp.round(corner[0] + stride * jnp.arange(cols)).astype(int)
    v = jnp.round(corner[1] + stride * jnp.arange(rows)).astype(int)
    inside = ((v >= 0) & (v < frame.shape[0]))[:, None] & ((u >= 0) & (u < frame.shape[1]))
    pixels = frame.at[v].get(mode="clip").at[:, u].get(mode="clip")
    window = replace(camera, focal=camera.focal / stride, center=(camera.center - corner) / stride, shape=shape)
    return window, jnp.where(inside, pixels, jnp.nan)


def window_stride(camera: Pinhole, depth: Float[Array, ""], cols: int) -> Float[Array, ""]:
    """Pixels of the frame from one column of a window to the next, so that a hand at `depth` metres fills `cols`."""
    return jnp.clip(camera.focal[0] * 2 * REACH / (depth * cols), FINEST_STRIDE, COARSEST_STRIDE)


def isolate(
    camera: Pinhole,
    observed: Float[Array, "rows cols"],
    pose: Float[Array, " 22"],
    scale: float | Float[Array, ""] = 1.0,
) -> Float[Array, "rows cols"]:
    """The readings near an expected hand; the rest becomes background where it is farther away, else unknown.

    The forearm, which the hand model lacks, is unknown too: comparing it would pull the palm down the arm.
    """
    wrist, rotation = pose[:3], quaternion_to_matrix(quaternion_normalize(pose[3:7]))
    center = hand_center(pose, scale)
    points = camera.rays() * jnp.where(jnp.isfinite(observed), observed, 0.0)[..., None]
    outside = jnp.sum((points - center) ** 2, axis=-1) > (scale * REACH) ** 2
    behind = observed > center[2] + scale * REACH
    arm = dot(points - wrist, rotation[:, 1]) > scale * FOREARM_BEGINS
    kept = jnp.where(outside | arm, jnp.nan, observed)
    return jnp.where(behind, jnp.inf, kept)


def hand_image(camera: Pinhole, observed: Float[Array, "rows cols"]) -> HandImage:
    """An isolated window with its hand pixels counted."""
    return HandImage(camera, observed, count_observed(observed))


def has_reading_near(observed: Float[Array, "rows cols"]) -> Bool[Array, "rows cols"]:
    """Whether a pixel of a window, or a neighbour up to half of `HOLE` away, has a reading or is background."""
    return jax.lax.reduce_window(~jnp.isnan(observed), False, jax.lax.bitwise_or, (HOLE, HOLE), (1, 1), "SAME")


def hidden_digits(image: HandImage, joints: Float[Array, "21 3"]) -> Bool[Array, " 5"]:
    """Whether a window says nothing about a digit: most of its outer joints have no reading near them.

    Args:
        image: Of a hand.
        joints: Estimated, metres, in the order of `JOINT_NAMES`.
    """
    rows, cols = image.observed.shape
    outer = joints[1:].reshape(len(DIGITS), 4, 3)[:, 1:]
    u, v = jnp.moveaxis(jnp.round(image.camera.project(outer)).astype(int), -1, 0)
    is_inside = (u >= 0) & (u < cols) & (v >= 0) & (v < rows)
    is_read = has_reading_near(image.observed)[jnp.clip(v, 0, rows - 1), jnp.clip(u, 0, cols - 1)]
    return jnp.sum(is_inside & is_read, axis=-1) < FEWEST_READ


def union(terms: DepthTerms, image: HandImage, max_error: float) -> Float[Array, ""]:
    """Cost over the rendered and the observed hand pixels."""
    return union_cost(terms, image.observed_count, max_error)


def rendered(terms: DepthTerms, image: HandImage, max_error: float) -> Float[Array, ""]:
    """Cost over the rendered pixels alone, the paper's."""
    del image
    return rendered_cost(terms, max_error)


@pytree_dataclass
class HandLikelihood:
    """Log-likelihood of a pose given a `HandImage`: a depth cost in Gibbs form, and soft joint limits."""

    surface: HandSurface
    sigma: Float[Array, ""]
    """Scale of the cost, metres, positive."""
    max_error: float = field(metadata={"static": True})
    """c_max: what a pixel costs at most, metres, positive."""
    cost_of: Callable[[DepthTerms, HandImage, float], Float[Array, ""]] = field(metadata={"static": True})
    """`union` or `rendered`."""
    form: Callable[[Array, Array], Float[Array, ""]] = field(metadata={"static": True})
    """`gibbs_abs` or `gibbs_sq` of `jaxfilters.models.hand.cost`."""

    @property
    def geometry(self) -> HandGeometry:
        """Of the hand that is rendered."""
        return self.surface.geometry

    def scaled(self, scale: float | Float[Array, ""]) -> "HandLikelihood":
        """The likelihood of the same hand with every length multiplied by `scale` (may be traced)."""
        return replace(self, surface=self.surface.scaled(scale))

    def cost(self, pose: Float[Array, " 22"], image: HandImage) -> Float[Array, ""]:
        """Metres."""
        terms = self.surface.compare(image.camera, pose, image.observed, self.max_error)
        return self.cost_of(terms, image, self.max_error)

    def log_likelihood(self, pose: Float[Array, " 22"], image: HandImage) -> Float[Array, ""]:
        """Up to a constant that is the same for every pose."""
        return self.form(self.cost(pose, image), self.sigma) + limit_log_likelihood(pose[7:])
