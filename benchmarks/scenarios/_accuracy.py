"""Accuracy of hand filters on recordings with known truth: many seeds, the same random numbers for every filter."""

import csv
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from jaxfilters.benchmarks.scenarios._hand_filters import Estimate
from jaxfilters.models.hand.skeleton import local
from jaxfilters.models.synthetic.depth_sensor import depth_from_millimetres
from jaxfilters.models.synthetic.hand import HandSequence, simulate_sequence
from jaxfilters.typing import AnyKey

SETTLED = 10
"""Frames before errors count."""
LOST = 40.0
"""Millimetres of mean joint error above which a run counts as lost."""
TIPS = (4, 8, 12, 16, 20)

Filtering = Callable[[AnyKey, Float[Array, "t rows cols"]], Estimate]
"""`(key, frames in metres) -> estimates`: everything about one filter but the recording."""


@dataclass(frozen=True)
class Run:
    """One filter on one recording, after the first frames."""

    data: str
    """`A` or `B`."""
    filter: str
    seed: int
    joint_mm: float
    """Mean 3-D error of the 21 joints."""
    tip_mm: float
    """The same of the five fingertips."""
    wrist_x_mm: float
    """Root mean square, as are the following."""
    wrist_y_mm: float
    wrist_z_mm: float
    rotation_deg: float
    angle_deg: float
    ess: float
    """Mean effective sample size."""

    @property
    def lost(self) -> bool:
        """Whether the mean joint error is above `LOST`; without an estimate in some frame it is NaN, and lost."""
        return not self.joint_mm <= LOST


class Track(NamedTuple):
    """What one recording was and what each filter made of it."""

    truth: HandSequence
    estimates: dict[str, Estimate]


def evaluate(data: str, filter: str, seed: int, estimate: Estimate, truth: HandSequence) -> Run:
    """Errors of estimates against the truth of the same frames."""
    joints = 1e3 * np.linalg.norm(np.asarray(estimate.joints) - np.asarray(truth.joints), axis=-1)[SETTLED:]
    pose_error = np.asarray(_locals(truth.poses, estimate.pose))[SETTLED:]
    square = np.mean(pose_error**2, axis=0)
    wrist = 1e3 * np.sqrt(square[:3])
    return Run(
        data,
        filter,
        seed,
        joint_mm=float(joints.mean()),
        tip_mm=float(joints[:, TIPS].mean()),
        wrist_x_mm=float(wrist[0]),
        wrist_y_mm=float(wrist[1]),
        wrist_z_mm=float(wrist[2]),
        rotation_deg=float(np.degrees(np.sqrt(square[3:6].sum()))),
        angle_deg=float(np.degrees(np.sqrt(square[6:].mean()))),
        ess=float(np.mean(np.asarray(estimate.ess)[SETTLED:])),
    )


@jax.jit
def _locals(reference: Float[Array, "t 22"], poses: Float[Array, "t 22"]) -> Float[Array, "t 21"]:
    return jax.vmap(local)(reference, poses)


def run_all(filters: dict[str, Filtering], data: str, seed: int, num_frames: int | None) -> tuple[list[Run], Track]:
    """Every filter on one recording of `data`.

    The recording and the random numbers of the filters depend on the seed alone, so that results can be paired.
    """
    recording_key, filter_key = jax.random.split(jax.random.key(seed))
    truth = simulate_sequence(recording_key, data, num_frames=num_frames)
    frames = depth_from_millimetres(truth.depth_mm)
    estimates = {name: jax.block_until_ready(filter(filter_key, frames)) for name, filter in filters.items()}
    runs = [evaluate(data, name, seed, estimate, truth) for name, estimate in estimates.items()]
    return runs, Track(truth._replace(depth_mm=truth.depth_mm[:0]), estimates)


def as_arrays(runs: list[Run]) -> dict[str, np.ndarray]:
    """(runs,) values of each field, for a file."""
    return {field.name: np.array([getattr(run, field.name) for run in runs]) for field in dataclasses.fields(Run)}


def from_arrays(arrays: dict[str, np.ndarray]) -> list[Run]:
    """The runs of which `as_arrays` made these."""
    return [
        Run(*(arrays[field.name][i].item() for field in dataclasses.fields(Run))) for i in range(len(arrays["seed"]))
    ]


def append_csv(path: Path, runs: list[Run]) -> None:
    """Add rows to a table, with its header if it is new: a run that is stopped keeps what it has done."""
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in dataclasses.fields(Run)])
        if new:
            writer.writeheader()
        writer.writerows(map(dataclasses.asdict, runs))


class Column(NamedTuple):
    """The runs of one filter on one kind of data, in the order of their seeds."""

    data: str
    filter: str
    runs: list[Run]

    def of(self, quantity: str) -> np.ndarray:
        """(seeds,) values of a field of `Run`."""
        return np.array([getattr(run, quantity) for run in self.runs], dtype=float)


def column(runs: list[Run], data: str, filter: str) -> Column:
    """What `runs` holds of one filter on one kind of data."""
    mine = [run for run in runs if (run.data, run.filter) == (data, filter)]
    return Column(data, filter, sorted(mine, key=lambda run: run.seed))


def p_value_better(candidate: np.ndarray, baseline: np.ndarray) -> float:
    """One-sided p-value of Wilcoxon's signed-rank test that `candidate` is below `baseline`, paired, exact if small.

    1 where no pair differs. Five pairs at least are needed for it to fall below 0.05, seven for 0.01.
    """
    if np.array_equal(candidate, baseline):
        return 1.0
    return float(stats.wilcoxon(candidate, baseline, alternative="less").pvalue)
