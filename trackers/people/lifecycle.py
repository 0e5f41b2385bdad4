"""Who is there: births where nobody explains the foreground, confirmation, loss, and memory of those who left.

Births are looked for at floor points half a step apart.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters._full_precision import dot, einsum
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters._xla.from_host import from_host
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.floor_camera import FloorCamera
from jaxfilters.models.person import foreground
from jaxfilters.models.person.ellipsoid import VISIBLE, outline, standing
from jaxfilters.models.person.foreground import contrast, log_likelihood_ratio, presence
from jaxfilters.models.person.scene import nearest_on_border, walkable
from jaxfilters.trackers.people.appearance import BINS, dissimilarity, is_meeting
from jaxfilters.trackers.people.fit import Fit
from jaxfilters.trackers.people.silhouette_bias import edge_covariance
from jaxfilters.trackers.people.silhouettes import OVERLAP, area_of, body_of, presence_of
from jaxfilters.trackers.people.state import (
    DETECTABILITY_PRIOR,
    DORMANT,
    FREE,
    HEIGHT,
    NUM_BIASES,
    STATE,
    TENTATIVE,
    TRACKED,
    WIDTH,
    CameraFrame,
    Cells,
    People,
    PeopleConfig,
    PeopleScene,
    chosen,
)

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
MOST_LOG_ODDS = 8.0
HIDDEN_SHARE = 0.1
"""Below this share of the silhouette there is nothing to see of a person; a head and shoulders over a wall are more."""
HIDDEN_COST = 0.5
"""Log odds per second lost by a person of whom nothing is visible: people can be hidden, but not for ever."""
LEAST_SURPLUS = 0.5
"""Mean log likelihood ratio a pixel in view that two people explain beyond what one of them explains alone."""
MOST_GAIN = 2.0
"""Log odds a frame: the most that a person loses to a candidate who explains the same silhouette better."""
SUPERFLUOUS_COST = 3.0
"""Log odds per second lost by a person who is all in view and explains less than that. With 2 or 4 PETS is the same;
with 8 people who hide one another are lost, and its MOTA falls from 99 to 93."""
AWAY_SD = 2.0
"""Standard deviations beyond the border of the floor from which on a person has left it."""
LOST_SD_M = 1.2
"""A place known no better than this is no place."""
LOST_BIRTH_SDS = 2.0
"""Where cameras tell distances worse than that, the same in standard deviations of a birth."""
LIKENESS = 0.2
"""Dissimilarity up to which a person who comes may be a person who left. Between means of 10 and of 5 frames it accepts
67 to 95 % of the same and 1 to 4 % of other persons in frames 0 to 199 of the three videos of PETS, on which it was
chosen, and 66 to 99 % and 6 to 12 % in frames 200 to 399."""
LIKENESS_MARGIN = 0.04
"""By how much another who left has to be less similar; otherwise a person who comes is new."""
WALKING_M_PER_S = 2.0
LEARNING_RATE = 0.1
"""Least share of a new appearance in the kept one; the first ten appearances have equal shares."""
BIRTH_SD_M = 0.3
"""Of the place of a birth, from the distance between cells."""
_LEAST_INFORMATION = 0.01
"""Inverse square metres: a place that no silhouette fixes is still somewhere on the floor."""


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
    xy = from_host(_filled(points), jnp.float32)
    views = [_expected_view(camera, depth, config, xy) for camera, depth in zip(cameras, furniture, strict=True)]
    observed = np.max([np.asarray(view.share) for view in views], axis=0) >= LEAST_SHARE
    (kept,) = np.nonzero((observed & np.asarray(walkable(jnp.asarray(floor), xy)))[: len(points)])
    if not len(kept):
        raise ValueError("floor: no camera sees half of a person anywhere on it; check units (metres) and cameras.")
    pixels, presence, share, area = zip(*(_rows(view, kept) for view in views), strict=True)
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


class _ExpectedView(NamedTuple):
    """One camera's part of `Cells`."""

    pixels: Int32[Array, "cells samples"]
    presence: Float[Array, "cells samples"]
    share: Float[Array, " cells"]
    area: Float[Array, " cells"]


@partial(compiled_quickly, static_argnums=2)
def _expected_view(camera, furniture, config, xy):
    offsets = _offsets()
    rows, cols = camera.shape
    step = stride(camera.shape)
    reduced_rows, reduced_cols = -(-rows // step), -(-cols // step)

    def one(xy):
        contour = outline(camera.P, standing(xy, config.height_m, config.width_m))
        # Ellipse coordinates along the image of the vertical axis and across, so that feet are below.
        uv = contour.center + dot(offsets, jnp.linalg.cholesky(contour.shape[::-1, ::-1])[::-1, ::-1].T)
        u, v = jnp.round(uv[:, 0] / step).astype(jnp.int32), jnp.round(uv[:, 1] / step).astype(jnp.int32)
        inside = (u >= 0) & (u < reduced_cols) & (v >= 0) & (v < reduced_rows) & (contour.code == VISIBLE)
        u, v = jnp.clip(u, 0, reduced_cols - 1), jnp.clip(v, 0, reduced_rows - 1)
        free = inside & (furniture[jnp.minimum(v * step, rows - 1), jnp.minimum(u * step, cols - 1)] > contour.depth)
        weight = presence(camera.P, xy, config.height_m, config.width_m, uv, config.spread_px)
        index = jnp.where(free, v * reduced_cols + u, reduced_rows * reduced_cols)
        return _ExpectedView(index, weight, jnp.sum(weight * free) / weight.sum(), area_of(contour) / step**2)

    return jax.vmap(one)(xy)


def birth(
    scene: PeopleScene,
    places: Float[Array, "slots shape"],
    active: Bool[Array, " slots"],
    frames: tuple[CameraFrame, ...],
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


def after_gap(config: PeopleConfig, people: People, dt: Float[Array, ""]) -> People:
    """Modes when nothing has come for `dt` seconds: across more than `hidden_s`, nobody is followed.

    Otherwise the image at the end of the gap would count whoever stands near as a person of before the gap.
    """
    return people._replace(mode=_ended(people.mode, is_active(people.mode) & (dt > config.hidden_s)))


def is_active(mode: Int32[Array, " slots"]) -> Bool[Array, " slots"]:
    """Who is followed: a person, or a candidate who may be a mistake."""
    return (mode == TENTATIVE) | (mode == TRACKED)


def _ended(mode: Int32[Array, " slots"], gone: Bool[Array, " slots"]) -> Int32[Array, " slots"]:
    """Modes where those who are `gone` stay as dormant if they were tracked, and are removed if they were not."""
    return jnp.where(gone, jnp.where(mode == TRACKED, DORMANT, FREE), mode)


def existence(scene: PeopleScene, people: People, fit: Fit, dt: Float[Array, ""], looked: Bool[Array, ""]) -> People:
    """Log odds and modes after a frame that `looked` at the scene."""
    config, active = scene.config, is_active(people.mode)
    hidden = fit.share_seen < HIDDEN_SHARE
    change = jnp.where(hidden, -HIDDEN_COST * dt, jnp.clip(fit.score, -2.0, 1.0))
    change = jnp.minimum(change, -_costs_of_pairs(people.mode == TRACKED, fit, dt)) * looked
    log_odds = jnp.where(active, jnp.minimum(people.log_odds + change, MOST_LOG_ODDS), people.log_odds)
    unseen = jnp.where(active & ~hidden & looked, 0.0, people.unseen_s + dt)
    sd = _largest_sd(people.belief.covariance[:, :2, :2])
    births = jax.vmap(birth_covariance, in_axes=(None, 0))(scene, people.belief.mean[:, :2])
    lost = sd > jnp.maximum(LOST_SD_M, LOST_BIRTH_SDS * _largest_sd(births))
    away = _is_away(scene, people.belief)
    gone = active & ((log_odds < config.dropped) | (unseen > config.hidden_s) | lost | away)
    gone |= (people.mode == TENTATIVE) & (unseen > 0.5)
    mode = _ended(people.mode, gone)
    mode = jnp.where((mode == DORMANT) & (unseen > config.memory_s + config.hidden_s), FREE, mode)
    mode = jnp.where((mode == TENTATIVE) & (log_odds > config.confirmed), TRACKED, mode)
    return people._replace(log_odds=log_odds, unseen_s=unseen, mode=mode)


def _costs_of_pairs(is_tracked: Bool[Array, " slots"], fit: Fit, dt: Float[Array, ""]) -> Float[Array, " slots"]:
    """Log odds lost by each person who is one too many of two; minus infinity, that is nothing, by all others.

    A person whom one other person explains as well is hidden behind that person, or nobody. What furniture hides does
    not speak for nobody: of a person who is tracked, less is expected, and less follows. Holes do not either. A senior
    whose silhouette a candidate explains better from elsewhere loses the evidence that speaks for the candidate.
    """
    slots, in_view = jnp.arange(len(is_tracked)), fit.share_in_view
    one_suffices = fit.surplus < LEAST_SURPLUS * jnp.where(is_tracked, in_view * fit.detectability, 1.0)
    a_second = (HIDDEN_COST + (SUPERFLUOUS_COST - HIDDEN_COST) * in_view) * dt
    of_junior = jnp.where(is_tracked, a_second, LEAST_SURPLUS - fit.surplus)
    gain = jnp.clip(fit.score - fit.surplus, 0.0, MOST_GAIN)
    of_senior = jnp.maximum(a_second, jnp.where(is_tracked, 0.0, gain)[:, None])  # of each pair, by slot of the senior
    cost = jnp.where(jnp.eye(len(slots), dtype=bool), of_junior[:, None], of_senior)
    return jnp.max(jnp.where(one_suffices[:, None] & (fit.superfluous[:, None] == slots), cost, -jnp.inf), axis=0)


def _largest_sd(covariance: Float[Array, "slots 2 2"]) -> Float[Array, " slots"]:
    """Of X and Y."""
    return jnp.sqrt(jnp.max(jnp.diagonal(covariance, axis1=1, axis2=2), axis=-1))


def _is_away(scene: PeopleScene, belief: Gaussian) -> Bool[Array, " slots"]:
    """Who is beyond the border of the floor by more than the place is uncertain in that direction."""
    xy = belief.mean[:, :2]
    beyond = xy - nearest_on_border(scene.floor, xy)
    distance = jnp.linalg.norm(beyond, axis=-1)
    normal = beyond / jnp.maximum(distance, 1e-6)[:, None]
    sd = jnp.sqrt(einsum("ki,kij,kj->k", normal, belief.covariance[:, :2, :2], normal))
    return ~walkable(scene.floor, xy) & (distance > AWAY_SD * sd)


def seniority(people: People) -> Float[Array, " slots"]:
    """Higher for who is the less likely to be a mistake: the tracked by identity, then the tentative by log odds.

    The tracked are counted by integers: a float32 does not distinguish large identities.
    """
    tracked, identity = people.mode == TRACKED, people.identity
    juniors = jnp.sum(tracked & (identity > identity[:, None]), axis=1)
    tentative = people.log_odds - 1e-3 * jnp.arange(len(identity))
    return jnp.where(tracked, MOST_LOG_ODDS + 1.0 + juniors, tentative)


def with_appearances(people: People, histograms: Float[Array, "slots 128"], good: Bool[Array, " slots"]) -> People:
    """Appearances with what this frame shows of those who are certainly who they are said to be."""
    good &= ~is_meeting(people.meetings)
    frames = people.appearance_frames + good
    share = jnp.maximum(1 / jnp.maximum(frames, 1), LEARNING_RATE)[:, None]
    mean = people.appearance + share * (histograms - people.appearance)
    return people._replace(appearance=jnp.where(good[:, None], mean, people.appearance), appearance_frames=frames)


def named(people: People) -> People:
    """Identities for the confirmed: that of a person who left, where place and clothes agree, or a new one."""

    def one(k, people):
        reach = 1.0 + WALKING_M_PER_S * people.unseen_s
        apart = jnp.linalg.norm(people.belief.mean[:, :2] - people.belief.mean[k, :2], axis=-1)
        unlike = dissimilarity(people.appearance, people.appearance[k])
        cost = jnp.where((people.mode == DORMANT) & (apart < reach) & (unlike < LIKENESS), unlike, jnp.inf)
        old = jnp.argmin(cost)
        back = cost[old] + LIKENESS_MARGIN < jnp.min(cost.at[old].set(jnp.inf))
        identity = jnp.where(back, people.identity[old], people.next_identity)
        return people._replace(
            identity=people.identity.at[k].set(identity),
            mode=people.mode.at[old].set(jnp.where(back, FREE, people.mode[old])),
            next_identity=people.next_identity + ~back,
        )

    fresh = (people.mode == TRACKED) & (people.identity < 0)
    order = jnp.argsort(~fresh)
    people = jax.lax.fori_loop(0, jnp.sum(fresh), lambda turn, p: one(order[turn], p), people)
    return people._replace(identity=jnp.where(people.mode == FREE, -1, people.identity))


def confirm(scene: PeopleScene, people: People, found: Birth) -> People:
    """With the birth in a free slot; without one, in that of whoever left and was not observed for longest.

    Where everybody is followed, nobody is added.
    """
    config, n = scene.config, len(people.mode)
    left_s = jnp.where(people.mode == DORMANT, people.unseen_s, -jnp.inf)
    preference = jnp.where(people.mode == FREE, jnp.inf, left_s)
    best = jnp.argmax(preference)
    slot = (jnp.arange(n) == best) & (preference[best] >= 0) & found.found
    mean = jnp.zeros(STATE).at[:2].set(found.xy).at[HEIGHT].set(config.height_m).at[WIDTH].set(config.width_m)
    speed, size = [config.speed_sd] * 2, [config.height_sd_m, config.width_sd_m]
    sd = jnp.array([0.0, 0.0, *speed, *size, *[1.0] * NUM_BIASES])
    covariance = jnp.diag(sd**2).at[:2, :2].set(birth_covariance(scene, found.xy))
    fresh = Gaussian(jnp.broadcast_to(mean, (n, STATE)), jnp.broadcast_to(covariance, (n, STATE, STATE)))
    return people._replace(
        belief=chosen(slot, fresh, people.belief),
        mode=jnp.where(slot, TENTATIVE, people.mode),
        identity=jnp.where(slot, -1, people.identity),
        log_odds=jnp.where(slot, 0.0, people.log_odds),
        unseen_s=jnp.where(slot, 0.0, people.unseen_s),
        appearance=jnp.where(slot[:, None], 1 / BINS, people.appearance),
        appearance_frames=jnp.where(slot, 0, people.appearance_frames),
        shift=jnp.where(slot[:, None, None], 0.0, people.shift),
        detectability=jnp.where(slot[:, None], jnp.array(DETECTABILITY_PRIOR), people.detectability),
    )


def birth_covariance(scene: PeopleScene, xy: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Of the place of a birth, square metres: that of the grid of cells, and of edges in the reduced image.

    An edge that is a pixel of the reduced image too low moves a person who is looked at under a small angle by metres.
    A belief that is surer than that keeps the error for seconds, as a bias of the silhouette.
    """
    config = scene.config
    edges_px = [float(stride(camera.shape)) for camera in scene.cameras]
    known = jnp.zeros((3, 3)).at[2, 2].set(1 / config.height_sd_m**2) + _LEAST_INFORMATION * jnp.eye(3)
    covariance = edge_covariance(scene, xy, jnp.asarray(config.height_m), edges_px, known)
    return covariance[:2, :2] + BIRTH_SD_M**2 * jnp.eye(2)
