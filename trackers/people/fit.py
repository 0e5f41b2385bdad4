"""Where the silhouettes say that everybody is: joint search over position and height, and how sure that is."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters._full_precision import dot, einsum
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person import foreground
from jaxfilters.models.person.foreground import Quadratic
from jaxfilters.trackers.people.detectability import ALONE, LEAST_FOR_EXISTENCE, evidence_of, most_probable
from jaxfilters.trackers.people.image_shift import best_shift, has_shifts, shifted, weighted
from jaxfilters.trackers.people.silhouette_bias import bias_factor, pixel_m
from jaxfilters.trackers.people.silhouettes import (
    contrasts_of,
    crowding,
    line_of_sight,
    log_likelihood,
    log_likelihoods,
    observed_place,
    shares_seen,
    unexplained_of,
    views_of,
)
from jaxfilters.trackers.people.state import BIAS, DETECTABILITIES, PLACE, STATE, STRIDE, CameraFrame, PeopleScene
from jaxfilters.trackers.people.stride import longest_stride, with_best_stride, with_stride

LEAST_REACH_M, MOST_REACH_M = 0.16, 0.5
"""How far from the prediction a person is searched for, along each axis."""
HEIGHT_STEP_M = 0.03
"""First step of the search for the height."""
CURVATURE_PX = 1.85
"""Pixels sideways over which the score is taken for a parabola: noise is finer than that, shapes are not."""
LEAST_STEP_M, MOST_STEP_M = 0.045, 0.08
"""Bounds on what these pixels come to in metres."""
STEP_SHARES = (2.0, 1.0, 1.0, 0.9)
"""Steps away from the camera, sideways, in height and in width, in steps sideways."""
FOOT_PX, REACH_FOOT_PX = 1.0, 4.0
"""Pixels by which the step away from the camera moves the feet, at least, and the farthest candidate, at most: under a
small angle a pixel is a large part of a metre of floor."""
PROFILE_M = 0.3
"""Distance along the line of sight at which the score is compared with its maximum (section 4, E2)."""
LEAST_CURVATURE = 0.1
"""Inverse square metres: below it a direction counts as not observed at all. A single silhouette tells the distance of
a person 40 m from a low camera with a standard deviation of one or two metres, which many of them make useful."""
MOST_SHIFT_M = 0.2
"""A reading along a direction in which the score is flat is no farther than this from where the search ended."""
PASSES = 2
NEAR_M, BESIDE_M = 1.5, 0.6
"""Two who are nearer on the floor may be one, and two of whom the nearer to a camera is less than the second of these
from its line of sight to the other: under a small angle, a silhouette fits to places that are metres apart."""
BETWEEN = 5
"""Places from one to the other at which one alone is tried."""

_FAR_M = 1e6


class Fit(NamedTuple):
    """What the images say of everybody, one row a slot."""

    place: Float[Array, "slots 4"]
    """X, Y, height, width: metres; where the likelihood of the images times the prediction is largest."""
    stride: Float[Array, "slots 2"]
    """From the middle of the body to the front foot along X and Y, metres; 0 where legs are together."""
    axes: Float[Array, "slots 4 4"]
    """Rows: unit vectors away from the camera, sideways, along the height and the width."""
    steps: Float[Array, "slots 4"]
    """Metres along `axes` over which the score was taken for a parabola."""
    quadratic: Quadratic
    """The log likelihood around `place`, along `axes`, of all cameras, or of each where they may be wrong; leaves
    (slots, readings, ...)."""
    score: Float[Array, " slots"]
    """Mean log likelihood ratio a pixel, under a detectability of `LEAST_FOR_EXISTENCE` at least."""
    shift: Float[Array, "slots cameras 2"]
    """Of their silhouettes in each image, pixels."""
    shares_seen: Float[Array, "slots cameras"]
    """Of the silhouette, how much each camera shows."""
    flatness: Float[Array, " slots"]
    superfluous: Int32[Array, " slots"]
    """Slot of a person or of the nearest senior: who of the two would be one too many, if one of them explained nearly
    all. The senior is where that one would have to stand far from the senior's place, near the person's."""
    surplus: Float[Array, " slots"]
    """Mean log likelihood ratio a pixel that a person explains which the nearest senior could not explain alone, in
    the best place for that; `inf` without a senior near by, on the floor or in an image."""
    shares_in_view: Float[Array, "slots cameras"]
    """Of the silhouette, how much lies in each image and before furniture, whoever else may be there."""
    crowding: Float[Array, "slots cameras"]
    """Share of the surroundings of the silhouette in each image that is foreground which no other person explains."""
    detectability: Float[Array, " slots"]
    """The most probable value after these images."""
    detection_evidence: Float[Array, "slots values"]
    """Log likelihood ratios of the images under `DETECTABILITIES`; 0 where others may explain the same pixels."""

    @property
    def share_seen(self) -> Float[Array, " slots"]:
        """Of the silhouette, how much the camera shows that shows most."""
        return jnp.max(self.shares_seen, axis=-1)

    @property
    def share_in_view(self) -> Float[Array, " slots"]:
        """Of the silhouette, how much would be visible were nobody else there, in the camera that shows most."""
        return jnp.max(self.shares_in_view, axis=-1)


def fit_people(
    scene: PeopleScene,
    predicted: Gaussian,
    shifts: Float[Array, "slots cameras 2"],
    detectability: Float[Array, "slots values"],
    active: Bool[Array, " slots"],
    seniority: Float[Array, " slots"],
    frames: tuple[CameraFrame, ...],
) -> Fit:
    """Best places of everybody together, in turns, each with the others where they were last found.

    Args:
        scene: Cameras, furniture, floor.
        predicted: Beliefs of all slots.
        shifts: Of their silhouettes after the frame before.
        detectability: Log weights of `DETECTABILITIES` before these images.
        active: Which of them hold a person.
        seniority: Whose presence is the less in doubt, of two of whom one may be a mistake.
        frames: One a camera.
    """
    start = jax.vmap(observed_place, in_axes=(None, 0))(scene, predicted.mean)
    # A stride displaces a silhouette as a shift does: where images may be shifted, legs are taken to be together.
    longest = jnp.zeros_like(start[:, :2]) if has_shifts(scene) else longest_stride(predicted.mean)
    covariance = _observed_covariance(scene, predicted)
    prior = jnp.linalg.inv(covariance + 1e-6 * jnp.eye(4))
    axes = jax.vmap(_axes, in_axes=(None, 0))(scene, start)
    reach = _reach(scene, start, covariance, axes)
    views = jax.vmap(views_of, in_axes=(None, None, 0, 0, 0))(scene, frames, start, axes, reach)
    if has_shifts(scene):
        views = jax.vmap(weighted, in_axes=(None, 0, 0))(scene, start, views)
    order = _nearest_first(scene, views, start, active)

    def one_person(turn, found):
        places, shifts = found
        k = order[turn % num_active]
        unshifted = jax.tree.map(lambda leaf: leaf[k], views)
        mine = shifted(unshifted, shifts[k]) if has_shifts(scene) else unshifted
        unexplained = unexplained_of(scene, places, active.at[k].set(False), mine)
        contrasts = contrasts_of(mine, unexplained)
        alone = jnp.min(unexplained) > ALONE
        if has_shifts(scene):
            shifts = shifts.at[k].set(best_shift(scene, places[k], unshifted, contrasts, shifts[k]))
            mine = shifted(unshifted, shifts[k])
        evidence = evidence_of(scene, places[k], mine, unexplained, contrasts)
        contrasts = most_probable(detectability[k] + evidence) * contrasts

        def best(place, offsets):
            place = with_best_stride(scene, place, longest[k], mine, contrasts, alone)
            candidates = place + with_stride(dot(offsets, axes[k]))
            scores = jax.vmap(log_likelihood, in_axes=(None, 0, None, None))(scene, candidates, mine, contrasts)
            away = candidates[:, : STRIDE.start] - start[k]
            total = scores - einsum("ci,ij,cj->c", away, prior[k], away) / 2
            # Where candidates are equal, the one that moves least: the middle of the lattice comes first.
            nearest_first = jnp.argsort(jnp.sum(offsets**2, axis=-1))
            return candidates[nearest_first[jnp.argmax(total[nearest_first])]]

        offsets = lattices * jnp.append(reach[k] / 2, jnp.array([HEIGHT_STEP_M, 0.0]))
        widest = jnp.where(turn < num_active, 0, 1)
        place = jax.lax.fori_loop(widest, len(lattices), lambda i, p: best(p, offsets[i]), places[k])
        return places.at[k].set(place), shifts

    lattices, num_active = _lattices(), jnp.sum(active)
    places, shifts = jax.lax.fori_loop(0, PASSES * num_active, one_person, (with_stride(start), shifts))
    if has_shifts(scene):
        views = jax.vmap(shifted)(views, shifts)
    return _curvature(scene, places, shifts, detectability, active, seniority, views, axes, _steps(scene, start))


def _lattices():
    """(3, 27, 4): candidates of a wide search, for the first pass only, and two narrow ones, in first steps along axes.

    All are as many, so that one program serves them: the wide one has its middle three times.
    """
    wide, narrow = (dot(foreground.lattice(n, reach), jnp.eye(n, 4)) for n, reach in ((2, 2), (3, 1)))
    middle = jnp.zeros((len(narrow) - len(wide), 4))
    return jnp.stack([jnp.concatenate([wide, middle]), narrow / 2, narrow / 4])


def _curvature(scene, places, shifts, detectability, active, seniority, views, axes, steps) -> Fit:
    around = foreground.lattice(4)
    away = PROFILE_M * jnp.eye(1, 4)
    middle, known = len(around) // 2, most_probable(detectability)
    readings = len(scene.cameras) if has_shifts(scene) else 1

    def by_reading(scene, candidates, mine, contrasts):
        each = log_likelihoods if has_shifts(scene) else log_likelihood
        values = jax.vmap(each, in_axes=(None, 0, None, None), out_axes=-1)(scene, candidates, mine, contrasts)
        return values.reshape(readings, len(candidates))

    def one(k, fits):
        mine = jax.tree.map(lambda leaf: leaf[k], views)
        unexplained = unexplained_of(scene, places, active.at[k].set(False), mine)
        contrasts = contrasts_of(mine, unexplained)
        evidence = evidence_of(scene, places[k], mine, unexplained, contrasts)
        detected = known.at[k].set(most_probable(detectability[k] + evidence))
        exists = jnp.maximum(detected[k], LEAST_FOR_EXISTENCE) * contrasts
        candidates = places[k] + with_stride(dot(jnp.concatenate([around * steps[k], -away, away]), axes[k]))
        values = by_reading(scene, candidates, mine, detected[k] * contrasts)
        scores = jnp.sum(values, axis=0) / scene.config.independent_patches
        fit = Fit(
            places[k, : STRIDE.start],
            places[k, STRIDE],
            axes[k],
            steps[k],
            jax.tree.map(
                lambda *leaves: jnp.stack(leaves), *(foreground.quadratic_fit(v[:-2], steps[k]) for v in values)
            ),
            log_likelihood(scene, places[k], mine, exists) / scene.config.independent_patches,
            shifts[k],
            shares_seen(scene, places[k], mine, unexplained),
            scores[middle] - jnp.maximum(scores[-2], scores[-1]),
            *_surplus(scene, places, detected, active, seniority, views, axes, steps, k, scores[middle]),
            shares_seen(scene, places[k], mine, jnp.ones_like(unexplained)),
            crowding(scene, places[k], mine, unexplained),
            detected[k],
            evidence,
        )
        return jax.tree.map(lambda all_fits, one_fit: all_fits.at[k].set(one_fit), fits, fit)

    empty = _unfitted(places, axes, steps, readings, len(scene.cameras))
    order = jnp.argsort(~active)
    return jax.lax.fori_loop(0, jnp.sum(active), lambda turn, fits: one(order[turn], fits), empty)


def _unfitted(places, axes, steps, readings: int, cameras: int) -> Fit:
    """Of people of whom the images say nothing."""
    n = len(places)
    return Fit(
        places[:, : STRIDE.start],
        places[:, STRIDE],
        axes,
        steps,
        Quadratic(jnp.zeros((n, readings)), jnp.zeros((n, readings, 4)), jnp.zeros((n, readings, 4, 4))),
        jnp.zeros(n),
        jnp.zeros((n, cameras, 2)),
        jnp.zeros((n, cameras)),
        jnp.zeros(n),
        jnp.arange(n, dtype=jnp.int32),
        jnp.full(n, jnp.inf),
        jnp.zeros((n, cameras)),
        jnp.zeros((n, cameras)),
        jnp.ones(n),
        jnp.zeros((n, len(DETECTABILITIES))),
    )


def _surplus(scene, places, detected, active, seniority, views, axes, steps, k, score):
    """Who is one too many, and what k explains beyond what the nearest senior could explain in k's absence.

    That is from wherever it is best, between both places; the nearest is so on the floor or in an image. A senior who
    would have to be far away, near k, has a wrong place, which the search within reach does not leave.
    """
    on_floor = jnp.linalg.norm(places[:, :2] - places[k, :2], axis=-1)
    apart = jnp.minimum(on_floor, _beside(scene, places[:, :2], places[k, :2]) * NEAR_M / BESIDE_M)
    apart = jnp.where(active & (seniority > seniority[k]), apart, jnp.inf)
    senior = jnp.argmin(apart)

    def alone():
        theirs = jax.tree.map(lambda leaf: leaf[senior], views)
        others = active.at[k].set(False).at[senior].set(False)
        contrasts = contrasts_of(theirs, unexplained_of(scene, places, others, theirs))
        contrasts = jnp.maximum(detected[senior], detected[k]) * contrasts
        between = jnp.linspace(0.0, 1.0, BETWEEN)[:, None] * (places[k] - places[senior])[: STRIDE.start]
        offsets = dot(dot(foreground.lattice(2), jnp.eye(2, 4)) * steps[senior], axes[senior])
        candidates = places[senior] + with_stride((between[:, None] + offsets).reshape(-1, 4))
        values = jax.vmap(log_likelihood, in_axes=(None, 0, None, None))(scene, candidates, theirs, contrasts)
        with_k = log_likelihood(scene, places[senior], theirs, contrasts)
        is_nearer_k = jnp.argmax(values) // len(offsets) > BETWEEN // 2
        superfluous = jnp.where(is_nearer_k & (on_floor[senior] > NEAR_M), senior, k).astype(jnp.int32)
        return superfluous, score - (jnp.max(values) - with_k) / scene.config.independent_patches

    def nobody_near():
        return jnp.asarray(k, jnp.int32), jnp.full_like(score, jnp.inf)

    return jax.lax.cond(apart[senior] < NEAR_M, alone, nobody_near)


def _beside(scene, places, place):
    """Metres from the nearer of two places to the line of sight to the other, for the camera where it is least."""

    def in_camera(center):
        to_places, to_place = places - center, place - center
        distances, distance = jnp.linalg.norm(to_places, axis=-1), jnp.linalg.norm(to_place)
        sine = jnp.abs(to_places[:, 0] * to_place[1] - to_places[:, 1] * to_place[0]) / (distances * distance + 1e-6)
        is_ahead = dot(to_places, to_place) > 0
        return jnp.where(is_ahead, sine * jnp.minimum(distances, distance), jnp.inf)

    return jnp.min(jax.vmap(in_camera)(scene.centers()), axis=0)


class Readings(NamedTuple):
    """What all cameras, or each of them, measure of everybody: y = H place."""

    y: Float[Array, "slots readings 4"]
    H: Float[Array, "slots readings 4 4"]
    R: Float[Array, "slots readings 4 4"]
    observed: Bool[Array, "slots readings 4"]
    """Which rows say anything."""


def as_measurement(fit: Fit, silhouette_sd: float) -> Readings:
    """Readings with their covariance from the curvature of the score.

    A parabola of curvature J and slope g at z0 is that of a Gaussian reading z0 + J^-1 g with covariance J^-1. In the
    directions of the eigenvectors of J each reading stands alone, and those without curvature drop out.
    """

    def one(place, axes, steps, quadratic):
        eigenvalues, vectors = jnp.linalg.eigh(quadratic.curvature)
        observed = eigenvalues > LEAST_CURVATURE
        curvature = jnp.where(observed, eigenvalues, 1.0)
        limit = jnp.maximum(jnp.linalg.norm(steps), jnp.minimum(1 / jnp.sqrt(curvature), MOST_SHIFT_M))
        shift = jnp.clip(dot(quadratic.gradient, vectors) / curvature, -limit, limit)
        H = dot(vectors.T, axes)
        return Readings(dot(H, place) + shift, H, jnp.diag(1 / curvature + silhouette_sd**2), observed)

    if fit.quadratic.value.shape[1] == 1:
        alone = jax.vmap(one)(fit.place, fit.axes, fit.steps, jax.tree.map(lambda leaf: leaf[:, 0], fit.quadratic))
        return jax.tree.map(lambda leaf: leaf[:, None], alone)
    return jax.vmap(jax.vmap(one, in_axes=(None, None, None, 0)))(fit.place, fit.axes, fit.steps, fit.quadratic)


def _observed_covariance(scene, predicted):
    """Of what the silhouettes show: places and their displacements by the biases."""
    factors = jax.vmap(bias_factor, in_axes=(None, 0))(scene, predicted.mean)
    shows = jnp.broadcast_to(jnp.eye(STATE)[jnp.array(PLACE)], (len(factors), 4, STATE)).at[:, :, BIAS].set(factors)
    return einsum("kpi,kij,kqj->kpq", shows, predicted.covariance, shows)


def _axes(scene, place):
    return jnp.eye(4).at[:2, :2].set(line_of_sight(scene, place[:2]))


def _steps(scene, places):
    """From the size of a pixel of the camera that sees each person finest."""
    finest = jnp.min(jnp.stack([pixel_m(camera, places[:, :2]) for camera in scene.cameras]), axis=0)
    steps = jnp.clip(CURVATURE_PX * finest, LEAST_STEP_M, MOST_STEP_M)[:, None] * jnp.array(STEP_SHARES)
    return steps.at[:, 0].max(FOOT_PX * _foot_pixel_m(scene, places))


def _foot_pixel_m(scene, places):
    """Metres along the line of sight that move feet by a pixel, in the camera that tells distances best."""

    def in_camera(camera):
        center = camera.position()
        height = jnp.maximum(center[2], LEAST_STEP_M)
        distance = jnp.linalg.norm(places[:, :2] - center[:2], axis=-1)
        return pixel_m(camera, places[:, :2]) * jnp.hypot(distance, height) / height

    return jnp.min(jnp.stack([in_camera(camera) for camera in scene.cameras]), axis=0)


def _reach(scene, places, covariance, axes):
    along = einsum("kai,kij,kaj->ka", axes[:, :2, :2], covariance[:, :2, :2], axes[:, :2, :2])
    most = jnp.full((len(places), 2), MOST_REACH_M).at[:, 0].max(REACH_FOOT_PX * _foot_pixel_m(scene, places))
    return jnp.clip(2 * jnp.sqrt(jnp.maximum(along, 0.0)), LEAST_REACH_M, most)


def _nearest_first(scene, views, places, active) -> Int32[Array, " slots"]:
    """By the distance from the nearest camera that sees each: who is in front hides others, and is searched for first.

    Whoever no camera sees comes after all who are visible.
    """
    distance = jnp.linalg.norm(places[:, None, :2] - scene.centers(), axis=-1)
    observed = jnp.any(views.visible > 0, axis=-1)
    nearest = jnp.min(jnp.where(observed, distance, _FAR_M), axis=-1)
    return jnp.argsort(jnp.where(active, nearest, jnp.inf))
