"""Where landmarks that one camera sees are in another one: along their epipolar lines, at the depth of one head."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxfilters._xla.from_host import from_host
from jaxfilters.models.face.correlation import cut, score_points
from jaxfilters.models.face.rig import CameraRig

NEAREST, FARTHEST = 350.0, 1200.0
"""Millimetres between which a head is looked for."""
RELIEF = 70.0
"""Millimetres by which the landmarks of one head may differ in depth from its middle."""
ASIDE = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Pixels from the epipolar line at which windows are compared: calibrations err."""
SIZE = 16
"""Pixels of the compared windows."""
_STEPS = (1.0, 0.8, 0.6, 0.5)
"""Pixels between the scores that parabolas are laid through, one refinement after the other."""


def match(
    images: UInt8[np.ndarray, "C rows cols"],
    rig: CameraRig,
    points: Float[np.ndarray, "K 2"],
    *,
    source: int,
    target: int,
) -> tuple[Float[np.ndarray, "K 2"], Float[np.ndarray, " K"]]:
    """Pixels in the target image, to a part of one, of points in the source image, and the windows' correlations.

    Windows about the images of each point at depths from `NEAREST` to `FARTHEST` are compared with the window about
    it; any rig has such lines, rectified or not. All points belong to one head: the depth is taken at which their best
    scores within `RELIEF` are largest together, then the best score of each near it, so that what repeats along one
    line does not mislead. Each match is moved to the vertex of its score.
    """
    inverse = _inverse_depths(rig, points, source, target)
    line = projected_at(rig, points, inverse, source=source, target=target)
    along = np.gradient(line, axis=1)
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.where(length > 0, length, 1.0)
    places = line[:, :, None] + np.asarray(ASIDE)[:, None] * normal[:, :, None]
    templates = windows(images[source], points)
    scores = _scores(images[target], templates, places)
    near = np.abs(1 / inverse[:, None] - 1 / inverse) < RELIEF
    best = scores.max(axis=2)
    together = [best[:, row].max(axis=1).sum() for row in near]
    here = near[int(np.argmax(together))][:, None]
    chosen = np.where(here, scores, -2.0).reshape(len(points), -1).argmax(axis=1)
    start = places.reshape(len(points), -1, 2)[np.arange(len(points)), chosen]
    return _refined(images[target], templates, start)


def projected_at(
    rig: CameraRig,
    points: Float[np.ndarray, "K 2"],
    inverse_depths: Float[np.ndarray, " n"],
    *,
    source: int,
    target: int,
) -> Float[np.ndarray, "K n 2"]:
    """Pixels of the target camera at which it has the source's points, were they at 1 / depth; NaN behind it.

    At inverse depths below 0 they are on the lines' other side of infinity.
    """
    K, R, t = (np.asarray(a, float) for a in (rig.focal, rig.rotation, rig.translation))
    center = np.asarray(rig.center, float)
    turn = R[target] @ R[source].T
    shift = t[target] - turn @ t[source]
    rays = np.column_stack([(points - center[source]) / K[source], np.ones(len(points))])
    observed = (rays @ turn.T)[:, None] + inverse_depths[:, None] * shift
    depth = np.where(observed[..., 2:] > 1e-3, observed[..., 2:], np.nan)
    return observed[..., :2] / depth * K[target] + center[target]


def windows(image: UInt8[np.ndarray, "rows cols"], points: Float[np.ndarray, "K 2"]) -> Float[Array, "K T T"]:
    """Windows about points, as templates."""
    return _cut(jnp.asarray(image), from_host(points))


def _inverse_depths(rig: CameraRig, points: np.ndarray, source: int, target: int) -> Float[np.ndarray, " n"]:
    """As many as there are pixels along the longest line, or a few more: few lengths, few compiled programs."""
    ends = projected_at(rig, points, np.array([1 / FARTHEST, 1 / NEAREST]), source=source, target=target)
    longest = max(64.0, np.nan_to_num(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)).max())
    return np.linspace(1 / FARTHEST, 1 / NEAREST, 2 ** int(np.clip(np.ceil(np.log2(longest)), 6, 11)))


def _refined(image: np.ndarray, templates: Array, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points at the vertices of the scores, along both axes in turn, and their scores."""
    offsets = np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)], float)
    uv = np.array(start, float)
    for step in _STEPS:
        s = _scores(image, templates, uv[:, None] + step * offsets)
        before, after = s[:, [1, 3]], s[:, [2, 4]]
        curvature = np.minimum(before - 2 * s[:, :1] + after, -1e-6)
        uv += step * np.clip(0.5 * (before - after) / curvature, -1, 1)
    # As many places as before, of which one counts: the same program.
    return uv, _scores(image, templates, np.repeat(uv[:, None], len(offsets), axis=1))[:, 0]


def _scores(image: np.ndarray, templates: Array, places: np.ndarray) -> np.ndarray:
    """Correlation (K, ...) of each template with the windows about its own places (K, ..., 2)."""
    flat = from_host(places.reshape(len(places), -1, 2))
    return np.asarray(_all_scores(jnp.asarray(image), templates, flat)).reshape(places.shape[:-1])


@jax.jit
def _cut(image: Array, points: Array) -> Array:
    return cut(image, points, SIZE)


@jax.jit
def _all_scores(image: Array, templates: Array, places: Array) -> Array:
    # One landmark after the other: their windows together would not fit the cache.
    return jax.lax.map(lambda of: score_points(image, *of), (templates, places))
