"""Range bias, noise and outliers of radio beacons estimated by maximum likelihood; a robot's error before and after.

Real recording: Plaza 1 (J. Djugash, B. Hamner, S. Roth, "Navigating with ranging radios", Journal of Field Robotics
26(9), 2009), odometry and ranges to four beacons at known places. The fit uses neither the true path nor the
second half of the recording; errors are those of both halves apart. `nominal` is the filter with round numbers in
place of the estimates; `bias` fits a constant excess of the ranges, `scale` one that grows with the distance, and
`network` any function of the distance, a small network trained through the filter.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import scipy.io
from jaxtyping import Array, Float, PyTree

from jaxfilters import filter, fit
from jaxfilters._struct import pytree_dataclass
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.extended import Observation
from jaxfilters.models.range_beacons import LinearExcess, RangeRobot, Step, localisation, steps_between
from jaxfilters.trackers.app.chart import Curve, draw_chart

NOISES = tuple(map(jnp.float32, (1.0, 0.01, 10.0, 0.1, 0.02)))
"""A metre of noise, one range in a hundred outlying, a decimetre a metre, a degree a second."""
POSITIVE = (fit.positive, fit.interval(0.0, 0.5), fit.positive, fit.positive, fit.positive)
NOMINAL = RangeRobot(LinearExcess(jnp.float32(0), jnp.float32(0)), *NOISES)
"""No excess at all."""
NUM_UNITS = 6
QUICK_NUM_RANGES = 400
KEY = jax.random.key(0)


@pytree_dataclass
class NetworkExcess:
    """Any smooth excess: a layer of units, each of which switches at some distance."""

    bias: Float[Array, ""]
    places: Float[Array, " k"]
    """Where units switch, metres."""
    slopes: Float[Array, " k"]
    """How fast, in units a metre."""
    weights: Float[Array, " k"]
    """Metres."""

    def __call__(self, distance: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        units = jnp.tanh(self.slopes * (distance[..., None] - self.places))
        return self.bias + jnp.sum(self.weights * units, axis=-1)


def untrained() -> NetworkExcess:
    """Units at all distances, without weight."""
    places = jnp.linspace(5.0, 75.0, NUM_UNITS)
    return NetworkExcess(jnp.float32(0), places, jnp.full(NUM_UNITS, 0.1), jnp.zeros(NUM_UNITS))


def penalty(robot: RangeRobot) -> Float[Array, ""]:
    """Log prior of a network: weights of a metre or so, units that stay about where they were."""
    excess: Any = robot.excess
    start = untrained()
    strayed = (excess.places - start.places) / 10, jnp.log(excess.slopes / start.slopes), excess.weights
    return -0.5 * jnp.sum(jnp.stack([jnp.sum(part**2) for part in strayed]))


FREE = LinearExcess(fit.free, fit.free)
MODELS = {
    "bias": (NOMINAL, RangeRobot(replace(FREE, scale=fit.fixed), *POSITIVE)),
    "scale": (NOMINAL, RangeRobot(FREE, *POSITIVE)),
    "network": (
        replace(NOMINAL, excess=untrained()),
        RangeRobot(NetworkExcess(fit.free, fit.free, fit.positive, fit.free), *POSITIVE),
    ),
}
"""Where each search starts, and what its parameters may be."""


class Recording(NamedTuple):
    """A robot that drove among beacons; one row a range."""

    seconds: Float[np.ndarray, " t"]
    steps: Step
    ranges: Observation
    beacons: Float[Array, "b 2"]
    start: Float[Array, "3"]
    """True x, y (metres) and heading (radians) before the first step."""
    truth: Float[np.ndarray, "t 2"]
    """Where it was at each range, by satellites."""

    def part(self, rows: slice) -> "Recording":
        """Some of the rows, the first ones among them."""
        cut = jax.tree.map(lambda leaf: leaf[rows], (self.seconds, self.steps, self.ranges, self.truth))
        return self._replace(**dict(zip(("seconds", "steps", "ranges", "truth"), cut, strict=True)))


@pytree_dataclass
class Localisation:
    """The filter of a robot among beacons, as a function of its parameters."""

    beacons: Float[Array, "b 2"]
    start: Float[Array, "3"]

    def __call__(self, robot: RangeRobot) -> Filter:
        prior = Gaussian(self.start, jnp.diag(jnp.array([1.0, 1.0, 0.1]) ** 2))
        return localisation(robot, self.beacons, prior)


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Learn, localise, print, and draw what was estimated."""
    del seed  # Nothing is drawn.
    recording = read(recording_folder("plaza_range_slam") / "Plaza1_.mat")
    recording = recording.part(slice(QUICK_NUM_RANGES)) if quick else recording
    half = len(recording.seconds) // 2
    learned = {name: learn(recording.part(slice(half)), name) for name in MODELS}
    robots = {"nominal": NOMINAL, **{name: found.theta for name, found in learned.items()}}
    errors = {name: localisation_errors(recording, robot) for name, robot in robots.items()}
    for name, found in learned.items():
        sys.stdout.write(f"{name}\n{found}\n\n")
    if out is not None:
        _draw(out / "fit_ranges.png", recording, robots, errors)
    return _metrics(recording, robots, errors, half) | _learned_metrics(recording, learned["scale"])


def read(path: Path) -> Recording:
    """A recording of the Plaza set: `GT`, `DR`, `TD` and `TL` of a .mat file.

    Raises:
        RecordingError: If the file is not there or has other contents.
    """
    try:
        held = scipy.io.loadmat(path)
        truth, odometry, ranges, beacons = (np.asarray(held[name], float) for name in ("GT", "DR", "TD", "TL"))
    except (OSError, KeyError, ValueError, scipy.io.matlab.MatReadError) as error:
        raise RecordingError(f"{path} is no recording of the Plaza set: {error}") from error
    # A few stretches of ranges were written late.
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]
    steps = steps_between(ranges[:, 0], *odometry.T)
    heard = ranges[:, 2:3] == beacons[:, 0]
    places = np.stack([np.interp(ranges[:, 0], truth[:, 0], truth[:, i]) for i in (1, 2)], axis=-1)
    measured = Observation(jnp.asarray(np.where(heard, ranges[:, 3:], 0.0), jnp.float32), jnp.asarray(heard))
    start = jnp.asarray(truth[0, 1:4], jnp.float32)
    seconds = ranges[:, 0] - truth[0, 0]
    steps = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), steps)
    return Recording(seconds, steps, measured, jnp.asarray(beacons[:, 1:3], jnp.float32), start, places)


def learn(recording: Recording, model: str) -> fit.Fit:
    """Parameters of most likelihood, given ranges and odometry alone."""
    filter_of = Localisation(recording.beacons, recording.start)
    density = fit.log_evidence(KEY, filter_of, recording.ranges, recording.steps)
    density = fit.with_prior(density, penalty) if model == "network" else density
    return fit.maximize(density, *MODELS[model])


def localisation_errors(recording: Recording, robot: RangeRobot) -> Float[np.ndarray, " t"]:
    """Metres between where the filter says the robot is at each range, and where it was."""
    chosen = Localisation(recording.beacons, recording.start)(robot)
    _, means = filter.run(chosen, KEY, recording.ranges, recording.steps, collect=_keep_mean)
    return np.linalg.norm(np.asarray(means)[:, :2] - recording.truth, axis=-1)


def mean_excess(recording: Recording, robot: RangeRobot) -> Float[Array, ""]:
    """Metres by which the ranges of a recording are too long on average, as the robot's parameters have it."""
    metres = jnp.sum(recording.ranges.y, axis=-1)
    # The distance that a range stands for, by fixed-point steps: the excess changes slowly.
    distance = jax.lax.fori_loop(0, 20, lambda _, distance: metres - robot.excess(distance), metres)
    return jnp.mean(metres - distance)


def _keep_mean(state: Gaussian, info: PyTree) -> Array:
    del info
    return state.mean


def _metrics(recording: Recording, robots: dict, errors: dict, half: int) -> dict[str, Metric]:
    found = {}
    for name, error in errors.items():
        first, second = (float(np.sqrt(np.mean(part**2))) for part in (error[:half], error[half:]))
        found[f"rms_{name}_m"] = Metric(float(np.sqrt(np.mean(error**2))), "m", "lower")
        found[f"rms_{name}_learnt_half_m"] = Metric(first, "m", "lower")
        found[f"rms_{name}_other_half_m"] = Metric(second, "m", "lower")
    for name in MODELS:
        share = found[f"rms_{name}_m"].value / found["rms_nominal_m"].value
        found[f"reduction_{name}_percent"] = Metric(100 * (1 - share), "%", "higher")
        # Nearer to the true mean, which only the true path tells, is better: what counts is the distance.
        gap = abs(float(mean_excess(recording, robots[name])) - _true_excess(recording))
        found[f"mean_bias_{name}_gap_m"] = Metric(gap, "m", "lower")
    return found


def _learned_metrics(recording: Recording, found: fit.Fit) -> dict[str, Metric]:
    excess = float(mean_excess(recording, found.theta))
    sys.stdout.write(f"mean bias of the ranges: estimated {excess:.3f} m, true {_true_excess(recording):.3f} m\n")
    return {
        "learnt_mean_bias_m": Metric(excess, "m", "lower"),
        "learnt_noise_m": Metric(float(found.theta.noise), "m", "lower"),
        "learnt_outlier_share": Metric(float(found.theta.outlier_share), "", "lower"),
    }


def _true_distances(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """True distance and measured range of each row, metres."""
    true = np.linalg.norm(recording.truth[:, None] - np.asarray(recording.beacons), axis=-1)
    heard = np.asarray(recording.ranges.mask)
    return true[heard], np.asarray(recording.ranges.y)[heard]


def _true_excess(recording: Recording) -> float:
    true, measured = _true_distances(recording)
    return float(np.mean(measured - true))


def _draw(path: Path, recording: Recording, robots: dict, errors: dict) -> None:
    """Errors over time; below, the excess of the ranges by distance, estimated and true."""
    colors = {"nominal": (60, 60, 60), "bias": (40, 120, 230), "scale": (200, 110, 30), "network": (60, 160, 60)}
    curves = [Curve(name, error, colors[name]) for name, error in errors.items()]
    over_time = draw_chart((320, 900), "error of the place, m", recording.seconds, curves, "s", from_zero=True)
    true, measured = _true_distances(recording)
    edges = np.linspace(0, 80, 41)
    place = np.digitize(true, edges) - 1
    means = np.array([np.mean((measured - true)[place == i]) if np.sum(place == i) > 4 else np.nan for i in range(40)])
    middle = 0.5 * (edges[1:] + edges[:-1])
    curves = [Curve(n, np.asarray(r.excess(jnp.asarray(middle))), colors[n]) for n, r in robots.items()]
    curves.append(Curve("true mean", means, (200, 60, 200)))
    by_distance = draw_chart((320, 900), "excess of a range, m", middle, curves, "distance, m", from_zero=True)
    if not cv2.imwrite(str(path), np.concatenate([over_time, by_distance])):
        raise OSError(f"Cannot write {path}.")
