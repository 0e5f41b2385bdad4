"""The filter of one hand in depth images: its set-up, its state, its likelihood and its proposal.

`rao_blackwell_shared` on the 22-number hand with `HandMotion`; its likelihood renders every particle (Kajihara and
Tanaka, with the union cost); its proposal looks at the image first (`guided_rao_blackwell`, `registration`).
"""

import math
from dataclasses import field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters import weights
from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters._xla.from_host import from_host
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math.lie import quaternion_mean, quaternion_normalize, quaternion_to_matrix
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.motion import PER_COORDINATE, HandMotion, per_coordinate
from jaxfilters.models.hand.observation import (
    HandImage,
    HandLikelihood,
    crop,
    hand_image,
    hidden_digits,
    isolate,
    window_stride,
)
from jaxfilters.models.hand.registration import (
    PosePrior,
    Registration,
    RegistrationConfig,
    register,
    target_from_image,
)
from jaxfilters.models.hand.skeleton import (
    DIGITS,
    TANGENT_SIZE,
    forward_kinematics,
    hand_center,
    local,
    retract,
)
from jaxfilters.particle.guidance import GuidanceMixture
from jaxfilters.particle.guided_rao_blackwell import GuidedState, Jump, guided_rao_blackwell
from jaxfilters.particle.rao_blackwell import RaoBlackwellState, rao_blackwell_shared
from jaxfilters.particle.tempering import AdaptiveTempering
from jaxfilters.trackers.hand_depth.config import HandDepthConfig

WINDOW = (128, 128)
REGISTRATION_STRIDE = 4
"""Of the pixels of the window: a thousand residuals fix 21 numbers."""
OTHER_STARTS = 3
"""Particles from which the registration begins besides the mean pose."""
MAX_ERROR = 0.1
"""c_max of the paper, metres."""
SIGMA = 3e-4
"""Scale of the cost, metres: of a mean over thousands of pixels, far below that of one pixel."""
TEMPERED_SHARE = 0.06
"""Of the particles that stay effective in a frame: with fewer, what a frame does not show moves as a few of them do."""
FEWEST_PIXELS = 50
"""Hand pixels in the window below which nothing is there."""
LOST_COST = 0.07
"""Metres: of the best pose above which the hand counts as not there; 0.1 is no overlap at all."""
SUDDEN = 1.5
"""Ratio of the cost of a frame to the least one since the last search or race above which the hand has changed faster
than the filter follows, and new starts compete with the track at once."""
BEHIND = 0.025
"""Metres behind the farthest part of the expected hand from which on a reading is of something else."""
PATIENCE = 5
"""Frames in a row without the hand before it is searched anew."""
FRAME_INTERVAL = 1 / 30
"""Seconds before the first frame."""


def _rate(position: float, rotation: float, angle: float) -> Float[Array, " 21"]:
    """Variance a second of a random walk with these standard deviations a frame: metres, and twice degrees."""
    std = per_coordinate(position, math.radians(rotation), math.radians(angle))
    return from_host(np.square(std) / FRAME_INTERVAL)


_WIDE = _rate(0.008, 3.667, 12.0)
"""A real hand: a joint may move 35 mm from one frame to the next."""
UNGUIDED_MOTION = HandMotion(_WIDE, _rate(0.04, 11.46, 24.0), per_coordinate(0.0, 0.0, 1 / 0.3))
"""So wide that each frame may jump; joint velocities are damped over 0.3 s."""
MOTION = HandMotion(_rate(0.0027, 1.37, 2.4), _rate(0.02, 8.0, 12.0), per_coordinate(1 / 0.59, 1 / 0.46, 1 / 0.40))
"""Between jumps, of a pose with a velocity and without. The time constants predict the true motions of the development
best, 1 to 10 frames ahead (likelihood of a pose with white error, of its walk and of its velocity). The random walk is
two to seven times as wide as it is there, the velocity up to 1.7 times: with a narrower walk the hand that is observed
is followed less well, with a wider one its velocity is less known when fingers are hidden."""
HIDDEN_DIGIT_S = 0.05
"""Seconds in which the velocity of a digit falls to 1/e while the digit is hidden. What the readings leave uncertain of
the velocity would move it farther than fingers move: on the motions of the development, with fingers hidden (4 seeds),
joints are 11.0 mm off with the time constant of a visible digit, 10.5 with this one or a fifth of it, 10.6 with twice
of it."""
JUMP_SHARE, DOUBTFUL_JUMP_SHARE = 0.2, 0.98
"""Probability of a jump as wide as `_WIDE` from one frame to the next; and while another pose explains the frames about
as well, which the ensemble is to reach."""
UNGUIDED_START_STD = per_coordinate(0.005, 0.04, math.radians(5))
START_STD = per_coordinate(0.02, 0.16, math.radians(20))
"""Wide, since another pose often explains the first frame as well; without a guide, too few particles would be near."""
START_VELOCITY_STD = per_coordinate(0.08, 0.3, math.radians(25))
"""Per second."""


_FLEXION, _SPREAD = math.radians(12.0), math.radians(8.0)
MODEL_ERROR = np.array(
    [0.0043, 0.0056, 0.0145, *np.deg2rad([4.8, 6.9, 3.3])]
    + [_FLEXION, _FLEXION, _SPREAD]
    + 4 * [_FLEXION, _SPREAD, _FLEXION]
)
"""Standard deviations of what never averages out, because hands are not shaped as the model is: of the wrist along the
axes of the palm, of its rotation, and of the angles. Errors of this tracker on seven recordings of two scanned hands,
rms over recordings, times 1.27: so wide is the 95 % interval of an eighth draw."""


def standard_deviations(pose: Float[Array, " 22"], covariance: Float[Array, "21 21"]) -> Float[Array, " 21"]:
    """Of the tangent coordinates of a pose: those of the ensemble and `MODEL_ERROR` together."""
    model = jnp.asarray(MODEL_ERROR**2, covariance.dtype)
    palm = quaternion_to_matrix(quaternion_normalize(pose[3:7]))
    model = jnp.concatenate([dot(palm**2, model[:3]), model[3:]])
    return jnp.sqrt(jnp.diagonal(covariance) + model)


class TrackState(NamedTuple):
    """Everything the next frame needs."""

    ensemble: Any
    """Of the filter."""
    scale: Float[Array, ""]
    """Size of the hand relative to the average one; NaN until it was fitted to a frame."""
    side: Float[Array, ""]
    """+1 for a right hand, -1 for a left hand; NaN until it was decided."""
    doubt: Array
    """Whether another explanation is as good, or this one is bad."""
    race_time: Float[Array, ""]
    """Seconds: from when on the next frame is searched, or has new starts compete with the track."""
    least_cost: Float[Array, ""]
    """Metres: of the frames since the last search or race; infinite before the first one."""
    missing_is_background: Array
    time: Float[Array, ""]
    """Of the last frame, seconds."""
    hidden: Array
    """(5,) digits of which the last frame said nothing."""
    misses: Array
    """Frames in a row in which the hand was not visible."""
    key: Array


@pytree_dataclass
class Setup:
    """What one tracker is made of, as data: the compiled functions below take it as an argument."""

    camera: Pinhole
    likelihood: HandLikelihood
    """Of the hand of scale 1."""
    config: HandDepthConfig = field(metadata={"static": True})
    stride: int | None = field(metadata={"static": True})

    def compiled(self) -> "Setup":
        """The same for compiled functions: without the options that only the host reads, they serve all of these."""
        return replace(self, config=replace(self.config, seed=0, hand="auto", scale=None, missing="auto"))

    def spacing(self, depth: Float[Array, ""]) -> int | Float[Array, ""]:
        """Pixels of the frame for one of the window about a hand at `depth` metres."""
        return window_stride(self.camera, depth, WINDOW[1]) if self.stride is None else self.stride

    def hand(self, state: "TrackState") -> HandLikelihood:
        """The likelihood of the hand that is tracked."""
        return self.sized(state.scale, state.side)

    def sized(self, scale: Array, side: Array) -> HandLikelihood:
        """The likelihood of a hand of a size and a side."""
        scaled = self.likelihood.scaled(scale)
        return replace(scaled, surface=scaled.surface.of_side(side))


@compiled_quickly
def placed(key: Array, setup: Setup, pose: Array, scale: Array, side: Array) -> Any:
    """An ensemble about a pose of the hand of a size and a side."""
    filter = build_filter(setup, pose, setup.sized(scale, side), jnp.asarray(False), jnp.zeros(len(DIGITS), bool))
    return filter.init(filter.params, key)


def build_filter(setup: Setup, pose: Array, likelihood: HandLikelihood, doubt: Array, hidden: Array) -> Filter:
    """The filter of a hand that starts about `pose`.

    Args:
        setup: Camera, hand and settings.
        pose: Of the start.
        likelihood: Of an image of the hand.
        doubt: Whether another pose explains the frames about as well.
        hidden: (5,) digits of which the last frame said nothing.
    """
    with_velocity, guide = setup.config.filter == "rbpf", setup.config.guide
    motion = _slowed(MOTION, hidden) if guide else UNGUIDED_MOTION
    velocity = START_VELOCITY_STD if with_velocity else START_VELOCITY_STD[:0]
    inner = rao_blackwell_shared(
        jax.tree_util.Partial(_sample_about, pose, START_STD if guide else UNGUIDED_START_STD),
        Gaussian(jnp.zeros_like(velocity), jnp.diag(velocity**2)),
        motion.dynamics if with_velocity else motion.walk,
        likelihood.log_likelihood,
        num_particles=setup.config.num_particles,
        noise_dim=TANGENT_SIZE,
        retract=retract,
        ess_threshold=1.0,
        temper=AdaptiveTempering(TEMPERED_SHARE),
    )
    if not guide:
        return inner
    registered, jump = jax.tree_util.Partial(_look, likelihood), jax.tree_util.Partial(_jump, doubt)
    return guided_rao_blackwell(inner, registered, local=local, jump=jump, prior_share=0.1)


def _slowed(motion: HandMotion, hidden: Array) -> HandMotion:
    """The motion with the velocities of hidden digits damped by `HIDDEN_DIGIT_S`."""
    of_angle = jnp.repeat(hidden, PER_COORDINATE[-1] // len(DIGITS))
    is_hidden = jnp.concatenate([jnp.zeros(sum(PER_COORDINATE[:-1]), bool), of_angle])
    return replace(motion, damping_rate=jnp.where(is_hidden, 1 / HIDDEN_DIGIT_S, motion.damping_rate))


def _jump(doubt: Array, dt: Array) -> Jump:
    return Jump(jnp.where(doubt, DOUBTFUL_JUMP_SHARE, JUMP_SHARE), jnp.diag(dt * _WIDE))


def _sample_about(pose: Array, std: Array, key: Array) -> Array:
    return retract(pose, std * jax.random.normal(key, (TANGENT_SIZE,)))


def _look(likelihood: HandLikelihood, particles: Array, log_weights: Array, image: HandImage) -> GuidanceMixture:
    """Register the predicted hand onto the image, beginning with its mean pose and with some of the particles.

    A hand that moved far may be found from a particle where the mean pose leads to another maximum. The likelihood says
    how much each maximum counts. While a digit is hidden, many other poses explain the rest as well, so that only the
    maximum that the mean pose leads to counts.
    """
    mean, covariance = pose_moments(particles, log_weights)
    # A thousandth more on the diagonal: few effective particles leave the covariance without full rank.
    root = jnp.linalg.cholesky(covariance + jnp.diag(1e-3 * jnp.diagonal(covariance) + 1e-10))
    shape = tuple(size // REGISTRATION_STRIDE for size in WINDOW)
    camera = image.camera.crop(jnp.zeros(2), shape, REGISTRATION_STRIDE)
    target = target_from_image(camera, image.observed[::REGISTRATION_STRIDE, ::REGISTRATION_STRIDE])

    def registered(start: Array) -> Registration:
        return register(camera, target, likelihood.geometry, start, PosePrior(mean, root), RegistrationConfig())

    count = particles.shape[1]
    chosen = [(2 * i + 1) * count // (2 * OTHER_STARTS) for i in range(OTHER_STARTS)]
    found = jax.vmap(registered)(jnp.stack([mean, *(particles[:, i] for i in chosen)]))
    log_likelihoods = jax.vmap(likelihood.log_likelihood, in_axes=(0, None))(found.pose, image)
    # In the predicted pose: judged in the one that is registered, hidden fingers are 10.4 mm off in place of 10.0.
    is_hidden = hidden_digits(image, forward_kinematics(mean, likelihood.geometry).joints)
    is_other = jnp.arange(1 + OTHER_STARTS) > 0
    is_finite = jnp.all(jnp.isfinite(found.pose), axis=1) & jnp.all(jnp.isfinite(found.information), axis=(1, 2))
    counts = is_finite & ~(is_other & jnp.any(is_hidden))
    return GuidanceMixture(found.pose, found.information, jnp.where(counts, log_likelihoods, -jnp.inf))


@compiled_quickly
def pose_moments(
    particles: Float[Array, "22 n"], log_weights: Float[Array, " n"]
) -> tuple[Float[Array, " 22"], Float[Array, "21 21"]]:
    """Mean pose on the manifold, and the covariance in its tangent space."""
    mean = weights.mean(particles, log_weights)
    mean = jnp.concatenate([mean[:3], quaternion_mean(particles[3:7], log_weights), mean[7:]])
    offsets = jax.vmap(local, in_axes=(None, -1), out_axes=-1)(mean, particles)
    return mean, weights.covariance(offsets, log_weights)


@jax.jit
def filled(frame: Array, missing_is_background: Array) -> Array:
    """The frame with pixels without a reading as background, if that is what they are."""
    return jnp.where(jnp.isnan(frame) & missing_is_background, jnp.inf, frame)


def look(setup: Setup, state: TrackState, frame: Array, expected: Float[Array, " 22"]) -> HandImage:
    """The window of a frame in which a hand is expected, with everything else taken out."""
    center = hand_center(expected, state.scale)
    center = center.at[2].set(jnp.maximum(center[2], 0.1))  # a lost hand may be predicted behind the camera
    window, observed = crop(setup.camera, frame, center, WINDOW, setup.spacing(center[2]))
    return hand_image(
        window, _before_what_is_behind(setup, state, isolate(window, observed, expected, state.scale), expected)
    )


def _before_what_is_behind(setup: Setup, state: TrackState, observed: Array, expected: Array) -> Array:
    """The readings without those well behind every part of the expected hand: a wall or a desk, which says nothing."""
    capsules = forward_kinematics(expected, setup.hand(state).geometry).capsules
    farthest = jnp.max(jnp.maximum(capsules.start[:, 2], capsules.end[:, 2]) + capsules.radius)
    return jnp.where(jnp.isfinite(observed) & (observed > farthest + BEHIND), jnp.nan, observed)


def particles_of(state: RaoBlackwellState | GuidedState) -> tuple[Array, Array]:
    """The particles of the state of either filter, and their log weights."""
    ensemble = state.ensemble if isinstance(state, GuidedState) else state
    return ensemble.particles, ensemble.log_weights
