"""Detected key points of real hands, filtered with three models of their errors.

Each coordinate of each joint, in millimetres at its true depth, is filtered alone: position and velocity, driven by
white acceleration. The errors of a detector last. The three filters take them for a Gauss-Markov process beside white
noise, for white noise of the true size, and for white noise inflated by (1 + phi) / (1 - phi). Constants are from the
first half of the frames: the drive from second differences of the truth, and variances and time constant from the
autocovariances of the errors at the lags 0 to 2. The second half is judged.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import jaxfilters as jf
from jaxfilters.benchmarks.recordings import RecordingError

FILE, NETWORK = "nyu_person1.npz", "ICCV15_NYU_Feedback"
DT = 1 / 30
TRIMMED = 0.01
"""Share of the largest second differences that are left out: dropped frames, where the truth jumps."""
MODELS = ("correlated", "inflated", "white")


class Keypoints(NamedTuple):
    """Coordinates in columns, millimetres."""

    detected: Float[np.ndarray, "t c"]
    truth: Float[np.ndarray, "t c"]


class Constants(NamedTuple):
    """Of the drive and of the errors."""

    drive: float
    """Spectral density of the acceleration, mm^2 / s^3."""
    lasting: float
    """Variance of what lasts, mm^2."""
    white: float
    """Variance of what does not, mm^2."""
    phi: float
    """Autocorrelation of what lasts, from one frame to the next."""


def load_keypoints(folder: Path, network: str = NETWORK) -> Keypoints:
    """Sideways coordinates of all joints.

    Raises:
        RecordingError: if the file cannot be read.
    """
    try:
        data = np.load(folder / FILE)
        truth, detected, K = (np.asarray(data[name], float) for name in ("gt_uvd", network, "K"))
    except (OSError, KeyError, ValueError) as error:
        raise RecordingError(f"{folder / FILE} cannot be read: {error!r}") from error
    focal, depth = np.abs(np.diagonal(K)[:2]), truth[..., 2:]
    lateral = [(points[..., :2] - K[:2, 2]) * depth / focal for points in (detected, truth)]
    return Keypoints(*(points.reshape(len(points), -1) for points in lateral))


def constants_of(points: Keypoints) -> Constants:
    """From frames whose truth is known: the lags 1 and 2 tell phi, as white noise has no correlation there."""
    second = np.diff(points.truth, n=2, axis=0).ravel() ** 2
    second = np.sort(second)[: int((1 - TRIMMED) * second.size)]
    errors = points.detected - points.truth
    at = [float(np.mean(errors[: len(errors) - lag] * errors[lag:])) for lag in range(3)]
    phi = float(np.clip(at[2] / at[1], 0.0, 0.999))
    lasting = min(at[1] / phi, at[0])
    # A white acceleration of density q has second differences of the variance 2/3 q dt^3.
    return Constants(1.5 * float(np.mean(second)) / DT**3, lasting, at[0] - lasting, phi)


def filters_of(constants: Constants) -> dict[str, jf.Filter]:
    """By the names in `MODELS`."""
    motion = jf.motion.constant_velocity(1.0).discretize(DT)
    prior = jf.Gaussian(jnp.zeros(2), jnp.diag(jnp.array([1e5, 1e6])))
    Q, H = constants.drive * motion.Q, jnp.array([[1.0, 0.0]])
    white, lasting, phi = constants.white, constants.lasting, constants.phi
    plain = lambda variance: jf.kalman(prior, motion.F, Q, H, jnp.full((1, 1), variance))
    process = jf.GaussMarkov(jnp.asarray(-DT / np.log(phi)), jnp.array([lasting]))
    return {
        "correlated": jf.correlated_noise(plain(white), process, dt=DT),
        "inflated": plain(white + lasting * (1 + phi) / (1 - phi)),
        "white": plain(white + lasting),
    }


@jax.jit
def filtered(filter: jf.Filter, detected: Float[Array, "t c"]) -> tuple[Array, Array]:
    """Estimates of all coordinates and their standard deviations, (t, c)."""

    def one(y: Array) -> tuple[Array, Array]:
        _, (beliefs, _) = jf.run(filter, jax.random.key(0), y[:, None])
        return beliefs.mean[:, 0], jnp.sqrt(beliefs.covariance[:, 0, 0])

    return jax.vmap(one, in_axes=1, out_axes=1)(detected)
