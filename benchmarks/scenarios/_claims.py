"""How far claimed standard deviations are true: coverage, normalised errors, autocorrelation, scores and sharpness."""

import math
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import jaxfilters as jf
from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric, aligned

SIGMAS = (1.0, 2.0, 3.0)
WITHIN = (0.683, WITHIN_TWO_SIGMA, 0.997)
"""Shares of a normal distribution within them."""
INTERVAL_KEY = 0


class Recording(NamedTuple):
    """Errors of one recording and what was claimed of them; NaN where there is no estimate or no truth."""

    errors: Float[np.ndarray, "t d"]
    deviations: Float[np.ndarray, "t d"]
    covariances: Float[np.ndarray, "t d d"] | None = None
    """Where the system says it; otherwise coordinates count as independent."""


class Claims(NamedTuple):
    """What one system claimed on one kind of data. Recordings are independent, their frames are not."""

    system: str
    data: str
    coordinates: tuple[str, ...]
    """With their units, e.g. `yaw_deg`."""
    recordings: list[Recording]


def as_arrays(claims: Claims) -> dict[str, np.ndarray]:
    """All of the claims, for a file."""
    arrays = {"name": np.array([claims.system, claims.data]), "coordinates": np.array(claims.coordinates)}
    for i, recording in enumerate(claims.recordings):
        parts = recording._asdict().items()
        arrays |= {f"{part}_{i}": np.asarray(values) for part, values in parts if values is not None}
    return arrays


def from_arrays(arrays: dict[str, np.ndarray]) -> Claims:
    """The claims of which `as_arrays` made these."""
    count = sum(name.startswith("errors_") for name in arrays)
    recordings = [
        Recording(arrays[f"errors_{i}"], arrays[f"deviations_{i}"], arrays.get(f"covariances_{i}"))
        for i in range(count)
    ]
    system, data = map(str, arrays["name"])
    return Claims(system, data, tuple(map(str, arrays["coordinates"])), recordings)


class Scores(NamedTuple):
    """Of one system on one kind of data; arrays have one number a coordinate."""

    coverage: Float[np.ndarray, "3 d"]
    """Shares within 1, 2 and 3 standard deviations; .683, .954 and .997 are right."""
    interval: Float[np.ndarray, "2 d"]
    """95 % interval of the share within 2, by drawing recordings; NaN with one recording."""
    effective_frames: float
    """Independent errors that the frames are worth, for the coordinate that has fewest."""
    nees: float
    """Mean normalised error squared of all coordinates together, d if claims are true."""
    nees_band: tuple[float, float]
    """Where it is with 95 % probability if claims are true, for so many effective frames."""
    autocorrelation: Float[np.ndarray, " d"]
    """Of errors from one frame to the next; NaN where recordings have one frame."""
    log_score: float
    """Mean negative log density a coordinate, in nats."""
    log_score_of_constant: float
    """The same of the best constant standard deviation of each coordinate, in hindsight: a claim should be below."""
    crps: Float[np.ndarray, " d"]
    """In the unit of the coordinate."""
    sharpness: Float[np.ndarray, " d"]
    """Root mean square of the claims over that of the errors; 1 is right."""
    rmse: Float[np.ndarray, " d"]
    """Root mean square error, in the unit of the coordinate."""
    transforms: Float[np.ndarray, " n"]
    """Probability integral transforms of all errors, for a picture."""


def judge(claims: Claims) -> Scores | None:
    """Scores of the claims; None where nothing was claimed."""
    usable = [recording for recording in map(_claimed, claims.recordings) if len(recording.errors)]
    if not usable:
        return None
    errors, deviations = (
        np.concatenate(parts) for parts in zip(*((r.errors, r.deviations) for r in usable), strict=True)
    )
    size = np.abs(errors / deviations)
    coverage = np.stack([np.mean(size <= limit, axis=0) for limit in SIGMAS])
    draws = [_draws(recording) for recording in usable]
    effective = float(np.min(np.sum([count for count, _ in draws], axis=0)))
    d = errors.shape[1]
    low, high = (float(end) for end in jf.diagnostics.chi_square_band(d, num_runs=effective))
    constant = np.sqrt(np.mean(errors**2, axis=0))
    return Scores(
        coverage,
        _interval(usable),
        effective,
        float(np.mean(np.concatenate([_nees(recording) for recording in usable]))),
        (low, high),
        _mean_correlation([phi for _, phi in draws], [len(recording.errors) for recording in usable]),
        _log_score(errors, deviations),
        _log_score(errors, np.broadcast_to(constant, errors.shape)),
        np.mean(np.asarray(jf.diagnostics.crps(jnp.asarray(errors), 0.0, jnp.asarray(deviations))), axis=0),
        np.sqrt(np.mean(deviations**2, axis=0)) / constant,
        constant,
        np.asarray(jf.diagnostics.pit(jnp.asarray(errors), 0.0, jnp.asarray(deviations))).ravel(),
    )


def metrics_of(claims: Claims, scores: Scores) -> dict[str, Metric]:
    """By name: a kind of metric, then the system, the data and, for those of one coordinate, the coordinate.

    What is unknown, such as the interval over a single recording, is left out. A system whose coordinates have one unit
    has a root mean square error over all of them.
    """
    name, d = f"{claims.system}_{claims.data}", len(claims.coordinates)
    units = [coordinate.rpartition("_")[2] for coordinate in claims.coordinates]
    low, high = scores.nees_band
    found = {
        **_coverages(name, np.mean(scores.coverage, axis=1)),
        f"nees_{name}": Metric(scores.nees / d, "", 1.0),
        f"lower_nees_{name}": Metric(low / d, "", 1.0),
        f"upper_nees_{name}": Metric(high / d, "", 1.0),
        f"log_score_{name}": Metric(scores.log_score, "nats", "lower"),
        f"log_score_gain_{name}": Metric(scores.log_score_of_constant - scores.log_score, "nats", "higher"),
        f"effective_frames_{name}": Metric(scores.effective_frames, "", "higher"),
    }
    if len(set(units)) == 1:
        found[f"rmse_{name}"] = Metric(float(np.sqrt(np.mean(scores.rmse**2))), units[0], "lower")
    for i, (coordinate, unit) in enumerate(zip(claims.coordinates, units, strict=True)):
        of = f"{name}_{coordinate}"
        lower, upper = 100 * scores.interval[:, i]
        found |= {
            **_coverages(of, scores.coverage[:, i]),
            f"lower_coverage2_{of}": Metric(float(lower), "%", 100 * WITHIN_TWO_SIGMA),
            f"upper_coverage2_{of}": Metric(float(upper), "%", 100 * WITHIN_TWO_SIGMA),
            f"autocorrelation_{of}": Metric(float(scores.autocorrelation[i]), "", "lower"),
            f"sharpness_{of}": Metric(float(scores.sharpness[i]), "", 1.0),
            f"crps_{of}": Metric(float(scores.crps[i]), unit, "lower"),
            f"rmse_{of}": Metric(float(scores.rmse[i]), unit, "lower"),
        }
    return {key: metric for key, metric in found.items() if math.isfinite(metric.value)}


def _coverages(name: str, shares: Float[np.ndarray, " 3"]) -> dict[str, Metric]:
    return {
        f"coverage{sigma:.0f}_{name}": Metric(100 * float(share), "%", 100 * right)
        for sigma, share, right in zip(SIGMAS, shares, WITHIN, strict=True)
    }


def table(evaluated: list[tuple[Claims, Scores]]) -> str:
    """One line a coordinate, and above those of a system what is of all its coordinates."""
    shares = ("1 sigma %", "2 sigma %", "95 % interval", "3 sigma %")
    header = ("coordinate", *shares, "autocorr.", "sharpness", "crps", "rmse")
    rows = [row for claims, scores in evaluated for row in _by_coordinate(claims, scores)]
    head, line, *lines = aligned([header, *rows], numbers=range(1, 9)).splitlines()
    shown = [head, line]
    for claims, scores in evaluated:
        low, high = scores.nees_band
        count = len(claims.coordinates)
        shown += [
            f"{claims.system}, {claims.data}: NEES {scores.nees:.3g} ({low:.3g} .. {high:.3g} if claims are true), "
            f"log score {scores.log_score:.3g} ({scores.log_score_of_constant:.3g} of a constant), "
            f"{scores.effective_frames:.0f} effective frames",
            *lines[:count],
        ]
        lines = lines[count:]
    return "\n".join(shown)


def _by_coordinate(claims: Claims, scores: Scores) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for i, coordinate in enumerate(claims.coordinates):
        one, two, three = (f"{100 * share:.0f}" for share in scores.coverage[:, i])
        low, high = 100 * scores.interval[:, i]
        interval = "-" if np.isnan(low) else f"{low:.0f} .. {high:.0f}"
        phi = scores.autocorrelation[i]
        correlation = "-" if np.isnan(phi) else f"{phi:.2f}"
        sizes = (f"{scores.sharpness[i]:.2g}", f"{scores.crps[i]:.3g}", f"{scores.rmse[i]:.3g}")
        rows.append((f"  {coordinate}", one, two, interval, three, correlation, *sizes))
    return rows


def draw_calibration(folder: Path, claims: Claims, scores: Scores) -> None:
    """A calibration curve as a picture, where matplotlib is installed."""
    if find_spec("matplotlib") is None:
        return
    axes = jf.plot.calibration(scores.transforms)
    axes.set_title(f"{claims.system}, {claims.data}: {axes.get_title()}")
    axes.figure.savefig(folder / f"calibration_{claims.system}_{claims.data}.png")


def _claimed(recording: Recording) -> Recording:
    """The frames in which every coordinate has an estimate, a truth and a positive claim."""
    good = np.isfinite(recording.errors).all(axis=1) & (np.nan_to_num(recording.deviations) > 0).all(axis=1)
    return jax.tree.map(lambda part: np.asarray(part, float)[good], recording)


def _draws(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    if len(recording.errors) < 2:
        return np.ones(recording.errors.shape[1]), np.full(recording.errors.shape[1], np.nan)
    found = jf.diagnostics.effective_draws(jnp.asarray(recording.errors, jnp.float32))
    return np.asarray(found.number, float), np.asarray(found.correlation, float)


def _mean_correlation(correlations: list[np.ndarray], lengths: list[int]) -> np.ndarray:
    known = [(phi, length) for phi, length in zip(correlations, lengths, strict=True) if np.isfinite(phi).all()]
    if not known:
        return np.full(correlations[0].shape, np.nan)
    return np.average([phi for phi, _ in known], axis=0, weights=[length for _, length in known])


def _nees(recording: Recording) -> np.ndarray:
    if recording.covariances is None:
        return np.sum((recording.errors / recording.deviations) ** 2, axis=1)
    return np.einsum(
        "ti,ti->t", recording.errors, np.linalg.solve(recording.covariances, recording.errors[..., None])[..., 0]
    )


def _interval(recordings: list[Recording]) -> np.ndarray:
    shares = np.stack([np.mean(np.abs(r.errors) <= 2 * r.deviations, axis=0) for r in recordings])
    if len(recordings) < 2:
        return np.full((2, shares.shape[1]), np.nan)
    counts = jnp.asarray([len(r.errors) for r in recordings], jnp.float32)
    found = jf.diagnostics.cluster_interval(jax.random.key(INTERVAL_KEY), jnp.asarray(shares, jnp.float32), counts)
    return np.stack([np.asarray(end, float) for end in found])


def _log_score(errors: np.ndarray, deviations: np.ndarray) -> float:
    return float(np.mean(0.5 * (errors / deviations) ** 2 + np.log(deviations)) + 0.5 * math.log(2 * math.pi))
