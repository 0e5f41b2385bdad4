"""Real hands from one view: detections of networks on two sets of depth images, and motion capture through a camera.

Only (u, v) of a network is used. The noise is what the tracker takes for keypoints, motion and the hand at ease are its
own. Constants of the tracker were chosen on the first 350 frames of these recordings, which are part of the figures;
the meaning of the markers is from all of them. `docs/accuracy/articulated.md` lists what.

`backprojection` puts every detection at the true depth of the root, frame by frame: it is given where the hand is, and
with that how large it is, which no other variant knows. `backprojection_estimated_depth` is the same at the depth that
an average hand of the same extent would have. `recommended_known_size` is the tracker with the width of the palm.

What limits it: a hand of 90 pixels that faces the camera (ICVL) is flatter, 22 mm in depth, than its foreshortening can
be read from detections that are 4 pixels off; there the plane at the depth of the root is hard to beat. Even of
exact points the most likely pose of such a hand is tilted by 17 degrees where all rotations are alike, since the joint
density of pose and angles is higher, though narrower, where fingers point to the camera; hence `motion.LEAN_STD`.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios._exact_tilt import tilt_metrics
from jaxfilters.benchmarks.scenarios._real_markers import MarkedHand, Marker, marked_hand
from jaxfilters.benchmarks.scenarios._real_mocap import mocap_metrics
from jaxfilters.gaussian.gaussian_sum import map_component
from jaxfilters.models.articulated.anatomy import five_finger_limits, motion_about_ease
from jaxfilters.models.articulated.filters import Inequalities, belief_of, inequalities, standard_deviations
from jaxfilters.models.articulated.hand import articulated_hand
from jaxfilters.models.articulated.layout import five_fingers
from jaxfilters.models.articulated.limits import limit_rows
from jaxfilters.models.articulated.projection import Perspective
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.articulated.config import ArticulatedConfig
from jaxfilters.trackers.articulated.recording import NOISE_SHARE, FeatureFrame, keypoint_noise, persistence
from jaxfilters.trackers.articulated.start import starts_from_points
from jaxfilters.trackers.articulated.state import TRACKING, TrackState
from jaxfilters.trackers.articulated.tracker import HAND_DIAGONAL, tracker_of
from jaxfilters.trackers.tracker import Tracker

QUICK_FRAMES = 240
VARIANTS = (
    "backprojection",
    "backprojection_estimated_depth",
    "limits_only",
    "filter_only",
    "recommended_known_size",
    "recommended",
)


def _on_palm(name: str, along: float, across: float) -> Marker:
    return Marker(name, palm=(along, 0.0, across))


def _on_finger(name: str, finger: int, along: float) -> Marker:
    return Marker(name, finger=finger, along=along)


NYU_MARKERS = (
    *(
        _on_finger(f"{name}_{part}", finger, along)
        for finger, name in ((4, "pinky"), (3, "ring"), (2, "middle"), (1, "index"))
        for part, along in (("tip", 3.0), ("pip", 1.0))
    ),
    *(_on_finger(f"thumb_{part}", 0, along) for part, along in (("tip", 3.0), ("ip", 2.0), ("mcp", 1.0))),
    _on_palm("wrist_2", 0.0, -0.2),
    _on_palm("wrist_1", 0.0, 0.2),
    _on_palm("palm", 0.75, 0.0),
)
"""The 14 joints of NYU: its R are the middle joints (to the tip 43 to 57 mm, nearly constant)."""
ICVL_MARKERS = (
    _on_palm("palm", 0.6, 0.0),
    *(_on_finger(f"{finger}_{link}", finger, link + 0.5) for finger in range(5) for link in range(3)),
)
"""The 16 joints of ICVL: centres of links, not joints, as the ratios of their true distances say; they are 0.88 of the
average hand's. The place of the palm's point is from the truth, too."""


class HandSet(NamedTuple):
    """What a recording of detections is."""

    file: str
    networks: tuple[str, ...]
    """The first gives the metrics without a suffix."""
    markers: tuple[Marker, ...]
    side: float
    """+1 for a right hand, -1 for a left one."""
    root: int
    image_shape: tuple[int, int]
    palm_width: float
    """Metres, of the average hand whose size fits the true points best: what a ruler would have measured."""
    rate: float
    """Frames/s; of ICVL, whose frames are thinned, the one of 5, 7.5, 10, 15 and 30 at which the first 350 detections
    have the largest evidence for the tracker."""


SETS = {
    "nyu": HandSet(
        "nyu_person1.npz",
        ("ICCV15_NYU_Feedback", "CVPR18_NYU_V2V_PoseNet"),
        NYU_MARKERS,
        1.0,
        13,
        (480, 640),
        0.093,
        30.0,
    ),
    "icvl": HandSet("icvl_seq1.npz", ("CVPR18_ICVL_V2V_PoseNet",), ICVL_MARKERS, -1.0, 0, (240, 320), 0.068, 10.0),
}


class Detections(NamedTuple):
    """A recording in the camera frame x right, y down, z away."""

    camera: Pinhole
    pixels: np.ndarray
    """(frames, markers, 2) of a network."""
    truth: np.ndarray
    """(frames, markers, 3) millimetres."""
    noise: float
    """Pixels, in one frame; from the detections alone."""


class Lifted(NamedTuple):
    """3-D markers of one variant."""

    points: np.ndarray
    """(frames, markers, 3) millimetres."""
    seconds: float
    tracked: float
    """Share of the frames."""
    hypotheses: float = 1.0
    """Mean number after a frame."""


def real_motion_metrics(data_dir: Path, quick: bool) -> dict[str, Metric]:
    """Errors on whichever of the recordings lie in `data_dir`, and those of the palm where keypoints are exact.

    `quick` takes the first frames of the recordings and one network.
    """
    metrics = tilt_metrics(quick)
    for name, chosen in SETS.items():
        if (data_dir / "handpose_tracks" / chosen.file).exists():
            for network in chosen.networks[: 1 if quick else None]:
                suffix = "" if network == chosen.networks[0] else f"_{network.split('_', 2)[2].lower()}"
                detections = load(data_dir, chosen, network, QUICK_FRAMES if quick else None)
                metrics |= lifting_metrics(name, suffix, chosen, detections)
    if (data_dir / "dfki_hand_mocap" / "recording.npz").exists():
        metrics |= mocap_metrics(data_dir / "dfki_hand_mocap" / "recording.npz", quick)
    return metrics


def load(data_dir: Path, chosen: HandSet, network: str, frames: int | None) -> Detections:
    """The first frames of one network's detections; all without a number."""
    data = np.load(data_dir / "handpose_tracks" / chosen.file)
    K, truth = np.abs(data["K"]), np.asarray(data["gt_uvd"][:frames], float)
    camera = Pinhole.from_matrix(K, chosen.image_shape)
    pixels = np.asarray(data[network][:frames, :, :2], float)
    return Detections(camera, pixels, back_projected(camera, truth), keypoint_noise(pixels))


def back_projected(camera: Pinhole, uvd: np.ndarray) -> np.ndarray:
    """Points (..., 3) in the unit of the depth, from pixels and depth."""
    ray = (uvd[..., :2] - np.asarray(camera.center)) / np.asarray(camera.focal)
    return np.concatenate([ray, np.ones_like(ray[..., :1])], axis=-1) * uvd[..., 2:]


def hand_of(chosen: HandSet, detections: Detections) -> tuple[MarkedHand, Inequalities]:
    """The average hand before the camera, and its limits."""
    layout = five_fingers(3, chosen.side)
    projection, motion = Perspective(detections.camera), motion_about_ease(layout)
    hand = articulated_hand(layout, projection=projection, motion=motion, point_std=detections.noise)
    marked = marked_hand(hand, chosen.markers)
    return marked, inequalities(limit_rows(layout, five_finger_limits(layout)))


def onto_root_plane(chosen: HandSet, detections: Detections) -> Lifted:
    """Every detection at the true depth of the root: what one view says with a known distance, and no more."""
    return _onto_planes(detections, detections.truth[:, chosen.root, 2])


def onto_estimated_plane(chosen: HandSet, detections: Detections) -> Lifted:
    """Every detection at the depth at which an average hand would have the median extent of the detections."""
    del chosen
    diagonal = keypoint_noise(detections.pixels) / NOISE_SHARE
    depth = 1e3 * HAND_DIAGONAL * float(np.mean(np.asarray(detections.camera.focal))) / diagonal
    return _onto_planes(detections, np.full(len(detections.pixels), depth))


def _onto_planes(detections: Detections, depths: np.ndarray) -> Lifted:
    """Every detection at one depth (frames,) a frame, millimetres."""
    depth = np.broadcast_to(depths[:, None, None], (*detections.pixels.shape[:2], 1))
    return Lifted(back_projected(detections.camera, np.concatenate([detections.pixels, depth], axis=-1)), 0.0, 1.0)


def frame_by_frame(chosen: HandSet, detections: Detections) -> Lifted:
    """The most likely pose of an average hand within the limits, each frame alone."""
    hand, limits = hand_of(chosen, detections)
    frames = _frames(detections)

    @jax.jit
    def lift(frames: FeatureFrame) -> jax.Array:
        def one(frame: FeatureFrame) -> jax.Array:
            return hand.marker_points(starts_from_points(hand, limits.constraints, *frame).means[0])

        return jax.lax.map(one, frames)

    start = time.perf_counter()
    points = 1e3 * np.asarray(lift(frames))
    return Lifted(points, time.perf_counter() - start, 1.0)


def filtered(variant: str, *, known_size: bool = False) -> Callable[[HandSet, Detections], Lifted]:
    """The tracker in one of its variants, started by itself, and given the width of the palm if asked for."""

    def lift(chosen: HandSet, detections: Detections) -> Lifted:
        hand, tracker, frames, times = _tracked(chosen, detections, variant, known_size)
        state = tracker.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], frames))
        jax.block_until_ready(tracker.step(state, frames, times))
        start = time.perf_counter()
        _, track = jax.block_until_ready(tracker.step(state, frames, times))
        seconds = time.perf_counter() - start
        points = 1e3 * np.asarray(jax.lax.map(hand.marker_points, jnp.asarray(track.mean)))
        tracked = np.asarray(track.status) == TRACKING
        return Lifted(points, seconds, float(np.mean(tracked)), float(np.mean(np.asarray(track.num_hypotheses))))

    return lift


def claimed(chosen: HandSet, detections: Detections, *, known_size: bool) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the tracker and the standard deviations that it claims, millimetres, both (frames, markers, 6).

    The coordinates are those in the camera frame, then those from the root.
    """
    hand, tracker, frames, times = _tracked(chosen, detections, "recommended", known_size)
    from_root = lambda points: points - points[chosen.root]

    def step(state: TrackState, inputs: tuple[FeatureFrame, jax.Array]) -> tuple[TrackState, jax.Array]:
        state, _ = tracker.step(state, *jax.tree.map(lambda leaf: leaf[None], inputs))
        belief = belief_of(map_component(state.bank))
        points = hand.marker_points(belief.mean)
        std = standard_deviations(hand.marker_points, belief)
        relative_std = standard_deviations(lambda x: from_root(hand.marker_points(x)), belief)
        estimate = jnp.concatenate([points, from_root(points)], axis=1)
        return state, jnp.stack([estimate, jnp.concatenate([std, relative_std], axis=1)])

    state = tracker.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], frames))
    _, found = jax.jit(lambda *inputs: jax.lax.scan(step, state, inputs))(frames, jnp.asarray(times, dtype=float))
    truth = detections.truth
    truth = np.concatenate([truth, truth - truth[:, chosen.root, None]], axis=2)
    estimate, std = np.moveaxis(1e3 * np.asarray(found, float), 1, 0)
    return estimate - truth, std


def _tracked(
    chosen: HandSet, detections: Detections, variant: str, known_size: bool
) -> tuple[MarkedHand, Tracker, FeatureFrame, np.ndarray]:
    """The hand, its tracker, and the frames with their times."""
    times = np.arange(len(detections.pixels)) / chosen.rate
    hand, limits = hand_of(chosen, detections)
    # What is a new view follows from the noise in one frame; the filter takes errors that last for larger ones.
    frames = _frames(detections._replace(noise=persistence(times) * detections.noise))
    config = ArticulatedConfig(
        variant=variant,
        focal=float(np.mean(np.asarray(detections.camera.focal))),
        palm_width=chosen.palm_width if known_size else None,
    )
    return hand, tracker_of(hand, limits, None, config), frames, times


def lifting_metrics(name: str, suffix: str, chosen: HandSet, detections: Detections) -> dict[str, Metric]:
    """Errors of all variants on one network, and by how much the last is better than both back-projections."""
    ways = (
        onto_root_plane,
        onto_estimated_plane,
        frame_by_frame,
        filtered("unconstrained"),
        filtered("recommended", known_size=True),
        filtered("recommended"),
    )
    metrics, plain = {}, {}
    for variant, way in zip(VARIANTS, ways, strict=True):
        lifted = way(chosen, detections)
        plain[variant], scaled = root_relative_errors(lifted.points, detections.truth, chosen.root)
        metrics[f"{name}_root_relative_mm_{variant}{suffix}"] = Metric(plain[variant], "mm", "lower")
        metrics[f"{name}_scaled_root_relative_mm_{variant}{suffix}"] = Metric(scaled, "mm", "lower")
    reduction = 100 * (1 - plain["recommended"] / plain["backprojection"])
    metrics[f"{name}_reduction_percent{suffix}"] = Metric(reduction, "%", "higher")
    unaided = 100 * (1 - plain["recommended"] / plain["backprojection_estimated_depth"])
    metrics[f"{name}_reduction_estimated_depth_percent{suffix}"] = Metric(unaided, "%", "higher")
    metrics[f"{name}_mean_hypotheses{suffix}"] = Metric(lifted.hypotheses, "", "higher")
    metrics[f"{name}_tracked_share{suffix}"] = Metric(lifted.tracked, "", "higher")
    metrics[f"{name}_frames_per_second{suffix}"] = Metric(len(lifted.points) / lifted.seconds, "frames/s", "higher")
    return metrics


def root_relative_errors(points: np.ndarray, truth: np.ndarray, root: int) -> tuple[float, float]:
    """Mean distance of markers from the true ones, both from the root: as they are, and with each frame scaled to fit.

    Args:
        points: (frames, markers, 3).
        truth: The same.
        root: Which marker both are taken from; it does not count.
    """
    others = np.arange(points.shape[1]) != root
    a, b = ((p - p[:, root : root + 1])[:, others] for p in (points, truth))
    scale = np.sum(a * b, axis=(1, 2)) / np.sum(a * a, axis=(1, 2))
    plain, scaled = (np.linalg.norm(s[:, None, None] * a - b, axis=-1).mean() for s in (np.ones_like(scale), scale))
    return float(plain), float(scaled)


def _frames(detections: Detections) -> FeatureFrame:
    y = detections.pixels.reshape(len(detections.pixels), -1).astype(np.float32)
    return FeatureFrame(y, np.isfinite(y), np.full(y.shape, detections.noise, np.float32))
