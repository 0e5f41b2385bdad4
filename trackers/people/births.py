"""People nobody knows yet: foreground that nobody explains, looked for at floor points half a step apart."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import VISIBLE, outline, standing
from jaxfilters.models.person.foreground import contrast, log_likelihood_ratio, presence
from jaxfilters.models.person.scene import walkable
from jaxfilters.trackers.people.silhouettes import OVERLAP, area_of, body_of, presence_of
from jaxfilters.trackers.people.state import CameraFrame, Cells, PeopleConfig, PeopleScene

REDUCED_COLS = 160
"""Columns of the images in which births are looked for, at most."""
SAMPLES = (12, 6)
"""Over the box of an ellipse half as wide and high again: rows and columns."""
MARGIN = 1.25
LEAST_SHARE = 0.5
"""Of the samples that an image must show for a person to be found there."""

_WINDOW = (2, 4)
"""Parts of an image, in rows and columns, one of which holds most people; larger ones are covered in all of it."""
LEAST_CELLS = 1024
"""A room of 90 square metres."""


class Birth(NamedTuple):
    """Where a person may have come in this frame."""

    xy: Float[Array, " 2"]
    """Metres."""
    found: Bool[Array, ""]


def cells_of(
    cameras: tuple[FloorCamera, ...], furniture: tuple[Array, ...], floor: np.ndarray, config: PeopleConfig
) -> Cells:
    """All floor points that some camera sees well enough, and what to look at for each.

    Raises:
        ValueError: if no camera sees a person anywhere on the floor.
    """
    low, high = floor.min(axis=0), floor.max(axis=0)
    axes = [np.arange(a + config.cell_m / 2, b, config.cell_m) for a, b in zip(low, high, strict=True)]
    points = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=-1)
    xy = jnp.asarray(_filled(points), jnp.float32)
    looks = [_look(camera, depth, config, xy) for camera, depth in zip(cameras, furniture, strict=True)]
    observed = np.max([np.asarray(look.share) for look in looks], axis=0) >= LEAST_SHARE
    (kept,) = np.nonzero((observed & np.asarray(walkable(jnp.asarray(floor), xy)))[: len(points)])
    if not len(kept):
        raise ValueError("floor: no camera sees half of a person anywhere on it; check units (metres) and cameras.")
    pixels, presence, share, area = zip(*(_rows(look, kept) for look in looks), strict=True)
    return Cells(_rows(xy, kept), pixels, presence, share, area)


def _rows(tree, kept: np.ndarray):
    """Of all leaves; by NumPy, as there is a new number of them for every floor."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[kept]), tree)


def padded(cells: Cells) -> Cells:
    """The same cells and some that no camera sees: one compilation for each power of two, not for each number."""
    return jax.tree.map(lambda leaf: jnp.asarray(_filled(np.asarray(leaf))), cells)


def _filled(rows: np.ndarray) -> np.ndarray:
    more = max(LEAST_CELLS, 1 << (len(rows) - 1).bit_length()) - len(rows)
    return np.pad(rows, [(0, more), *[(0, 0)] * (rows.ndim - 1)])


def _offsets():
    v, u = jnp.meshgrid(*[MARGIN * (2 * (jnp.arange(n) + 0.5) / n - 1) for n in SAMPLES], indexing="ij")
    return jnp.stack([u.ravel(), v.ravel()], axis=-1)


def stride(shape: tuple[int, int]) -> int:
    """Every how many pixels one is looked at."""
    return max(1, -(-shape[1] // REDUCED_COLS))


class _Look(NamedTuple):
    """One camera's part of `Cells`."""

    pixels: Int32[Array, "cells samples"]
    presence: Float[Array, "cells samples"]
    share: Float[Array, " cells"]
    area: Float[Array, " cells"]


@partial(jax.jit, static_argnums=2)
def _look(camera, furniture, config, xy):
    offsets = _offsets()
    rows, cols = camera.shape
    step = stride(camera.shape)
    reduced_rows, reduced_cols = -(-rows // step), -(-cols // step)

    def one(xy):
        contour = outline(camera.P, standing(xy, config.height_m, config.width_m))
        # Ellipse coordinates along the image of the vertical axis and across, so that feet are below.
        uv = contour.center + offsets @ jnp.linalg.cholesky(contour.shape[::-1, ::-1])[::-1, ::-1].T
        u, v = jnp.round(uv[:, 0] / step).astype(jnp.int32), jnp.round(uv[:, 1] / step).astype(jnp.int32)
        inside = (u >= 0) & (u < reduced_cols) & (v >= 0) & (v < reduced_rows) & (contour.code == VISIBLE)
        u, v = jnp.clip(u, 0, reduced_cols - 1), jnp.clip(v, 0, reduced_rows - 1)
        free = inside & (furniture[jnp.minimum(v * step, rows - 1), jnp.minimum(u * step, cols - 1)] > contour.depth)
        weight = presence(camera.P, xy, config.height_m, config.width_m, uv, config.spread_px)
        index = jnp.where(free, v * reduced_cols + u, reduced_rows * reduced_cols)
        return _Look(index, weight, jnp.sum(weight * free) / weight.sum(), area_of(contour) / step**2)

    return jax.vmap(one)(xy)


def birth(
    scene: PeopleScene, places: Float[Array, "slots 4"], active: Bool[Array, " slots"], frames: tuple[CameraFrame, ...]
) -> Birth:
    """The floor point whose person explains most, of those with enough evidence a pixel.

    The mean over a silhouette says whether a person is there, but not where: a person small and far away fits into any
    large silhouette. The sum, which is the log likelihood, says where. One birth a frame: whoever stands beside is
    found in the next, once it is known what the first explains.
    """
    config, cells = scene.config, scene.cells
    total = shares = explained = jnp.zeros(len(cells.xy))
    for camera, depth, frame, index, weight, share, area in zip(
        scene.cameras, scene.furniture, frames, cells.pixels, cells.presence, cells.share, cells.area, strict=True
    ):
        b = jnp.append(_reduced_contrast(scene, camera, depth, places, active, frame).ravel(), 0.0)
        ratio = jax.vmap(log_likelihood_ratio)(weight, b[index])
        observed = frame.present * (share >= LEAST_SHARE)
        total, shares, explained = (
            total + observed * ratio,
            shares + observed * share,
            explained + observed * ratio * area,
        )
    # One sample stands for this share of the ellipse's area.
    per_area = (2 * MARGIN) ** 2 / (jnp.pi * SAMPLES[0] * SAMPLES[1])
    evidence = total * per_area / jnp.maximum(shares, 1e-6)
    found = evidence > config.birth_evidence
    best = jnp.argmax(jnp.where(found, explained, -jnp.inf))
    return Birth(cells.xy[best], found[best])


def _reduced_contrast(scene, camera, furniture, places, active, frame):
    step = stride(camera.shape)
    reduced = jnp.asarray(frame.foreground)[::step, ::step].astype(float) / 255
    v, u = jnp.meshgrid(*[step * jnp.arange(n, dtype=float) for n in reduced.shape], indexing="ij")
    uv, depth = jnp.stack([u, v], axis=-1), furniture[::step, ::step]
    order = jnp.argsort(~active)
    size = tuple(max(1, n // parts) for n, parts in zip(reduced.shape, _WINDOW, strict=True))

    def cover(turn, unexplained):
        place = places[order[turn]]
        body = outline(camera.P, body_of(place))

        def covered(unexplained, uv, depth):
            return unexplained * (1 - presence_of(scene.config, camera.P, place, uv) * (body.depth < depth))

        def around(unexplained):
            middle = body.center[::-1] / step - jnp.array(size) / 2
            low = jnp.clip(jnp.round(middle), 0, jnp.array(reduced.shape) - jnp.array(size)).astype(jnp.int32)
            cut = [jax.lax.dynamic_slice(image, low, size) for image in (unexplained, depth)]
            pixels = jax.lax.dynamic_slice(uv, (*low, 0), (*size, 2))
            return jax.lax.dynamic_update_slice(unexplained, covered(cut[0], pixels, cut[1]), low)

        reach = 2 * OVERLAP * jnp.sqrt(jnp.diagonal(body.shape))[::-1] / step
        is_small = (body.code == VISIBLE) & jnp.all(reach < jnp.array(size))
        return jax.lax.cond(is_small, around, lambda image: covered(image, uv, depth), unexplained)

    free = jnp.full(reduced.shape, 1 - foreground.CLUTTER)
    return contrast(reduced, jax.lax.fori_loop(0, jnp.sum(active), cover, free))
