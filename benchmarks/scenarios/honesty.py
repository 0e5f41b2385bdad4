"""Whether claimed standard deviations are true: hands, people, heads and fingertips on data with truth, in one table.

The systems are the hand from depth images, the articulated hand, people, heads before one and two cameras, and
fingertips, whose marked frames of real videos are far apart. Symbols are not in it: their confidences are judged in
`gestures`. Last come three filters of the same detected key points, whose errors are taken for lasting, for inflated
white and for white noise.

For each system and kind of data, and by coordinate: the share of true values within 1, 2 and 3 of the claimed standard
deviations (68, 95 and 99.7 % are right), with an interval by drawing whole recordings; the autocorrelation of errors
from frame to frame; the ratio of claims to errors (sharpness, 1 is right); the continuous ranked probability score and
the root mean square error. Of all coordinates together: the normalised error squared with its band for as many frames
as the errors are worth, and the log score beside that of the best constant claim. `nees_` is a coordinate's share, 1 is
right, with the ends `lower_nees_` and `upper_nees_` of its band; `log_score_gain_` is what the claim is better than the
constant; `lower_coverage2_` and `upper_coverage2_` are the ends of the interval. A folder given with `--out` receives a
calibration curve of each, and a run that was cut off goes on there after the last system that it had finished. Systems
whose recordings are missing are named and left out.
"""

import re
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.finished import Finished
from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.multi_object import FloorTracks, floor_tracks, match
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios import (
    _keypoint_filters,
    _mono_detected,
    _mono_real,
    _real_hands,
    _real_motion,
    _tip_claims,
    head_real,
    people_pets,
)
from jaxfilters.benchmarks.scenarios._claims import (
    Claims,
    Recording,
    as_arrays,
    draw_calibration,
    from_arrays,
    judge,
    metrics_of,
    table,
)
from jaxfilters.benchmarks.scenarios._head_runs import HeadRun, follow
from jaxfilters.benchmarks.scenarios._keypoint_filters import MODELS, Keypoints
from jaxfilters.benchmarks.scenarios._mono_runs import Contender, MonoRun, follow_all, talking_head
from jaxfilters.benchmarks.scenarios._pets import load_pets
from jaxfilters.benchmarks.scenarios._poses import DISPLAY, pose_errors
from jaxfilters.benchmarks.scenarios._real_mocap import FINGERS, VIEWS, load_capture, track_lengths, true_lengths
from jaxfilters.models.synthetic.face_sequence import sequence
from jaxfilters.trackers import hand_depth
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.table import TRACKED
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.detectors import DETECTORS
from jaxfilters.trackers.io.face_models import default_face_model, people_face_model
from jaxfilters.trackers.people.recorded import Sighting
from jaxfilters.trackers.people.state import PeopleConfig

POSE = ("x_mm", "y_mm", "z_mm", "roll_deg", "yaw_deg", "pitch_deg")
FIRST_HEAD = 500
"""Seed of the first rendered head; no tracker was made with it, and no other scenario takes it."""
NUM_HEADS, QUICK_NUM_HEADS = 6, 2
NUM_FRAMES, QUICK_NUM_FRAMES = 300, 90
QUICK_PEOPLE_FRAMES = 60
QUICK_CAPTURE_FRAMES, CAPTURE_FRAMES = 1000, 3000
QUICK_KEYPOINT_FRAMES = 400
QUICK_HANDS, QUICK_HAND_FRAMES = 2, 16
PIP_COLUMNS = np.array([12, 15, 18, 21])
"""Of the pose: flexion of the second joint of the four fingers."""
CHOSEN_FRAMES = 350
"""Of the recordings of keypoints of real hands: constants of the articulated tracker were chosen on them."""
DETECTED_HANDS: dict[str, dict[str, Any]] = {
    "nyu_feedback": {"hands": "nyu"},
    "nyu_v2v": {"hands": "nyu", "network": 1},
    "icvl_v2v": {"hands": "icvl"},
    "nyu_feedback_palm_width": {"hands": "nyu", "known_size": True},
    "nyu_v2v_palm_width": {"hands": "nyu", "network": 1, "known_size": True},
    "icvl_v2v_palm_width": {"hands": "icvl", "known_size": True},
}
"""Recordings and networks by name, without and with the width of the palm."""
SETTLED = 30
"""Frames of key points after which the start is forgotten."""


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Run all systems, print the table, return its numbers."""
    evaluated, metrics = [], dict[str, Metric]()
    kept = Finished(out, scenario="honesty", quick=quick, seed=seed)
    for name, claims_of in SYSTEMS.items():
        try:
            found = _measured_once(kept, name, partial(claims_of, quick, seed))
        except RecordingError as error:
            sys.stderr.write(f"  left out: {name} ({error})\n")
            continue
        scores = judge(found)
        if scores is None:
            sys.stderr.write(f"  left out: {name} (it claims nothing on this data)\n")
            continue
        sys.stderr.write(f"  {name}: within 2 sigma {np.round(100 * scores.coverage[1])} %\n")
        evaluated.append((found, scores))
        metrics |= metrics_of(found, scores)
        if out is not None:
            draw_calibration(out, found, scores)
    sys.stderr.write(f"{table(evaluated)}\n")
    return metrics


def _measured_once(kept: Finished, name: str, claims_of: Callable[[], Claims]) -> Claims:
    return from_arrays(kept.arrays("_".join(re.findall(r"\w+", name)), lambda: as_arrays(claims_of())))


def stereo_claims(quick: bool, seed: int) -> Claims:
    """Heads before two cameras, rendered, with slow motion."""
    runs = []
    for head in _heads(quick, seed):
        made = sequence(jax.random.key(head), "slow", QUICK_NUM_FRAMES if quick else NUM_FRAMES, head)
        runs.append(follow(made, {"": HeadConfig(learn=False)})[""])
    return Claims("head_stereo", "rendered", POSE, [_of_head(run) for run in runs])


def mono_claims(quick: bool, seed: int) -> Claims:
    """Heads before one camera, rendered, who move and speak; the model of faces is that of the package."""
    contender = Contender(default_face_model().model, MonoConfig(seed=seed))
    num_frames = QUICK_NUM_FRAMES if quick else NUM_FRAMES
    runs = [follow_all(talking_head(head, num_frames), {"": contender}, head)[""] for head in _heads(quick, seed)]
    return Claims("head_mono", "rendered", POSE, [_of_mono(run) for run in runs])


def stereo_people_claims(quick: bool, seed: int) -> Claims:
    """People of the ICT face model before two cameras, who turn and speak as recorded."""
    people = head_real.modelled_people(quick, seed)
    return Claims("head_stereo", "ict", POSE, [_where(p.is_tracked, p.errors, p.deviations) for p in people])


def mono_people_claims(quick: bool, seed: int) -> Claims:
    """The same kind of people before one camera: found by the cascades, followed with the model of the package."""
    film, recordings = _mono_detected.filming(quick, seed), []
    for person, stretch in _mono_real.PEOPLE[: 1 if quick else None]:
        made = film(person, stretch)
        face, detector, images = people_face_model().model, DETECTORS["cascades"](), made.frames(0, len(made))
        track = _mono_detected.followed(made, images, face, detector, person + seed)
        errors = pose_errors(track.pose, made.poses)
        recordings.append(_where(np.isin(track.status, TRACKED), errors, np.asarray(track.pose_std) * DISPLAY))
    return Claims("head_mono", "ict", POSE, recordings)


def hand_claims(quick: bool, seed: int) -> Claims:
    """Wrists and second joints of fingers in depth images of hands on which no constant was chosen."""
    recordings = []
    for name in _real_hands.HELD[: QUICK_HANDS if quick else None]:
        real = _real_hands.load(name, QUICK_HAND_FRAMES if quick else _real_hands.NUM_FRAMES)
        found = hand_depth.track(iter(real.depth), real.times_s, real.camera, hand_depth.HandDepthConfig(seed=seed))
        wrist = 1e3 * (found.pose[:, :3] - real.joints[:, 0])
        bent = np.degrees(found.pose[:, PIP_COLUMNS] - _real_hands.pip_flexion(real.joints))
        deviations = np.c_[1e3 * found.pose_std[:, :3], np.degrees(found.pose_std[:, PIP_COLUMNS - 1])]
        recordings.append(Recording(np.c_[wrist, bent], deviations))
    fingers = tuple(f"{finger}_pip_deg" for finger in FINGERS[1:])
    return Claims("hand_depth", "real", ("wrist_x_mm", "wrist_y_mm", "wrist_z_mm", *fingers), recordings)


def articulated_claims(quick: bool, seed: int) -> Claims:
    """Lengths of links from motion capture before a virtual camera, at the end of each view."""
    path = recording_folder("dfki_hand_mocap") / "recording.npz"
    recordings = []
    for number, view in enumerate(list(VIEWS.values())[: 2 if quick else None]):
        capture = load_capture(path, QUICK_CAPTURE_FRAMES if quick else CAPTURE_FRAMES, view)
        found = track_lengths(capture, (seed, number))
        recordings.append(Recording(1e3 * (found.lengths - true_lengths(capture))[None], 1e3 * found.std[None]))
    return Claims("articulated", "dfki", tuple(f"{finger}_mm" for finger in FINGERS), recordings)


def articulated_points_claims(
    quick: bool, seed: int, *, data: str, hands: str, network: int = 0, known_size: bool = False
) -> Claims:
    """Joints of hands whose keypoints a network detected; one recording a joint, as in `keypoint_claims`.

    Constants were chosen on the frames that are left out, the first `CHOSEN_FRAMES`.
    """
    del seed
    chosen = _real_motion.SETS[hands]
    frames = CHOSEN_FRAMES + QUICK_KEYPOINT_FRAMES if quick else None
    folder = recording_folder("handpose_tracks").parent
    detections = _real_motion.load(folder, chosen, chosen.networks[network], frames)
    errors, std = _real_motion.claimed(chosen, detections, known_size=known_size)
    joints = [i for i in range(errors.shape[1]) if i != chosen.root]
    recordings = [Recording(errors[CHOSEN_FRAMES:, i], std[CHOSEN_FRAMES:, i]) for i in joints]
    return Claims(
        "articulated", data, ("x_mm", "y_mm", "z_mm", *(f"from_palm_{axis}_mm" for axis in "xyz")), recordings
    )


def people_claims(quick: bool, seed: int) -> Claims:
    """People on PETS 2009, along and across the line of sight; one recording a person."""
    del seed
    pets = load_pets(recording_folder("pets09_s2l1_view001"), PeopleConfig())
    followed = people_pets.follow_video(pets, QUICK_PEOPLE_FRAMES if quick else None)
    truth = people_pets.read_truth(pets.folder / "gt_0_399.csv", pets)
    last = len(followed.tracking_s) - 1
    truth = FloorTracks(*(rows[truth.frame <= last] for rows in truth))
    if not len(truth.frame):
        raise RecordingError(f"the annotations begin after frame {last}, the last one that was tracked.")
    return Claims(
        "people",
        "pets",
        ("radial_m", "lateral_m"),
        by_person(truth, followed.tracks, np.asarray(pets.camera.position())),
    )


def by_person(truth: FloorTracks, tracks: dict[int, list[Sighting]], camera_m: np.ndarray) -> list[Recording]:
    """Errors along and across the line of sight of every person who is matched, with their covariances."""
    sightings = {(one.frame, identity): one for identity, track in tracks.items() for one in track}
    keys = list(sightings)
    places = np.array([sightings[key].mean[:2] for key in keys], float).reshape(-1, 2)
    found = floor_tracks([frame for frame, _ in keys], [identity for _, identity in keys], places)
    pairs = match(truth, found)
    rows: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for i, j in zip(pairs.truth, pairs.estimate, strict=True):
        sighting = sightings[int(found.frame[j]), int(found.identity[j])]
        away = truth.xy_m[i] - np.asarray(camera_m, float)[:2]
        away = away / np.linalg.norm(away)
        axes = np.array([away, (-away[1], away[0])])
        error = axes @ (found.xy_m[j] - truth.xy_m[i])
        covariance = axes @ np.asarray(sighting.covariance, float)[:2, :2] @ axes.T
        rows.setdefault(int(truth.identity[i]), []).append((error, covariance))
    recordings = []
    for of_person in rows.values():
        errors, covariances = (np.array(part) for part in zip(*of_person, strict=True))
        deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        recordings.append(Recording(errors, deviations, covariances))
    return recordings


def keypoint_claims(model: str, quick: bool, seed: int) -> Claims:
    """Key points that a network detected, filtered with one model of their errors; one recording a joint.

    The joints are of one video, so that intervals over them are too short.
    """
    del seed
    points = _keypoint_filters.load_keypoints(recording_folder("handpose_tracks"))
    half = len(points.truth) // 2
    end = half + QUICK_KEYPOINT_FRAMES if quick else None
    constants = _keypoint_filters.constants_of(Keypoints(points.detected[:half], points.truth[:half]))
    evaluated = slice(half, end)
    found = _keypoint_filters.filtered(
        _keypoint_filters.filters_of(constants)[model], jnp.asarray(points.detected[evaluated], jnp.float32)
    )
    mean, std = (np.asarray(values, float)[SETTLED:] for values in found)
    errors = mean - points.truth[evaluated][SETTLED:]
    joints = range(0, errors.shape[1], 2)
    recordings = [Recording(errors[:, i : i + 2], std[:, i : i + 2]) for i in joints]
    return Claims(f"keypoints_{model}", "nyu", ("x_mm", "y_mm"), recordings)


def _heads(quick: bool, seed: int) -> range:
    return range(FIRST_HEAD + seed, FIRST_HEAD + seed + (QUICK_NUM_HEADS if quick else NUM_HEADS))


def _of_head(run: HeadRun) -> Recording:
    # The tracker's own status: frames in which it is wrong without noticing, which only the truth shows, have to count.
    return _where(np.isin(run.track.status, TRACKED), run.errors, run.deviations)


def _of_mono(run: MonoRun) -> Recording:
    return _where(run.is_tracked, run.errors, np.asarray(run.track.pose_std, float) * DISPLAY)


def _where(is_tracked: np.ndarray, errors: np.ndarray, deviations: np.ndarray) -> Recording:
    return Recording(np.where(is_tracked[:, None], errors, np.nan), np.asarray(deviations, float))


SYSTEMS: dict[str, Callable[[bool, int], Claims]] = {
    "hand from depth, real motions": hand_claims,
    "articulated hand, motion capture": articulated_claims,
    **{
        f"articulated hand, {data}": partial(articulated_points_claims, data=data, **chosen)
        for data, chosen in DETECTED_HANDS.items()
    },
    "people, PETS 2009": people_claims,
    "head before two cameras, rendered": stereo_claims,
    "head before one camera, rendered": mono_claims,
    "head before two cameras, people of the ICT model": stereo_people_claims,
    "head before one camera, people of the ICT model": mono_people_claims,
    **_tip_claims.SYSTEMS,
    **{f"key points as {model} noise, NYU": partial(keypoint_claims, model) for model in MODELS},
}
"""One function `(quick, seed) -> Claims` for each system and kind of data."""
