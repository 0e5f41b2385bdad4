"""Heads before one camera: the thesis's experiments on rendered faces, starts, ablations, modelled people, real video.

Tables 4.1 to 4.3 of Sugano's thesis (2007): errors over eight users, of `b_` and `b_eyes_` over 24, by mean, median and
worst. `a_` knows faces of eleven people, the user among them, and may recognise them; `c_` is `a_` with an adjustment
at the start alone, `a_unknown_` takes everybody for unknown. `b_` does not know the user: its model is of 200 other
people of the generator, and its gallery is empty; beside its error in depth stands that of the size which the exact
shapes of the same faces tell, `error_b_z_of_exact_shape`; `error_modelled_z_of_` is that of people of the ICT face
model from their ten or 68 landmarks or points of their skin, with and without errors. `b_ten_` has the model of the ten
of the eleven who are not the user, as in the thesis, and may take the user for one of them. `b_eyes_` is `b_` and knows
the distance between the user's eyes to a millimetre, `b_past_` keeps the information of frames that leave the window,
`b_angles_` and `b_latest_` choose frames otherwise, `b_rendered_modelled_` has the model of people of the ICT face
model. `_paper` is the tracker of the thesis, `_paper_map` the same with priors, `_projected` without measured
landmarks. Starts are judged by how widely the five heads are turned. Modelled people are followed by two models of
faces, by one of them also from 68 landmarks, `modelled_68_`. Metrics that end in `_modelled` are of the same people
from their images alone, as a detector finds their landmarks, beside `solvePnP` on the same landmarks (`pnp_`); in
`_modelled_rendered` with the model of the package, in `_mediapipe` with MediaPipe's mesh where it is installed, in
`_modelled_glasses` and `_modelled_beard` with the model of the package and what these people then wear, in
`_modelled_at_300mm` and the like with this model, at other distances, for 150 frames each. They need
`ict_face_model`, `biwi_head_rotation` and `livelinkface_take` in the folder JAXFILTERS_DATA, the videos
`talking_face_video`; what is missing is said and left out. All of it takes hours: with `--out`, a run that was cut off
goes on after the last user and the last part that it had finished.
"""

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import numpy as np

from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import WITHIN_TWO_SIGMA, Metric
from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios._mono_detected import distance_metrics, people_metrics
from jaxfilters.benchmarks.scenarios._mono_floor import modelled_rotation_metrics, modelled_size_metrics, size_errors
from jaxfilters.benchmarks.scenarios._mono_real import cross_model, modelled_metrics, video_metrics
from jaxfilters.benchmarks.scenarios._mono_runs import (
    Contender,
    MonoRun,
    as_arrays,
    eyes_apart_of,
    follow_all,
    from_arrays,
    learnt_from,
    over_users,
    talking_head,
)
from jaxfilters.benchmarks.scenarios._mono_speed import speed_metrics
from jaxfilters.benchmarks.scenarios._mono_starts import start_metrics
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.synthetic.face import make_identity
from jaxfilters.trackers.head.mono.config import PUBLISHED, MonoConfig

THESIS = {
    "a": (2.60, 3.12, 9.56, 0.43, 2.45, 2.33),
    "b": (3.73, 1.92, 17.85, 0.43, 3.07, 2.49),
    "c": (2.71, 3.43, 11.38, 0.43, 2.52, 2.26),
}
"""Mean errors of tables 4.1 to 4.3 in millimetres and degrees, in the order of `AXES`."""
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
AXIS_UNITS = ("mm", "mm", "mm", "deg", "deg", "deg")
AXIS_ORDER = [0, 1, 2, 3, 5, 4]
"""Where they are in a pose of the tracker."""
FIRST_USER, NUM_USERS, NUM_KNOWN, NUM_MANY = 300, 8, 11, 200
NUM_UNKNOWN_USERS = 24
"""Users of `b` and `b_eyes`: how large an unknown person is is luck, and the mean over eight people says little."""
DISTANCE_MM = 650.0
"""Of the heads."""
FIRST_OTHER = 1000
"""Of the people who are never users."""
NUM_FRAMES, QUICK_NUM_FRAMES = 900, 64
WIDE_IDENTITIES, EYES_STD_MM = 15, 1.0
USUAL = MonoConfig()
PAPER_MAP = replace(PUBLISHED, prior_weight=0.7)


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Run all parts, print the scores, return them."""
    users = range(1 if quick else NUM_UNKNOWN_USERS)
    kept = Finished(out, scenario="head-mono", quick=quick, seed=seed)
    metrics = experiment_metrics(users, QUICK_NUM_FRAMES if quick else NUM_FRAMES, seed, quick, kept)
    parts = {
        "floor": lambda: _floor(users),
        "modelled_floor": lambda: modelled_size_metrics(seed, DISTANCE_MM) | modelled_rotation_metrics(seed),
        "starts": lambda: start_metrics(learnt_from(people_but(None), 10, seed).face, seed, 2 if quick else 40),
        "speed": lambda: speed_metrics(seed, 3 if quick else 25),
        "modelled": lambda: modelled_metrics(quick, seed),
        "detected": lambda: people_metrics(quick, seed),
        "distances": lambda: distance_metrics(quick, seed),
        "videos": lambda: video_metrics(quick, seed),
    }
    for name, part in parts.items():
        try:
            metrics |= kept.metrics(name, part)
        except RecordingError as error:
            sys.stderr.write(f"  left out: {error}\n")
    return metrics


def people_but(user: int | None) -> list:
    """The eleven of whom the training faces are, but for one."""
    return [_identity(FIRST_USER + i) for i in range(NUM_KNOWN) if i != user]


def contenders_for(user: int, seed: int, quick: bool) -> dict[str, Contender]:
    """All trackers, with what each may know of the user."""
    known, of_known = learnt_from(people_but(None), 10, seed)
    best = {"a": Contender(known, USUAL, of_known)}
    if quick:
        return best
    many = _of_many(seed)
    apart = eyes_apart_of(_identity(FIRST_USER + user)) + np.random.default_rng([seed, user, 1]).normal(0, EYES_STD_MM)
    unknown_users = {"b": Contender(many, USUAL), "b_eyes": Contender(many, replace(USUAL, eyes_apart_mm=apart))}
    if user >= NUM_USERS:
        return unknown_users
    unknown, of_unknown = learnt_from(people_but(user), 10, seed)
    best |= unknown_users | {
        "a_unknown": Contender(known, USUAL),
        "b_ten": Contender(unknown, USUAL, of_unknown),
        "b_past": Contender(many, replace(USUAL, past="marginalised")),
        "b_angles": Contender(many, replace(USUAL, selection="angles")),
        "b_latest": Contender(many, replace(USUAL, selection="latest")),
        "c": Contender(known, replace(USUAL, adjust=False), of_known),
        "a_paper_map_projected": Contender(known, replace(PAPER_MAP, landmarks="projected")),
    }
    for name, options in (("paper", PUBLISHED), ("paper_map", PAPER_MAP)):
        best |= {
            f"a_{name}": Contender(known, options),
            f"b_{name}": Contender(unknown, options),
            f"c_{name}": Contender(known, replace(options, adjust=False)),
        }
    return best | cross_model(seed)


def experiment_metrics(users: range, num_frames: int, seed: int, quick: bool, kept: Finished) -> dict[str, Metric]:
    """Errors of all trackers over the users."""

    def follow(user: int) -> dict[str, np.ndarray]:
        made = talking_head(FIRST_USER + user, num_frames)
        return as_arrays(follow_all(made, contenders_for(user, seed, quick), seed + user))

    runs: dict[str, list[MonoRun]] = {}
    for user in users:
        for name, one in from_arrays(kept.arrays(f"user-{user}", partial(follow, user))).items():
            runs.setdefault(name, []).append(one)
            sys.stderr.write(f"  user {user}, {name}: {np.round(one.means[AXIS_ORDER], 2)}\n")
    metrics: dict[str, Metric] = {}
    for name, of_users in runs.items():
        metrics |= errors_of(name, of_users)
    for name in ("a", "a_paper", "a_paper_map"):
        if (without := name.replace("a", "c", 1)) in runs:
            nearer = [one.means[2] < other.means[2] for one, other in zip(runs[name], runs[without], strict=True)]
            metrics[f"users_better_adjusted_{name}"] = Metric(100 * float(np.mean(nearer)), "%", "higher")
    if "a" in runs:
        right = [np.mean(one.person_index == user) for user, one in enumerate(runs["a"])]
        metrics["recognised_share"] = Metric(100 * float(np.mean(right)), "%", "higher")
    if "b_ten" in runs:
        wrong = [np.mean(one.person_index >= 0) for one in runs["b_ten"]]
        metrics["mistaken_share"] = Metric(100 * float(np.mean(wrong)), "%", "lower")
    return metrics


def errors_of(name: str, runs: list[MonoRun]) -> dict[str, Metric]:
    """Errors, ratios to the thesis and coverage of one tracker."""
    errors = over_users(runs, lambda run: run.means[AXIS_ORDER])
    inside = over_users(runs, lambda run: run.coverage[AXIS_ORDER]).mean
    metrics: dict[str, Metric] = {}
    for i, (axis, unit) in enumerate(zip(AXES, AXIS_UNITS, strict=True)):
        mean, thesis = float(errors.mean[i]), THESIS[name[0]][i]
        metrics |= {
            f"error_{name}_{axis}": Metric(mean, unit, "lower"),
            f"error_{name}_{axis}_median": Metric(float(errors.median[i]), unit, "lower"),
            f"error_{name}_{axis}_worst": Metric(float(errors.worst[i]), unit, "lower"),
            f"ratio_to_thesis_{name}_{axis}": Metric(mean / thesis, "", "lower"),
            f"coverage_{name}_{axis}": Metric(100 * float(inside[i]), "%", 100 * WITHIN_TWO_SIGMA),
        }
    landmark = over_users(runs, lambda run: np.nanmean(run.landmark_mm[run.is_tracked]))
    lost = over_users(runs, lambda run: np.mean(~run.is_tracked))
    return metrics | {
        f"error_{name}_landmark": Metric(float(landmark.mean), "mm", "lower"),
        f"error_{name}_landmark_worst": Metric(float(landmark.worst), "mm", "lower"),
        f"lost_share_{name}": Metric(100 * float(lost.mean), "%", "lower"),
    }


def _floor(users: range) -> dict[str, Metric]:
    """How well the depth of the same unknown people can be distinguished from their exact shapes."""
    shapes = np.stack([np.asarray(_identity(FIRST_USER + user).neutral) for user in users])
    message = DISTANCE_MM * np.abs(size_errors(shapes))
    return {"error_b_z_of_exact_shape": Metric(float(np.mean(message)), "mm", "lower")}


@cache
def _of_many(seed: int) -> MultilinearFace:
    """Estimated from people who are never users."""
    return learnt_from([_identity(FIRST_OTHER + i) for i in range(NUM_MANY)], WIDE_IDENTITIES, seed).face


def _identity(number: int):
    """Of the user with that number: as `talking_head` draws it."""
    return make_identity(jax.random.split(jax.random.key(number), 3)[0])
