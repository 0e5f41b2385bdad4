"""`jaxfilters fit noise`: the noises of a constant-velocity filter from tracks of points, without any truth."""

import argparse
import json
from pathlib import Path

import numpy as np

from jaxfilters.models.moving_points import learn, tracks_of
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.json_files import write_json
from jaxfilters.trackers.io.points import read_points

_SYNTHETIC = (0.5, 40.0)
"""Sensor noise and drive of the tracks that are made up where no file is given."""


def fit_noise(options: argparse.Namespace) -> str:
    """Learn both noises, write `options.out` if there is one, and return a table.

    Raises:
        InputError: the tracks cannot be used.
        OutputError: the file cannot be written.
    """
    points, times = _synthetic(options.seed) if options.tracks is None else read_points(options.tracks, options.fps)
    tracks, _ = as_input_error(lambda: tracks_of(points, times))
    if not float(tracks.extent) > 0:
        raise InputError(f"{options.tracks}: all points are at rest; expected points that move, and their noise.")
    found = as_input_error(lambda: learn(tracks))
    if not bool(found.converged):
        raise InputError(
            f"{options.tracks}: no noise parameters explain these tracks ({found.termination}); expected noisy "
            "readings of points whose velocity changes."
        )
    if options.out is not None:
        _write(options.out, found, points, times)
    made_up = "" if options.tracks else f"Synthetic tracks: sensor {_SYNTHETIC[0]}, drive {_SYNTHETIC[1]}.\n"
    return f"{made_up}{found}\nsensor: of one reading; drive: of the velocity after a second; in the unit of the tracks"


def _write(path: Path, found, points: np.ndarray, times: np.ndarray) -> None:
    document = {
        "sensor": float(found.theta.sensor),
        "sensor_standard_error": float(found.standard_errors.sensor),
        "drive": float(found.theta.drive),
        "drive_standard_error": float(found.standard_errors.drive),
        "log_likelihood": float(found.log_density),
        "frames": len(times),
        "points": points.shape[1],
    }
    write_json(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def _synthetic(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Five points in a plane, driven and observed with known noises at 30 frames a second."""
    rng = np.random.default_rng(seed)
    sensor, drive = _SYNTHETIC
    dt = 1 / 30
    root = np.linalg.cholesky(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    kicks = drive * np.einsum("ij,tpcj->tpci", root, rng.normal(size=(300, 5, 2, 2)))
    velocity = np.cumsum(kicks[..., 1], axis=0)
    before = np.concatenate([np.zeros((1, 5, 2)), velocity[:-1]])
    place = np.cumsum(dt * before + kicks[..., 0], axis=0)
    return place + sensor * rng.normal(size=place.shape), dt * np.arange(300)
