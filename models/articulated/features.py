"""What is measured in the image of an articulated hand: points, finger axes as lines, the palm's outline.

Source: Shimada et al., equations [7], [11]-[13]. A line is (alpha, rho): the angle of its direction e = (cos alpha,
sin alpha) and its signed distance from the origin along n = (-sin alpha, cos alpha). Lines are undirected, (alpha, rho)
is the same as (alpha + pi, -rho), unless the detector knows which end is the base.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.articulated.layout import LINKS

BLOCKS = ("wrist", "bases", "joints", "tips", "lines", "palm")
"""What can be measured, in the order of the rows."""
SHORTEST_LINK = 2.0
"""Pixels: the direction of a shorter line says nothing."""
_NO_LENGTH = 1e-3


class ImagedHand(NamedTuple):
    """Everything that can be measured, without noise."""

    wrist: Float[Array, " 2"]
    points: Float[Array, "fingers 4 2"]
    """Joints from base to tip, pixels."""
    palm: Float[Array, " 3"]
    """alpha, rho_min, rho_max of the outline."""
    palm_length: Float[Array, ""]
    """Length of the image of the palm's axis, pixels."""
    origin: Float[Array, " 2"]
    """The pixel that distances of finger axes are measured from."""


@dataclass(frozen=True)
class FeatureSet:
    """Which of the `BLOCKS` are observed; hashable, a static argument.

    Raises:
        ValueError: if `blocks` is empty, has an unknown name or repeats one, or has both joints and tips.
    """

    blocks: tuple[str, ...]

    def __post_init__(self):
        """Refuse sets without meaning."""
        unknown = [block for block in self.blocks if block not in BLOCKS]
        if unknown or not self.blocks:
            raise ValueError(f"blocks must be some of {', '.join(BLOCKS)}; got {self.blocks}.")
        if len(set(self.blocks)) < len(self.blocks) or {"joints", "tips"} <= set(self.blocks):
            raise ValueError(f"blocks must name every point once, and tips are joints; got {self.blocks}.")
        object.__setattr__(self, "blocks", tuple(sorted(self.blocks, key=BLOCKS.index)))

    def names(self, num_fingers: int) -> tuple[str, ...]:
        """Of the rows: `wrist_x`, `p_11_x`, `alpha_11`, `rho_11`, `palm_alpha`, `palm_rho_min` and so on."""
        fingers = range(1, num_fingers + 1)
        links = [f"{finger}{link}" for finger in fingers for link in range(1, LINKS + 1)]
        names = {
            "wrist": ["wrist_x", "wrist_y"],
            "bases": [f"p_{finger}0_{axis}" for finger in fingers for axis in "xy"],
            "joints": [f"p_{link}_{axis}" for link in links for axis in "xy"],
            "tips": [f"p_{finger}{LINKS}_{axis}" for finger in fingers for axis in "xy"],
            "lines": [f"{kind}_{link}" for kind in ("alpha", "rho") for link in links],
            "palm": ["palm_alpha", "palm_rho_min", "palm_rho_max"],
        }
        return tuple(name for block in self.blocks for name in names[block])

    def size(self, num_fingers: int) -> int:
        """Number of rows."""
        return len(self.names(num_fingers))

    def stack(self, image: ImagedHand) -> Float[Array, " rows"]:
        """The rows [13] of one image: pixels, radians."""
        values = {
            "wrist": lambda: image.wrist,
            "bases": lambda: image.points[:, 0].ravel(),
            "joints": lambda: image.points[:, 1:].ravel(),
            "tips": lambda: image.points[:, -1].ravel(),
            "lines": lambda: _stacked_lines(image.points - image.origin),
            "palm": lambda: image.palm,
        }
        return jnp.concatenate([values[block]() for block in self.blocks])

    def usable(self, image: ImagedHand, shortest: float = SHORTEST_LINK) -> Bool[Array, " rows"]:
        """False for rows of lines that are shorter in this image than `shortest` pixels."""
        short = degenerate_links(image.points, shortest).ravel()
        flat = {"lines": jnp.tile(short, 2), "palm": jnp.broadcast_to(image.palm_length < shortest, (3,))}
        sizes = {block: FeatureSet((block,)).size(len(image.points)) for block in self.blocks}
        return ~jnp.concatenate([flat.get(block, jnp.zeros(sizes[block], bool)) for block in self.blocks])

    def std(
        self,
        num_fingers: int,
        point: float | Float[Array, ""],
        alpha: float | Float[Array, ""],
        rho: float | Float[Array, ""],
    ) -> Float[Array, " rows"]:
        """Noise of the rows from that of a point's coordinate (pixels), an angle (radians) and a distance (pixels)."""
        names = self.names(num_fingers)
        is_alpha, is_rho = np.array(["alpha" in n for n in names]), np.array(["rho" in n for n in names])
        return jnp.where(is_alpha, alpha, jnp.where(is_rho, rho, jnp.asarray(point, dtype=float)))


FULL = FeatureSet(("wrist", "joints", "lines", "palm"))
PAPER_EXPERIMENT = FeatureSet(("wrist", "tips", "lines", "palm"))
KEYPOINTS = FeatureSet(("wrist", "bases", "joints"))
FEATURE_SETS = {"full": FULL, "paper_experiment": PAPER_EXPERIMENT, "keypoints": KEYPOINTS}
"""29 and 21 rows for two fingers; keypoints are what detectors of hand joints yield, 42 numbers for five fingers."""


class Line(NamedTuple):
    """A line through two points of the image."""

    alpha: Float[Array, "*batch"]
    """Radians in (-pi, pi]."""
    rho: Float[Array, "*batch"]
    """Signed, pixels."""
    length: Float[Array, "*batch"]
    """Between the points, pixels."""


def line_parameters(start: Float[Array, "*batch 2"], end: Float[Array, "*batch 2"]) -> Line:
    """The line from `start` to `end` [11], [12]; where they coincide its direction is that of x, with derivative 0."""
    delta = end - start
    alpha, (cos, sin), length = _direction(delta)
    return Line(alpha, cos * start[..., 1] - sin * start[..., 0], length)


def palm_outline(axis: Float[Array, " 2"], edges: Float[Array, "edges 2"]) -> Float[Array, " 3"]:
    """alpha, rho_min, rho_max of the two outermost lines along `axis` through points on the palm's edges, pixels."""
    alpha, (cos, sin), _ = _direction(axis)
    rho = cos * edges[:, 1] - sin * edges[:, 0]
    return jnp.stack([alpha, jnp.min(rho), jnp.max(rho)])


def degenerate_links(
    points: Float[Array, "fingers 4 2"], shortest: float | Float[Array, ""] = SHORTEST_LINK
) -> Bool[Array, "fingers 3"]:
    """Links whose image is shorter than `shortest` pixels: they have no direction worth measuring."""
    delta = jnp.diff(points, axis=1)
    return jnp.sum(delta * delta, axis=-1) < shortest**2


def wrap(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The same angle in (-pi, pi], exactly as it is where it lies there."""
    return angle - 2 * jnp.pi * jnp.ceil((angle - jnp.pi) / (2 * jnp.pi))


Residual = Callable[[Float[Array, " rows"], Float[Array, " rows"], FeatureSet, int], Float[Array, " rows"]]
"""`(observed, predicted, features, num_fingers) -> observed minus predicted`."""


def directed_residual(
    y: Float[Array, " rows"], y_hat: Float[Array, " rows"], features: FeatureSet, num_fingers: int
) -> Float[Array, " rows"]:
    """`y - y_hat` with angles wrapped, for a detector that knows which end of a line is the base."""
    rows = _line_rows(features, num_fingers)
    return jnp.where(rows.is_alpha, wrap(y - y_hat), y - y_hat)


def undirected_residual(
    y: Float[Array, " rows"], y_hat: Float[Array, " rows"], features: FeatureSet, num_fingers: int
) -> Float[Array, " rows"]:
    """`y - y_hat` with every observed line in that of its two notations whose angle is nearer to the predicted one.

    The other notation of a finger axis is (alpha + pi, -rho); of the palm's outline (alpha + pi, -rho_max, -rho_min).
    """
    rows = _line_rows(features, num_fingers)
    direct = directed_residual(y, y_hat, features, num_fingers)
    other_notation = y[rows.partner] * jnp.asarray(rows.sign, y.dtype) + jnp.asarray(rows.shift, y.dtype)
    other = directed_residual(other_notation, y_hat, features, num_fingers)
    opposite = jnp.abs(direct[rows.alpha_row]) > jnp.pi / 2
    return jnp.where(rows.is_line & opposite, other, direct)


class _LineRows(NamedTuple):
    """Per row: whether it is an angle or belongs to a line, that line's angle, and what the other notation takes."""

    is_alpha: np.ndarray
    is_line: np.ndarray
    alpha_row: np.ndarray
    partner: np.ndarray
    sign: np.ndarray
    shift: np.ndarray


def _line_rows(features, num_fingers) -> _LineRows:
    names = features.names(num_fingers)
    alphas = {name: name.replace("rho", "alpha").removesuffix("_min").removesuffix("_max") for name in names}
    swapped = {"palm_rho_min": "palm_rho_max", "palm_rho_max": "palm_rho_min"}
    is_alpha, is_rho = np.array(["alpha" in n for n in names]), np.array(["rho" in n for n in names])
    return _LineRows(
        is_alpha=is_alpha,
        is_line=is_alpha | is_rho,
        alpha_row=np.array([names.index(alphas[name]) for name in names]),
        partner=np.array([names.index(swapped.get(name, name)) for name in names]),
        sign=np.where(is_rho, -1, 1),
        shift=np.where(is_alpha, np.pi, 0.0),
    )


def _stacked_lines(points):
    alpha, rho, _ = line_parameters(points[:, :-1], points[:, 1:])
    return jnp.concatenate([alpha.ravel(), rho.ravel()])


@jax.jit  # traced once for each shape, though called at many places of a program
def _direction(delta):
    """Angle, unit vector and length of vectors in the image; those without length are taken for that of x."""
    without = jnp.sum(delta * delta, axis=-1) < _NO_LENGTH**2
    delta = jnp.where(without[..., None], jnp.array([1.0, 0.0], delta.dtype), delta)
    length = jnp.sqrt(jnp.sum(delta * delta, axis=-1))
    direction = delta / length[..., None]
    angle = jnp.arctan2(delta[..., 1], delta[..., 0])
    return angle, (direction[..., 0], direction[..., 1]), jnp.where(without, 0.0, length)
