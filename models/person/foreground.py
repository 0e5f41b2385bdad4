"""Likelihood of a foreground probability map given people: small windows, each sampled at a fixed number of pixels.

Every pixel is foreground or background on its own. A pixel that nobody covers is foreground with probability
`CLUTTER`; a person makes it foreground with probability q, its `presence` there, independently of the others. With T
the probability that neither clutter nor anybody else explains the pixel, and p the foreground probability that was
observed (even prior), a person multiplies the likelihood by

    (p + T (1 - q) (1 - 2 p)) / (p + T (1 - 2 p)) = 1 - q b,    b = T (1 - 2 p) / (p + T (1 - 2 p)),

so that one number a pixel, `contrast`, is all that candidates have to be compared with. What one person gains is what
the others do not explain: people who hide each other, and blobs of several people, need no case of their own.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Integer

from jaxfilters._full_precision import dot, einsum
from jaxfilters.models.person.ellipsoid import Ellipsoid, grown, outline, outline_radius

CLUTTER = 0.02
"""Share of foreground pixels where nobody is."""
LEAST, MOST = 0.06, 0.94
"""Bounds on what a pixel may claim: background subtraction is wrong more often than it says."""


class Part(NamedTuple):
    """A soft ellipsoid of a body; lengths in body heights, but the radius in body widths."""

    center: float
    half_height: float
    radius: float
    presence: float
    """Probability in its middle that it makes a pixel foreground."""
    falloff: int
    """Exponent of the squared distance in units of the outline: how sharply it ends there."""


PARTS = (Part(0.30, 0.283, 0.29, 0.68, 4), Part(0.663, 0.22, 0.398, 0.99, 4), Part(0.92, 0.079, 0.20, 0.99, 4))
"""Either leg, trunk with arms, head. One ellipsoid that touches soles, crown and arms cannot be found where bodies are:
people are then taken for shorter and nearer than they are. One for both legs is not there where feet are apart: people
who walk across the line of sight are then found beyond the gap between their legs. These are the most likely ones,
rounded, for the silhouettes of 600 bodies of `models.synthetic.walkers` whose strides are known (heights 1.72 +- 0.09
m, widths 0.26 +- 0.02 heights, walking or standing, turned anyhow, viewed 3 to 75 degrees from above): 0.052 nats a
pixel of the images, 0.058 with one ellipsoid for both legs."""
_SWINGS = (-1.0, 1.0, 0.0, 0.0)
"""Of either leg, trunk and head: where its lower end is, in strides."""
HIP = 0.53
"""Height about which legs swing, in body heights."""
SINK = 0.9
"""By how much hips sink over straight legs, in squared strides by the height; of small angles."""
_LEAST_HEIGHT_M = 0.1
_BLOCK = 16
"""Factors multiplied before a logarithm: 16 factors of at most 1 / LEAST stay far from the ends of float32."""


class Window(NamedTuple):
    """Pixels at which people are compared with an image."""

    uv: Float[Array, "samples 2"]
    """Centres of pixels; some lie outside the image."""
    pixel: Integer[Array, " samples"]
    """Number of the pixel in the flattened image; of some pixel where it lies outside."""
    inside: Float[Array, " samples"]
    """1 inside the image, 0 outside."""
    area: Float[Array, ""]
    """Square pixels for which one sample stands."""


def window(box: Float[Array, " 4"], shape: tuple[int, int], grid: tuple[int, int]) -> Window:
    """An even grid of pixels over a box (least u, least v, greatest u, greatest v)."""
    rows, cols = grid
    low, size = box[:2], box[2:] - box[:2]
    u = low[0] + size[0] * (jnp.arange(cols) + 0.5) / cols
    v = low[1] + size[1] * (jnp.arange(rows) + 0.5) / rows
    u, v = (jnp.round(a) for a in jnp.meshgrid(u, v))
    inside = (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
    column, row = (jnp.clip(a, 0, top - 1).astype(jnp.int32) for a, top in ((u, shape[1]), (v, shape[0])))
    return Window(
        jnp.stack([u.ravel(), v.ravel()], axis=-1),
        (row * shape[1] + column).ravel(),
        inside.ravel().astype(float),
        size[0] * size[1] / (rows * cols),
    )


def presence(
    P: Float[Array, "3 4"],
    xy: Float[Array, " 2"],
    height: Float[ArrayLike, ""],
    width: Float[ArrayLike, ""],
    uv: Float[Array, "*pixels 2"],
    spread_px: Float[ArrayLike, ""] = 0.0,
    stride: Float[Array, " 2"] | None = None,
) -> Float[Array, "*pixels"]:
    """Probability that a person makes a pixel foreground.

    Args:
        P: Projection matrix in canonical scale.
        xy: Where the person stands, metres.
        height: Metres.
        width: From arm to arm, metres.
        uv: Pixels.
        spread_px: How far silhouettes reach beyond their edges, pixels.
        stride: From the middle of the body to the front foot along X and Y, metres; legs together by default.
    """
    stride = jnp.zeros(2) if stride is None else stride
    height, width = lowered(jnp.asarray(height), stride), jnp.asarray(width)
    parts = (PARTS[0], *PARTS)
    center, half_height, radius, _, _ = jnp.array(parts).T
    outlines = jax.vmap(lambda swing, part: grown(outline(_swung(P, swing * stride, HIP * height), part), spread_px))(
        jnp.array(_SWINGS),
        Ellipsoid(
            jnp.stack([*jnp.broadcast_to(xy[:, None], (2, len(parts))), center * height], axis=-1),
            jnp.stack([radius * width, radius * width, half_height * height], axis=-1),
        ),
    )
    absent = jnp.ones(uv.shape[:-1])
    for number, part in enumerate(parts):
        squared = outline_radius(jax.tree.map(lambda leaf, number=number: leaf[number], outlines), uv)
        absent = absent * (1 - part.presence / (1 + squared**part.falloff))
    return 1 - absent


def lowered(height: Float[Array, ""], stride: Float[Array, " 2"]) -> Float[Array, ""]:
    """Height of a body whose feet are apart by twice a stride (X, Y), metres: hips sink as straight legs swing."""
    return height - SINK * jnp.sum(stride**2) / jnp.maximum(height, _LEAST_HEIGHT_M)


def _swung(P, swing, hip):
    """The camera that has of an upright leg the image of one whose lower end is displaced by a swing: a shear."""
    moved = dot(P[:, :2], swing)
    return P.at[:, 2].add(-moved / jnp.maximum(hip, _LEAST_HEIGHT_M)).at[:, 3].add(moved)


def contrast(foreground: Float[Array, "*pixels"], unexplained: Float[Array, "*pixels"]) -> Float[Array, "*pixels"]:
    """What candidates are compared with: negative where a person would explain something, positive where not.

    Args:
        foreground: Observed probability of foreground.
        unexplained: Probability that nothing else makes the pixel foreground.
    """
    p = jnp.clip(foreground, LEAST, MOST)
    ahead = unexplained * (1 - 2 * p)
    return ahead / (p + ahead)


def log_likelihood_ratio(presence: Float[Array, " samples"], contrast: Float[Array, " samples"]) -> Float[Array, ""]:
    """Log likelihood of a person over that of nobody, in samples; both are computed for the same window."""
    factors = 1 - presence * contrast
    padded = jnp.pad(factors, (0, -len(factors) % _BLOCK), constant_values=1.0)
    return jnp.sum(jnp.log(jnp.prod(padded.reshape(_BLOCK, -1), axis=0)))


class Quadratic(NamedTuple):
    """`value + gradient . d - d . curvature d / 2` around a point."""

    value: Float[Array, ""]
    gradient: Float[Array, " n"]
    curvature: Float[Array, "n n"]
    """Positive semidefinite where the point is near a maximum."""


def lattice(dimensions: int, reach: int = 1) -> Float[Array, "points n"]:
    """All points with whole coordinates from `-reach` to `reach`."""
    axes = jnp.meshgrid(*[jnp.arange(-reach, reach + 1, dtype=float)] * dimensions, indexing="ij")
    return jnp.stack([axis.ravel() for axis in axes], axis=-1)


def quadratic_fit(values: Float[Array, " points"], steps: Float[Array, " n"]) -> Quadratic:
    """Least-squares parabola through values on `lattice(n) * steps`, with the slope of a Gauss-Hermite rule.

    On a full lattice the regressors are orthogonal but for constant and squares, so that every coefficient is a
    contrast of its own (G. Box, K. Wilson, "On the experimental attainment of optimum conditions", 1951). The slope is
    the mean of that of the function over a Gaussian with standard deviation `steps / sqrt(3)`, of which the lattice has
    the nodes (I. Arasaratnam, S. Haykin, "Discrete-time nonlinear filtering algorithms using Gauss-Hermite quadrature",
    2007): exactly, for polynomials up to the fourth power of a coordinate. Least squares take the mean over twice the
    variance of the other coordinates, and put the maximum of a skew function too far towards its longer tail.

    Raises:
        ValueError: if there is not one value for each point of the lattice.
    """
    n = len(steps)
    if len(values) != 3**n:
        raise ValueError(f"values must be those on lattice({n}), {3**n} of them; got {len(values)}.")
    x = lattice(n)
    weights = jnp.prod(jnp.where(x == 0, 2 / 3, 1 / 6), axis=1)
    gradient = 3 * dot(values * weights, x)
    mixed = 3.0 ** (2 - n) / 4 * einsum("p,pi,pj->ij", values, x, x)
    squares = 3.0 ** (1 - n) / 2 * dot(values, 3 * x**2 - 2)
    second = jnp.where(jnp.eye(n, dtype=bool), 2 * squares, mixed)
    value = jnp.mean(values) - jnp.sum(squares) * 2 / 3
    return Quadratic(value, gradient / steps, -second / jnp.outer(steps, steps))
