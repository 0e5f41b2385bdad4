"""The tracker of Kato, Nakazawa, Inokuchi (1999) as they published it: what the modern one is measured against.

Binary silhouettes, nine candidates three times a frame, a ternary score; numbers in brackets are the paper's
equations.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters._full_precision import dot
from jaxfilters.models.person.ellipsoid import CROSSING, Ellipsoid, ellipse_mask, outline, standing
from jaxfilters.models.person.foreground import lattice, quadratic_fit
from jaxfilters.models.person.scene import walkable
from jaxfilters.models.person.score import match_score, ternary_mask
from jaxfilters.trackers.published.people_scene import PaperConfig, PaperScene

ACQUIRE, TRACK, LOST, OUTSIDE = range(4)
MODE_NAMES = ("acquire", "track", "lost", "outside")
"""Searched for by binary images alone, since the place is poorly known; followed; not found for long; out of view."""
HEIGHT_M, WIDTH_M = 1.65, 0.40
"""Of the paper's ellipsoid."""
PROFILE_M, CURVATURE_STEP_M = 0.3, 0.1
"""Along the line of sight, for the flatness; in both directions, for the curvature."""
LEAST_CURVATURE = 0.1
"""Inverse square metres of the score: below it a direction counts as hardly observed."""


class PaperState(NamedTuple):
    """Everybody, one slot each; a slot whose `active` is set to False is free again."""

    xy: Float[Array, "slots 2"]
    """Metres."""
    size: Float[Array, "slots 2"]
    """Height and width, metres."""
    mode: Int32[Array, " slots"]
    active: Bool[Array, " slots"]
    low_frames: Int32[Array, " slots"]
    """For how many frames in turn the score has been low."""


class PaperReport(NamedTuple):
    """What one frame says of each slot."""

    score: Float[Array, " slots"]
    """[5] of the chosen candidate, binary in mode `ACQUIRE`; `-inf` for those who are not searched for."""
    is_stuck: Bool[Array, " slots"]
    """No candidate could be drawn in some pass: none is walkable, or all reach through the camera's plane."""


def paper_start(config: PaperConfig) -> PaperState:
    """The state before anybody has come."""
    n = config.capacity
    size = jnp.broadcast_to(jnp.array([HEIGHT_M, WIDTH_M]), (n, 2))
    none = jnp.zeros(n, jnp.int32)
    return PaperState(jnp.zeros((n, 2)), size, none, none.astype(bool), none)


def with_person(
    state: PaperState, xy: ArrayLike | Sequence, *, height_m: float = HEIGHT_M, width_m: float = WIDTH_M
) -> PaperState:
    """A new person, as from another sensor, in the first free slot; in mode `ACQUIRE`.

    Raises:
        ValueError: a position that is not two finite numbers, a size that is not positive, or no free slot.
    """
    place = np.asarray(xy, float)
    if place.shape != (2,) or not np.all(np.isfinite(place)):
        raise ValueError(f"xy must be two finite numbers, in metres; got {place}.")
    if not (0 < height_m < np.inf and 0 < width_m < np.inf):
        raise ValueError(f"height_m and width_m must be positive; got {height_m!r}, {width_m!r}.")
    taken = np.asarray(state.active)
    if taken.all():
        raise ValueError(f"all {len(taken)} slots are taken; a larger capacity is needed.")
    slot = int(np.argmin(taken))
    return PaperState(
        state.xy.at[slot].set(jnp.asarray(place, state.xy.dtype)),
        state.size.at[slot].set(jnp.array([height_m, width_m], state.size.dtype)),
        state.mode.at[slot].set(ACQUIRE),
        state.active.at[slot].set(True),
        state.low_frames.at[slot].set(0),
    )


def candidate_positions(
    xy: Float[Array, " 2"], axes: Float[Array, "2 2"], step: Float[Array, ""]
) -> Float[Array, "9 2"]:
    """The nine places a step apart along two axes, the unmoved one first and the corners last."""
    offsets = lattice(2)
    # The first of equal scores is taken: it moves least.
    nearest_first = offsets[jnp.argsort(jnp.sum(offsets**2, axis=-1))]
    return xy + dot(step * nearest_first, axes)


@jax.jit
def paper_step(scene: PaperScene, state: PaperState, mask: Bool[Array, "rows cols"]) -> tuple[PaperState, PaperReport]:
    """One frame further: those in view moved to their best candidates, one at a time, and modes brought up to date.

    Raises:
        ValueError: a mask of another size than the camera's image, or not of bool.
    """
    _check_mask(scene, mask)
    config, passes = scene.config, len(scene.config.steps_m)
    state = _in_view(scene, state)
    searched = _searched(state)
    real, steps, axes = ternary_mask(mask, config.ring_px), jnp.array(config.steps_m), scene.camera.floor_axes()
    order, people = jnp.argsort(~searched), jnp.sum(searched)

    def one_turn(turn, carry):
        xy, drawn, report = carry
        which, place = config.turns(turn, passes, people)
        k = order[place]
        bodies = _bodies(candidate_positions(xy[k], axes, steps[which]), state.size[k])
        masks, is_drawable = jax.vmap(_drawn, in_axes=(None, 0))(scene, bodies)
        is_possible = is_drawable & walkable(scene.floor, bodies.center[:, :2])
        others = jnp.any(drawn.at[k].set(False), axis=0)
        counted = config.region(scene.camera, bodies, config.ring_px)
        scores = jax.lax.cond(
            state.mode[k] == ACQUIRE,
            lambda: jax.vmap(match_score, in_axes=(0, None))(masks, mask),
            lambda: _together(config, masks, others, real, counted),
        )
        scores = jnp.where(is_possible, scores, -jnp.inf)
        best, stuck = jnp.argmax(scores), ~jnp.any(is_possible)
        report = PaperReport(
            report.score.at[k].set(scores[best]), report.is_stuck.at[k].set(report.is_stuck[k] | stuck)
        )
        return xy.at[k].set(bodies.center[best, :2]), drawn.at[k].set(masks[best]), report

    drawn = jax.vmap(_drawn, in_axes=(None, 0))(scene, _bodies(state.xy, state.size))[0] & searched[:, None, None]
    nothing = PaperReport(jnp.full(len(searched), -jnp.inf), jnp.zeros(len(searched), bool))
    xy, _, report = jax.lax.fori_loop(0, passes * people, one_turn, (state.xy, drawn, nothing))
    return _evaluated(config, state._replace(xy=xy), searched, report.score), report


class Profile(NamedTuple):
    """How well the score says where a person is, one row a slot; meaningless for those who are not searched for."""

    flatness: Float[Array, " slots"]
    """How much the score drops 0.3 m nearer or farther along the line of sight (section 4, E2)."""
    covariance: Float[Array, "slots 2 2"]
    """Of X and Y from the curvature of the score, square metres; in units of the variance of one look."""


def score_profile(
    scene: PaperScene, state: PaperState, mask: Bool[Array, "rows cols"], *, looks: float = 40.0
) -> Profile:
    """Flatness and covariance of everybody around where they are.

    A score E of `looks` independent patches is taken for a log likelihood `looks * E`; directions in which it is not
    curved get the variance `1 / (looks * LEAST_CURVATURE)`.

    Raises:
        ValueError: a mask of another size than the camera's image, or not of bool.
    """
    _check_mask(scene, mask)
    return _profile(scene, state, mask, jnp.asarray(looks, float))


@jax.jit
def _profile(scene, state, mask, looks):
    real, searched = ternary_mask(mask, scene.config.ring_px), _searched(state)
    drawn = jax.vmap(_drawn, in_axes=(None, 0))(scene, _bodies(state.xy, state.size))[0] & searched[:, None, None]
    offsets = jnp.concatenate([CURVATURE_STEP_M * lattice(2), jnp.array([[-PROFILE_M, 0.0], [PROFILE_M, 0.0]])])

    def one(k):
        away = state.xy[k] - scene.camera.position()[:2]
        x, y = away / jnp.maximum(jnp.linalg.norm(away), 1e-6)
        axes = jnp.stack([jnp.stack([x, y]), jnp.stack([y, -x])])
        bodies = _bodies(state.xy[k] + dot(offsets, axes), state.size[k])
        masks, _ = jax.vmap(_drawn, in_axes=(None, 0))(scene, bodies)
        others = jnp.any(drawn.at[k].set(False), axis=0)
        counted = scene.config.region(scene.camera, bodies, scene.config.ring_px)
        scores = jnp.maximum(_together(scene.config, masks, others, real, counted), -1.0)
        fit = quadratic_fit(scores[:9], jnp.full(2, CURVATURE_STEP_M))
        curvature, vectors = jnp.linalg.eigh(fit.curvature)
        roots = dot(vectors.T, axes) / jnp.sqrt(looks * jnp.maximum(curvature, LEAST_CURVATURE))[:, None]
        return Profile(scores[4] - jnp.max(scores[9:]), dot(roots.T, roots))

    return jax.lax.map(one, jnp.arange(len(searched)))


def _check_mask(scene, mask):
    if mask.shape != scene.camera.shape:
        raise ValueError(f"mask must have the shape of the camera's image, {scene.camera.shape}; got {mask.shape}.")
    if mask.dtype != bool:
        raise ValueError(f"mask must be of bool; got {mask.dtype}.")


def _bodies(xy: Array, size: Array) -> Ellipsoid:
    return standing(xy, size[..., 0], size[..., 1])


def _searched(state: PaperState) -> Array:
    return state.active & ((state.mode == ACQUIRE) | (state.mode == TRACK))


def _drawn(scene: PaperScene, body: Ellipsoid) -> tuple[Array, Array]:
    """The silhouette behind obstacles, and whether it could be drawn: not if it reaches through the camera's plane."""
    contour = outline(scene.camera.P, body)
    mask = ellipse_mask(contour, scene.camera.shape)
    return mask & scene.config.occlusion.is_in_front(scene.camera, body, scene.obstacles), contour.code != CROSSING


def _together(config: PaperConfig, masks: Array, others: Array, real: Array, counted: Array) -> Array:
    """[5] of each of the candidates' silhouettes, drawn with those of the others."""

    def score(mask):
        return match_score(ternary_mask(mask | others, config.ring_px) * counted, real)

    return jax.vmap(score)(masks)


def _in_view(scene: PaperScene, state: PaperState) -> PaperState:
    """Who left the image is outside, and who is in it again has to be found again."""
    in_view = jax.vmap(scene.config.in_view, in_axes=(None, 0))(scene.camera, _bodies(state.xy, state.size))
    mode = jnp.where(in_view, jnp.where(state.mode == OUTSIDE, ACQUIRE, state.mode), OUTSIDE)
    mode = jnp.where(state.mode == LOST, LOST, mode)
    return state._replace(mode=mode, low_frames=jnp.where(mode == OUTSIDE, 0, state.low_frames))


def _evaluated(config: PaperConfig, state: PaperState, searched: Array, score: Array) -> PaperState:
    low_frames = jnp.where(searched, jnp.where(score < config.lost, state.low_frames + 1, 0), state.low_frames)
    found = (state.mode == ACQUIRE) & (score > config.acquired)
    mode = jnp.where(searched & found, TRACK, state.mode)
    mode = jnp.where(searched & (low_frames >= config.lost_frames), LOST, mode)
    return state._replace(mode=mode, low_frames=low_frames)
