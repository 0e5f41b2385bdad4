"""The hand filters that are compared, and the compiled step and loop that run any of them over a recording.

Source of the set-ups: Kajihara and Tanaka, "A method for 3D hand pose tracking using a Rao-Blackwellized particle
filter", sections 6 and 7; what the paper leaves open is said at each constant.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.cost import gibbs_abs, gibbs_sq
from jaxfilters.models.hand.motion import HandMotion, paper_motion, per_coordinate
from jaxfilters.models.hand.observation import HandImage, HandLikelihood, crop, hand_image, isolate, rendered, union
from jaxfilters.models.hand.skeleton import (
    TANGENT_SIZE,
    HandGeometry,
    forward_kinematics,
    hand_center,
    hand_geometry,
    open_palm,
    retract,
)
from jaxfilters.models.hand.surface import CapsuleHand, HandSurface
from jaxfilters.models.synthetic.hand import FRAME_INTERVAL, INITIAL_VELOCITY_STD, START
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.proposals import IncrementProposal, exact
from jaxfilters.particle.rao_blackwell import condition_on_increment, rao_blackwell_shared
from jaxfilters.particle.tempering import AdaptiveTempering
from jaxfilters.trackers.hand_depth.filtering import pose_moments
from jaxfilters.typing import AnyKey

WINDOW = (128, 128)
"""Pixels that are compared, the paper's."""
MAX_ERROR = 0.1
"""c_max of the paper, metres."""
PAPER_SIGMA = 0.02
"""The paper's sigma = 0.02 [64], read as metres."""
SIGMA = 3e-4
"""Metres: so sharp that tempering always has something to flatten."""
TEMPERED_SHARE = 0.2
"""Effective sample size after an update, as a share of N."""
DAMPING_TIME = 0.3
"""Seconds in which the velocity of a joint angle falls to 1/e."""
START_STD = (0.005, 0.04, math.radians(5))
"""Of the pose before the first frame: metres, radians, radians."""


@dataclass(frozen=True)
class Setting:
    """What the filters of one comparison have in common."""

    motion: HandMotion
    cost_of: Callable
    form: Callable
    sigma: float
    """Metres."""
    tempered_share: float | None
    """`None` leaves the likelihood as it is."""
    limits: bool
    """Whether joint limits are part of the likelihood."""
    segmented: bool
    """Whether readings far from the expected hand are taken out first."""
    surface: Callable[[HandGeometry], HandSurface] = CapsuleHand
    stride: int = 1
    """Every how many rows and columns of the window are compared."""


def improved() -> Setting:
    """Union cost, tempering, soft limits, damped angles, half the velocity noise: the best of the variants."""
    motion = paper_motion(FRAME_INTERVAL)
    motion = replace(
        motion,
        velocity_variance_rate=0.25 * motion.velocity_variance_rate,
        damping_rate=per_coordinate(0.0, 0.0, 1 / DAMPING_TIME),
    )
    return Setting(motion, union, gibbs_abs, SIGMA, TEMPERED_SHARE, limits=True, segmented=True)


def as_published() -> Setting:
    """Cost [48] over the rendered pixels, likelihood [47], undamped velocities, nothing else."""
    motion = paper_motion(FRAME_INTERVAL)
    return Setting(motion, rendered, gibbs_sq, PAPER_SIGMA, None, limits=False, segmented=False)


def particle_filter(setting: Setting, num_particles: int, pose_variance_rate: Array | None = None) -> Filter:
    """Plain particle filter on the pose, a random walk; `pose_variance_rate` (21,) replaces that of the setting."""
    rate = setting.motion.pose_variance_rate if pose_variance_rate is None else pose_variance_rate
    return bootstrap(
        _sample_prior,
        jax.tree_util.Partial(_walk, rate),
        _log_likelihood(setting),
        num_particles=num_particles,
        noise=StandardNormal(TANGENT_SIZE),
        ess_threshold=1.0,
        temper=_temper(setting),
    )


def rao_blackwellized(setting: Setting, num_particles: int, proposal: IncrementProposal = exact) -> Filter:
    """Particle filter on the pose whose velocity is integrated out."""
    return rao_blackwell_shared(
        _sample_prior,
        _velocity_prior(),
        setting.motion.dynamics,
        _log_likelihood(setting),
        num_particles=num_particles,
        noise_dim=TANGENT_SIZE,
        retract=retract,
        proposal=proposal,
        ess_threshold=1.0,
        temper=_temper(setting),
    )


def spread_of_increments(setting: Setting, num_frames: int = 100) -> Float[Array, " 21"]:
    """Variance per second of what `rao_blackwellized` draws beyond its mean, once it has settled.

    A plain filter with this noise spreads as widely: what is left between the two is the use of the velocity.
    """
    pose = open_palm(jnp.asarray(START, dtype=float))
    step = setting.motion.dynamics(pose, jnp.asarray(FRAME_INTERVAL, dtype=float))

    def advance(covariance: Array, _: None) -> tuple[Array, Array]:
        spread, _gain, covariance = condition_on_increment(covariance, step)
        return covariance, jnp.diagonal(spread)

    return jax.lax.scan(advance, _velocity_prior().covariance, length=num_frames)[1][-1] / FRAME_INTERVAL


def _velocity_prior() -> Gaussian:
    std = jnp.asarray(INITIAL_VELOCITY_STD, dtype=float)
    return Gaussian(jnp.zeros_like(std), jnp.diag(std**2))


def _sample_prior(key: AnyKey) -> Array:
    start = open_palm(jnp.asarray(START, dtype=float))
    return retract(start, per_coordinate(*START_STD) * jax.random.normal(key, (TANGENT_SIZE,)))


def _walk(pose_variance_rate: Array, noise: Array, pose: Array, dt: Array) -> Array:
    return retract(pose, jnp.sqrt(dt * pose_variance_rate) * noise)


def _log_likelihood(setting: Setting) -> Callable:
    sigma = jnp.asarray(setting.sigma, dtype=float)
    likelihood = HandLikelihood(setting.surface(hand_geometry()), sigma, MAX_ERROR, setting.cost_of, setting.form)
    return likelihood.log_likelihood if setting.limits else jax.tree_util.Partial(_without_limits, likelihood)


def _without_limits(likelihood: HandLikelihood, pose: Array, image: HandImage) -> Array:
    return likelihood.form(likelihood.cost(pose, image), likelihood.sigma)


def _temper(setting: Setting) -> AdaptiveTempering | None:
    return None if setting.tempered_share is None else AdaptiveTempering(setting.tempered_share)


@pytree_dataclass
class View:
    """How a frame is looked at."""

    camera: Pinhole
    geometry: HandGeometry
    segmented: bool = field(metadata={"static": True})
    stride: int = field(default=1, metadata={"static": True})

    def image(self, frame: Float[Array, "rows cols"], expected: Float[Array, " 22"]) -> HandImage:
        """The window about the expected hand; `frame` in metres, NaN without a reading."""
        center = hand_center(expected)
        center = center.at[2].set(jnp.maximum(center[2], 0.1))  # a lost hand may be predicted behind the camera
        shape = (WINDOW[0] // self.stride, WINDOW[1] // self.stride)
        window, observed = crop(self.camera, frame, center, shape, self.stride)
        return hand_image(window, isolate(window, observed, expected) if self.segmented else observed)


class Estimate(NamedTuple):
    """Of one frame, or of many along the first axis."""

    pose: Float[Array, "*t 22"]
    joints: Float[Array, "*t 21 3"]
    """Metres, camera frame."""
    ess: Float[Array, "*t"]


@jax.jit
def advance(
    filter: Filter, key: AnyKey, view: View, state: Any, frame: Float[Array, "rows cols"]
) -> tuple[Any, Estimate]:
    """One frame from end to end: predict, cut the window about the prediction, update, estimate."""
    predict_key, update_key = jax.random.split(key)
    elapsed = jnp.asarray(FRAME_INTERVAL, frame.dtype)
    state = filter.predict(filter.params, predict_key, state, elapsed)
    expected, _ = pose_moments(state.particles, state.log_weights)
    state, info = filter.update(filter.params, update_key, state, view.image(frame, expected), elapsed)
    pose, _ = pose_moments(state.particles, state.log_weights)
    return state, Estimate(pose, forward_kinematics(pose, view.geometry).joints, info.effective_sample_size)


@jax.jit
def track(filter: Filter, key: AnyKey, view: View, frames: Float[Array, "t rows cols"]) -> Estimate:
    """Estimates of all frames (metres, NaN without a reading), from the prior before the first one."""
    init_key, scan_key = jax.random.split(key)

    def body(state: Any, inputs: tuple) -> tuple[Any, Estimate]:
        frame_key, frame = inputs
        return advance(filter, frame_key, view, state, frame)

    keys = jax.random.split(scan_key, len(frames))
    return jax.lax.scan(body, filter.init(filter.params, init_key), (keys, frames))[1]
