"""A track in doubt, or lost, beside what the detector of landmarks finds in the same image.

A head that turns far leaves few landmarks that look as registered. The others are followed from frame to frame, and the
track may slip by tens of degrees while a detector sees the face well; a detector errs by tens of degrees on other views
(beyond 50 degrees of yaw). Where the pose of the detected landmarks is one that the standard deviations of the track
allow, the tracker goes on from the mean of both, weighted by their covariances, if the detector's errors have one (the
mesh; the cascades err grossly with glasses and beards). Where they exclude each other, or cannot be averaged, neither
is believed: the tracker goes on from both poses in the same image, and the correlation of the registered face decides
between what it makes of them.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, UInt8

from jaxfilters._full_precision import dot
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.alignment import Alignment
from jaxfilters.models.face.pose import within_half_turn
from jaxfilters.models.face.refinement import refine
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.shape_model import shape
from jaxfilters.trackers.head.common.near_mode import UNKNOWN_STD
from jaxfilters.trackers.head.common.recent import CHANGED_SCORE, nothing_changed
from jaxfilters.trackers.head.common.search import gathered
from jaxfilters.trackers.head.common.state import DEFORMABLE, DOUBTFUL, LOST, POSE
from jaxfilters.trackers.head.mono.claims import frame_covariance
from jaxfilters.trackers.head.mono.detections import noise_px
from jaxfilters.trackers.head.mono.detectors import DetectedFace, Detector
from jaxfilters.trackers.head.mono.estimate import FEWEST_SURE
from jaxfilters.trackers.head.mono.start import DETECTED_PX, facing_pose
from jaxfilters.trackers.head.mono.state import MonoState, MonoTrack
from jaxfilters.trackers.head.stereo.tracking import LEAST_SCORE, REGAINED_SCORE

EVERY_S, EVERY_S_AVERAGED = 1 / 3, 0.1
"""Seconds between two frames in which a track in doubt is compared with a detection; and where it is averaged with it.

On 24 videos of people 0 to 3 and 12 to 15 of the ICT face model with the mesh, 8 with glasses and 8 with beards, yaw is
wrong by 5.7, 4.7 and 5.4 degrees with a comparison every third of a second, 5.4, 4.1 and 4.5 with ten a second.
"""
CLEARLY_BETTER = 0.02
"""By how much the registered face must correlate better at another pose."""
MOST_DISTANCE = 15.1
"""Squared distance between a detected pose and a track beyond which they exclude each other: 99 % of chi^2 of five."""
ANYWHERE_STD = np.array([200.0, 200.0, 200.0, 0.5, 0.7, 0.5])
"""Of a pose about that which faces the camera where the landmarks are, millimetres and radians."""
LASTING_STD = np.array([3.0, 3.0, 0.0, *np.radians([3.0, 6.0, 6.0])])
"""Of what a detector is wrong in for seconds in a pose, beside the noise of the landmarks, millimetres and radians."""
ROUNDS = 3
"""Of five Gauss-Newton steps each."""


class Located(NamedTuple):
    """What a detector says of the last image."""

    state: MonoState
    """With the face where both say that it is if they agree, where the detector finds it if not."""
    agrees: bool
    """Whether track and detection allow each other."""


def seconds_between(detector: Detector) -> float:
    """How often a track in doubt is compared with what a detector finds."""
    return EVERY_S_AVERAGED if detector.is_averaged else EVERY_S


def is_beyond_doubt(state: MonoState, row: MonoTrack) -> bool:
    """Whether a track needs no comparison: enough landmarks look as registered, whatever they did before.

    Args:
        state: Of the tracker after the row's image.
        row: Of the track.
    """
    num_anchored = int(np.sum(np.any(~np.asarray(state.recent.has_changed), axis=0)))
    is_found = row.status == DOUBTFUL and int(state.misses) == 0
    return bool(row.status == DEFORMABLE or (is_found and num_anchored >= FEWEST_SURE))


def located(
    state: MonoState,
    row: MonoTrack,
    rig: CameraRig,
    detector: Detector,
    detected: DetectedFace,
    image: UInt8[np.ndarray, "rows cols"],
) -> Located | None:
    """The state with the face where a detector finds it in the last image; None if its landmarks have no pose.

    Args:
        state: Of the tracker after that image.
        row: Of the track in that image, which is in doubt or lost.
        rig: One camera.
        detector: Of the landmarks.
        detected: What it found in the image.
        image: The last one.
    """
    noise = np.full(len(detected.points), DETECTED_PX)
    beside = np.zeros(state.model.mean.shape)
    if detector.errors is not None:
        noise = noise_px(detector.errors, detected.points[None])
        # A person who was registered from what it detected has the landmarks where it puts them.
        beside = detector.errors.mean if state.prior.misplaced is None else beside
    number = lambda a: jnp.asarray(a, state.model.mean.dtype)
    std_px = number(noise)
    lasting = number(LASTING_STD if detector.is_averaged else np.zeros(POSE))
    found = _pose(state, rig, number(detected.points), std_px, number(beside), lasting)
    if not np.all(np.isfinite(found.mean)):
        return None
    may_agree = detector.is_averaged and row.status != LOST
    agrees = bool(may_agree and _distance(np.asarray(found.mean[:POSE], float), row) <= MOST_DISTANCE)
    found = _fused(state, found) if agrees else found
    return Located(_placed(state, rig, jnp.asarray(image), found, std_px), agrees)


def prepare(state: MonoState, rig: CameraRig) -> None:
    """Compiles what `located` runs, so that the frames of a live camera do not wait for it."""
    zero = jnp.zeros_like(state.model.mean)
    found = _fused(state, _pose(state, rig, zero[:, :2], zero[:, 0] + 1.0, zero, jnp.zeros(POSE, zero.dtype)))
    _placed(state, rig, jnp.zeros(rig.shape, jnp.uint8), found, zero[:, 0])


def is_better(other: MonoTrack, track: MonoTrack, *, agrees: bool = False) -> bool:
    """Whether the row from a detected pose is to be believed rather than that of the track in doubt, or lost.

    Args:
        other: From the detected pose, or from its mean with that of the track if they agree.
        track: As it was.
        agrees: Whether they do.
    """
    if other.status == LOST or not np.all(np.isfinite(other.pose)):
        return False
    if agrees:
        return True
    is_sure = other.status == DEFORMABLE
    if track.status == LOST:
        return bool(other.score >= (REGAINED_SCORE if is_sure else CHANGED_SCORE))
    if is_sure:
        return bool(other.score >= LEAST_SCORE)
    # Where the detection is one that the track rules out, one of them is wrong altogether: less is then asked.
    least = LEAST_SCORE if _distance(np.asarray(other.pose, float), track) > MOST_DISTANCE else REGAINED_SCORE
    return bool(other.score >= max(least, track.score + CLEARLY_BETTER))


def _distance(pose: Float[np.ndarray, " 6"], track: MonoTrack) -> float:
    """Squared distance of a pose from a track by what both are off by, all but the depth."""
    apart = pose - np.asarray(track.pose, float)
    apart[3:] = within_half_turn(apart[3:])
    variance = np.square(track.pose_std) + np.square(LASTING_STD)
    return float(np.sum(np.delete(np.square(apart) / variance, 2)))


@compiled_quickly
def _pose(
    state: MonoState,
    rig: CameraRig,
    points: Float[Array, "K 2"],
    std_px: Float[Array, " K"],
    beside: Float[Array, "K 3"],
    lasting_std: Float[Array, " 6"],
) -> Gaussian:
    """Pose and mode coefficients from detected landmarks: the likelier of the fits from the last pose and a facing one.

    Args:
        state: Of the last frame.
        rig: One camera.
        points: Landmarks, pixels.
        std_px: Their standard deviations.
        beside: By how much they lie beside the state's, model frame, millimetres.
        lasting_std: Of what the detector is wrong in for seconds in a pose.
    """
    model, dtype = replace(state.model, mean=state.model.mean + beside), points.dtype
    modes, K, S = state.belief.mean[POSE:], len(points), state.slopes.covariance.shape[-1]
    facing = jnp.concatenate([facing_pose(rig, shape(model, jnp.zeros_like(modes)), points), jnp.zeros_like(modes)])
    usual = jnp.where(model.deviation > 0, model.deviation, UNKNOWN_STD)
    prior = Gaussian(facing, jnp.diag(jnp.square(jnp.concatenate([jnp.asarray(ANYWHERE_STD, dtype), usual]))))
    found = Alignment(
        uv=points[None],
        covariance=(jnp.square(std_px)[:, None, None] * jnp.eye(2))[None],
        score=jnp.ones((1, K), dtype),
        observed=jnp.ones((1, K), bool),
        by_slope=jnp.zeros((1, K, 2, S), dtype),
        slope_information=jnp.zeros((K, S, S), dtype),
        slope_score=jnp.zeros((K, S), dtype),
    )
    loose = state.model_variance[:, None, None] * jnp.eye(3)

    def fitted(x: Array) -> tuple[Gaussian, Array]:
        def again(x: Array, _: None) -> tuple[Array, tuple[Gaussian, Array]]:
            fit = refine(prior, found, state.slopes, model, loose, rig, x)
            return fit.belief.mean, (fit.belief, fit.log_evidence)

        _, fits = jax.lax.scan(again, x, length=ROUNDS)
        return jax.tree.map(lambda leaf: leaf[-1], fits)

    beliefs, evidence = jax.vmap(fitted)(jnp.stack([facing, state.belief.mean]))
    best = jnp.argmax(jnp.where(jnp.isfinite(evidence), evidence, -jnp.inf))
    mean, covariance = beliefs.mean[best], beliefs.covariance[best]
    lasting = jnp.square(jnp.pad(lasting_std, (0, mean.size - POSE)))
    return Gaussian(mean, covariance + jnp.diag(lasting))


@compiled_quickly
def _fused(state: MonoState, found: Gaussian) -> Gaussian:
    """The product of what the track and a detection say of pose and mode coefficients, if the person is as believed."""
    num_sure = jnp.sum(jnp.any(~state.recent.has_changed, axis=0)).astype(found.mean.dtype)
    mean, covariance = state.belief.mean, frame_covariance(state.belief.covariance, num_sure)
    apart = found.mean - mean
    turned = within_half_turn(apart[3:POSE])
    gain = jnp.linalg.solve(covariance + found.covariance, covariance).T
    both = covariance - dot(gain, covariance)
    return Gaussian(mean + dot(gain, apart.at[3:POSE].set(turned)), 0.5 * (both + both.T))


@compiled_quickly
def _placed(
    state: MonoState, rig: CameraRig, image: Num[Array, "rows cols"], found: Gaussian, std_px: Float[Array, " K"]
) -> MonoState:
    """The state with the head at another pose, where no landmark is known to look as registered."""
    x = found.mean
    recent = nothing_changed(image[None].astype(x.dtype), shape(state.model, x[POSE:]), x[:POSE], rig)
    recent = recent._replace(drift=jnp.square(std_px)[None], has_changed=jnp.ones_like(recent.has_changed))
    return state._replace(
        search=gathered(state.search, x)._replace(estimate=x, velocity=jnp.zeros_like(state.search.velocity)),
        belief=found,
        recent=recent,
        is_unsure=jnp.zeros_like(state.is_unsure),
        last_good=x,
        misses=jnp.zeros_like(state.misses),
        num_outliers=jnp.zeros_like(state.num_outliers),
    )
