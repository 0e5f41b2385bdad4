"""The six systems beside the simplest thing that follows the same, and beside what their papers report.

Everything is synthetic, so that anybody can repeat it: the recordings that the commands make by themselves, other seeds
of them, and rendered faces. `*_simple` is without a filter: registration alone (hand), least squares of each frame's
features alone (articulated hand), blobs projected back to the floor (people), optical flow of the landmarks that the
tracker starts with, triangulated (two cameras) or with `solvePnP` and the true shape of the face, which no tracker has
(one camera), the convex hull of a bright hand (fingertips), the nearest neighbour by dynamic time warping
(symbols). `*_paper` is what the paper prints of data of its own, for a comparison of size only; the papers of the hand
and of the articulated hand print no error.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import jax
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import evaluate, floor_tracks
from jaxfilters.benchmarks.scenarios import _simplest as simplest
from jaxfilters.benchmarks.scenarios import fingertips
from jaxfilters.benchmarks.scenarios._articulated_paper import LAST
from jaxfilters.benchmarks.scenarios._head_runs import follow
from jaxfilters.benchmarks.scenarios._mono_runs import START_FRAMES, Contender, follow_all, talking_head
from jaxfilters.benchmarks.scenarios._poses import pose_errors
from jaxfilters.models.fingertip.segmentation import bright_mask
from jaxfilters.models.gesture.coded import learn_paths, recognise_paths
from jaxfilters.models.hand.skeleton import anatomical_hand
from jaxfilters.models.synthetic.articulated import LAYOUT, simulate_paper
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.models.synthetic.strokes import drawn, tracked
from jaxfilters.trackers import articulated, hand_depth, people
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.io.face_models import default_face_model
from jaxfilters.trackers.people.demo_room import demo_room

FIRST_SEED = 700
"""Of recordings that no constant was chosen on."""
SETTLED = 10
"""Frames of a hand after which errors count."""
HEAD_PAPER = {"z_mm": 2.71, "yaw_deg": 1.55}
"""Oka and Sato (2006), slow motion, adaptive: table 3."""
MONO_PAPER = {"z_mm": 9.56, "yaw_deg": 2.45}
"""Sugano (2007), known person: table 4.1."""
SYMBOLS_PAPER = 99.2
"""Percent of symbols with one finger, Oka, Sato and Koike (2002), table 2."""
POSE = ("x_mm", "y_mm", "z_mm", "roll_deg", "yaw_deg", "pitch_deg")


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow all six; `out` is not used."""
    del out
    found: dict[str, Metric] = {}
    for system in SYSTEMS:
        part = system(quick, FIRST_SEED + seed)
        sys.stderr.write(f"  {', '.join(f'{name} {metric.value:.3g}' for name, metric in part.items())}\n")
        found |= part
    return found


def hand_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Mean error of the 21 joints."""
    errors: dict[str, list[float]] = {"": [], "_simple": []}
    for one in range(seed, seed + (1 if quick else 3)):
        recording, truth = hand_depth.synthetic_sequence(one)
        count = 20 if quick else 60
        frames, config = [recording[i] for i in range(count)], hand_depth.HandDepthConfig(seed=one, hand="right")
        track = hand_depth.track(frames, recording.times_s[:count], recording.camera, config)
        alone = simplest.registered_hands(
            recording.camera, np.stack(frames), np.asarray(track.pose[0]), anatomical_hand()
        )
        for name, joints in (("", track.joints), ("_simple", alone)):
            apart = np.linalg.norm(joints - truth[:count], axis=-1)[SETTLED:]
            errors[name].append(1e3 * float(apart.mean()))
    return {f"hand_depth_joints_mm{name}": _mean(values, "mm") for name, values in errors.items()}


def articulated_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Root mean square errors of angles and lengths in the last frames of the paper's sequence."""
    angles: dict[str, list[float]] = {"": [], "_simple": []}
    lengths: dict[str, list[float]] = {"": [], "_simple": []}
    for one in range(seed, seed + (1 if quick else 6)):
        made = simulate_paper(jax.random.key(one))
        mean = articulated.track_sequence(articulated.synthetic_sequence(one)).mean
        for name, states in (("", mean), ("_simple", simplest.reprojected_hand(made))):
            off = (np.asarray(states, float) - np.asarray(made.states, float))[-LAST:]
            angles[name].append(_rms((np.rad2deg(off[:, LAYOUT.angles]) + 180) % 360 - 180))
            lengths[name].append(_rms(off[:, LAYOUT.lengths]))
    found = {f"articulated_angles_deg{name}": _mean(values, "deg") for name, values in angles.items()}
    return found | {f"articulated_lengths_px{name}": _mean(values, "px") for name, values in lengths.items()}


def people_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Accuracy of tracks and mean error of places, four people in a room with a desk and a pillar."""
    room = demo_room(seed, frames=40 if quick else 120)
    images = [room.image(0, i) for i in range(len(room))]
    scene = people.people_scene(room.cameras, room.floor, furniture=room.furniture)
    tracks = people.track([[image] for image in images], [i / room.fps for i in range(len(room))], scene)
    ours = [(one.frame, identity, *one.mean[:2]) for identity, track in tracks.items() for one in track]
    empty = np.median(np.stack(images), axis=0).astype(np.uint8)
    present = [(i, identity) for i in range(len(room)) for identity in np.flatnonzero(room.present(i))]
    frames, whose = zip(*present, strict=True)
    truth = floor_tracks(frames, whose, np.stack([room.routes.xy[i, identity] for i, identity in present]))
    found: dict[str, Metric] = {}
    for name, rows in (("", ours), ("_simple", simplest.followed_blobs(images, empty, room.cameras[0]))):
        frame, identity, x, y = zip(*rows, strict=True)
        scores = evaluate(truth, floor_tracks(frame, identity, np.stack([x, y], axis=-1)))
        found[f"people_mota{name}"] = Metric(float(scores.mota), "%", "higher")
        found[f"people_error_m{name}"] = Metric(float(scores.mean_error_m), "m", "lower")
    return found


def stereo_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Root mean square errors of the pose of slow heads before two cameras."""
    errors: dict[str, list[np.ndarray]] = {"": [], "_simple": []}
    for head in range(seed, seed + (1 if quick else 3)):
        made = sequence(jax.random.key(head), "slow", 30 if quick else 150, head)
        track = follow(made, {"": HeadConfig(learn=False)})[""].track
        errors[""].append(_pose_rms(np.asarray(track.pose), made.poses[1:]))
        images = [image for _, part in made.chunks() for image in part]
        uv = np.stack([simplest.flowed_points([image[k] for image in images], made.uv[0, k]) for k in range(2)], axis=1)
        poses = simplest.pose_by_triangulation(np.asarray(made.shapes[0], float), uv, simplest.projections(made.rig))
        errors["_simple"].append(_pose_rms(poses[1:], made.poses[1:]))
    return _pose_metrics("head_stereo", errors, HEAD_PAPER)


def mono_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Mean errors of the pose of talking heads before one camera, whose faces no model knows."""
    errors: dict[str, list[np.ndarray]] = {"": [], "_simple": []}
    first = START_FRAMES[-1] + 1
    for head in range(seed, seed + (1 if quick else 3)):
        made = talking_head(head, 60 if quick else 150)
        contender = Contender(default_face_model().model, MonoConfig(seed=head))
        run = follow_all(made, {"": contender}, head)[""]
        errors[""].append(run.means)
        images = [image[0] for _, part in made.chunks() for image in part]
        poses = simplest.pose_by_pnp(
            np.asarray(made.shapes[0], float), simplest.flowed_points(images, made.uv[0, 0]), made.rig
        )
        of_simple = np.abs(pose_errors(poses, made.poses))[first:]
        errors["_simple"].append(np.mean(of_simple[len(of_simple) - len(run.errors) :][run.is_tracked], axis=0))
    return _pose_metrics("head_mono", errors, MONO_PAPER)


def fingertip_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Share of frames with the right number of fingertips, one to five of them, infrared."""
    key, frames = jax.random.key(seed), 12 if quick else 100
    rendered = [fingertips.render(key, count, frames) for count in range(1, 6)]
    parameters = fingertips.open_hand(key)
    right: dict[str, list[float]] = {"": [], "_simple": []}
    for count, video in enumerate(rendered, 1):
        masks = [bright_mask(frame.image, parameters.threshold) for frame in video]
        observed = fingertips.stacked([fingertips.detected(frame.image, parameters) for frame in video])
        report = fingertips.follow(*fingertips.METHODS[""], jax.tree.map(lambda leaf: leaf[None], observed))
        right[""].append(100 * float(np.mean(report.num_tips[0] == count)))
        hulls = [simplest.fingers_by_hull(np.asarray(mask)) for mask in masks]
        right["_simple"].append(100 * float(np.mean(np.array(hulls) == count)))
    return {f"fingertips_count{name}": _mean(values, "%", "higher") for name, values in right.items()}


def symbol_metrics(quick: bool, seed: int) -> dict[str, Metric]:
    """Share of symbols of one finger by other writers that are right."""
    shown = tracked(drawn(seed, 4 if quick else 20))
    chosen = [i for i, label in enumerate(shown.labels) if label.endswith("1")]
    model = learn_paths(shown.paths, shown.labels)
    known, labels = [shown.paths[i][0] for i in chosen], [shown.labels[i] for i in chosen]
    right: dict[str, list[float]] = {"": [], "_simple": []}
    for writer in range(1 if quick else 4):
        other = tracked(drawn(seed + 1 + writer, 1 if quick else 5))
        ones = [i for i, label in enumerate(other.labels) if label.endswith("1")]
        truth = [other.labels[i] for i in ones]
        evaluated = recognise_paths(model, [other.paths[i] for i in ones], margin=-np.inf)
        ours = np.array([*model.names, ""])[evaluated.label]
        near = simplest.nearest_by_warping(known, labels, [other.paths[i][0] for i in ones])
        right[""].append(100 * float(np.mean(ours == truth)))
        right["_simple"].append(100 * float(np.mean(np.array(near) == truth)))
    found = {f"symbols_right{name}": _mean(values, "%", "higher") for name, values in right.items()}
    return found | {"symbols_right_paper": Metric(SYMBOLS_PAPER, "%", "higher")}


def _pose_rms(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(pose_errors(poses, truth) ** 2, axis=0))


def _pose_metrics(system: str, errors: dict[str, list[np.ndarray]], paper: dict[str, float]) -> dict[str, Metric]:
    found: dict[str, Metric] = {}
    for axis, printed in paper.items():
        unit, i = axis.rpartition("_")[2], POSE.index(axis)
        for name, of_heads in errors.items():
            found[f"{system}_{axis}{name}"] = _mean([float(one[i]) for one in of_heads], unit)
        found[f"{system}_{axis}_paper"] = Metric(printed, unit, "lower")
    return found


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.asarray(values, float) ** 2)))


def _mean(values: list[float], unit: str, better: Literal["lower", "higher"] = "lower") -> Metric:
    return Metric(float(np.mean(values)), unit, better)


SYSTEMS: tuple[Callable[[bool, int], dict[str, Metric]], ...] = (
    hand_metrics,
    articulated_metrics,
    people_metrics,
    stereo_metrics,
    mono_metrics,
    fingertip_metrics,
    symbol_metrics,
)
