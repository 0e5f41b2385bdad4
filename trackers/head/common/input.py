"""What the head trackers watch: two cameras of a rig, one camera, or a synthetic face."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import lru_cache
from itertools import combinations, islice
from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import numpy as np

from jaxfilters.models.calibration import Calibration
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import CameraRig, monocular
from jaxfilters.models.synthetic.face_motion import FPS, MONOCULAR_PLACE_MM, motion, speech_schedule
from jaxfilters.models.synthetic.face_sequence import FaceSequence, face_sequence, sequence
from jaxfilters.trackers.head.common.focal_prior import focal_prior
from jaxfilters.trackers.head.common.quarter_turns import upright
from jaxfilters.trackers.head.common.report import HeadTruth
from jaxfilters.trackers.head.common.table import pose_in_metres
from jaxfilters.trackers.io.cameras import open_intrinsics
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.landmarks import read_landmarks
from jaxfilters.trackers.io.rigs import open_rig
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.io.video_input import LiveCamera, VideoSource, open_video

_SYNTHETIC_FRAMES, _MOTION = 600, "mix"
_COMPARED = 3
"""First images by which two recordings are recognised as the same."""
_SYNTHETIC_FOCAL = 800.0
"""Pixels, of the one camera before a synthetic face."""


class Setup(NamedTuple):
    """What is watched, and by what."""

    rig: CameraRig
    undistortions: list[Undistortion]
    sources: list[VideoSource]
    points: np.ndarray | None
    """(10, 2) landmarks, or (68, 2), in the first image of the first camera, without lens distortion; None where to be
    detected."""
    truth: HeadTruth | None
    """Of the synthetic face."""
    note: str | None
    """What was assumed, for a person."""
    focal_log_std: float = 0.0
    """Standard deviation of the logarithm of a single camera's focal length; 0 where it is calibrated."""


class Places(NamedTuple):
    """What describes the cameras of a recording, and what is given of it; None where it is not."""

    rig: Path | None = None
    """Of two cameras or more."""
    camera: Path | None = None
    """Intrinsics of one camera."""
    points: Path | None = None
    """Landmarks in the first image."""
    fps: float | None = None
    """Frames per second, in place of what the recording says."""

    def given(self) -> list[str]:
        """The options of those that are there."""
        return [f"--{name}" for name, value in self._asdict().items() if value is not None]


def setup_of(sources: Sequence[str], places: Places, seed: int) -> Setup:
    """The cameras and sources that the command line of `track head-stereo` names.

    Raises:
        InputError: a source or a file cannot be used, they do not fit each other, or one is missing.
    """
    if not sources:
        _refuse_unused(places)
        return _rendered(sequence(jax.random.key(seed), _MOTION, _SYNTHETIC_FRAMES, seed, deform=True))
    if len(sources) == 1:
        place = _single(sources[0], places)
        return place._replace(note="; ".join(["one camera: a rigid face of average size", *filter(None, [place.note])]))
    if places.camera:
        raise InputError("--camera: for one source alone; two cameras are described by --rig RIG.json.")
    if not places.rig:
        raise InputError("--rig: missing; `jaxfilters calibrate stereo` makes a RIG.json of two cameras.")
    described = open_rig(places.rig)
    if len(described.cameras) != len(sources):
        raise InputError(
            f"{places.rig}: {len(described.cameras)} cameras; got {len(sources)} sources, expected one each."
        )
    videos = [open_video(source, fps=places.fps) for source in sources]
    for video, camera in zip(videos, described.cameras, strict=True):
        _check_size(video, camera.image_size, f"{places.rig}: {camera.name}")
    _check_distinct(videos)
    points = _points(places.points, described.undistortions[0])
    return Setup(described.rig, described.undistortions, videos, points, None, None)


def setup_of_one(source: str | None, places: Places, seed: int) -> Setup:
    """The camera and source that the command line of `track head-mono` names.

    Raises:
        InputError: the source or a file cannot be used, or they do not fit each other.
    """
    if source is not None:
        return _single(source, places)
    _refuse_unused(places)
    camera = Pinhole.from_intrinsics(_SYNTHETIC_FOCAL, (319.5, 239.5), (480, 640))
    poses = motion(_MOTION, _SYNTHETIC_FRAMES, seed, place_mm=MONOCULAR_PLACE_MM)
    talking = speech_schedule(_SYNTHETIC_FRAMES)
    return _rendered(face_sequence(jax.random.key(seed), poses, rig=monocular(camera), expressions=talking))


def _single(name: str, places: Places) -> Setup:
    if places.rig:
        raise InputError(
            "--rig: for two sources or more; one alone is described by --camera CAMERA.json, or not at all."
        )
    source, note, log_std = open_video(name, fps=places.fps), None, 0.0
    if not places.camera and places.points is None:
        source, note = upright(source)
    cols, rows = source.image_size
    if places.camera:
        K, distortion, image_size = open_intrinsics(places.camera)
        _check_size(source, image_size, str(places.camera))
    else:
        focal, log_std, origin = focal_prior(name, (cols, rows))
        K, distortion = np.array([[focal, 0, (cols - 1) / 2], [0, focal, (rows - 1) / 2], [0, 0, 1]]), np.zeros(5)
        note = "; ".join([*filter(None, [note]), origin])
    undistortion = Undistortion((rows, cols), K, distortion)
    rig = monocular(Pinhole.from_matrix(K, (rows, cols)))
    return Setup(rig, [undistortion], [source], _points(places.points, undistortion), None, note, log_std)


def _refuse_unused(places: Places) -> None:
    if unused := places.given():
        raise InputError(f"{', '.join(unused)}: of no use without a recording; the synthetic face has its own.")


def _rendered(made: FaceSequence) -> Setup:
    image = _cached_images(made)
    sources: list[VideoSource] = [_SyntheticSource(made, camera, image) for camera in range(made.rig.num_cameras)]
    truth = HeadTruth(pose_in_metres(made.poses), made.uv)
    undistortions = [Undistortion(made.rig.shape) for _ in sources]
    return Setup(made.rig, undistortions, sources, np.asarray(made.uv[0, 0], float), truth, None)


class _SyntheticSource:
    """One camera of the synthetic face as a source of images."""

    def __init__(self, made: FaceSequence, camera: int, image):
        self.name, self.fps, self.frames = f"synthetic camera {camera}", FPS, len(made)
        rows, cols = made.rig.shape
        self.image_size = (cols, rows)
        self._made, self._camera, self._image = made, camera, image

    def sample(self, most: int) -> list[np.ndarray]:
        every = max(1, self.frames // most)
        return [self._image(i)[self._camera] for i in range(0, self.frames, every)][:most]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        for i, time_s in enumerate(self._made.times):
            yield float(time_s), self._image(i)[self._camera]

    def trouble(self) -> str | None:
        return None


def _cached_images(made: FaceSequence):
    """`index -> images` in colour of all cameras, which are rendered together and asked for one after the other."""

    @lru_cache(maxsize=4)
    def images(index: int) -> list[np.ndarray]:
        return [cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) for grey in np.asarray(made.frames(index, index + 1)[0])]

    return images


def _points(file: Path | None, undistortion: Undistortion) -> np.ndarray | None:
    if file is None:
        return None
    rows, cols = undistortion.shape
    pixels = read_landmarks(file, (cols, rows))
    if undistortion.K is None or undistortion.is_identity:
        return pixels
    return Calibration(undistortion.K, undistortion.distortion, np.eye(3), np.zeros(3), 0.0).undistort(pixels)


def _check_distinct(recordings: Sequence[VideoSource]) -> None:
    """Raise `InputError` where two cameras deliver the same images: both are at one place, which shows no depth."""
    beginnings = [_beginning(one) for one in recordings]
    for (i, one), (j, other) in combinations(enumerate(recordings), 2):
        is_same = one.name == other.name or (len(beginnings[i]) and np.array_equal(beginnings[i], beginnings[j]))
        if is_same:
            raise InputError(
                f"{one.name} and {other.name}: sources {i + 1} and {j + 1} have the same images, so that both cameras "
                "are at one place and show no depth; expected a recording of its own from each camera of the rig."
            )


def _beginning(recording: VideoSource) -> np.ndarray:
    """The first images (frames, rows, cols, 3); none of a live camera, nor where all are of one colour."""
    if isinstance(recording, LiveCamera):
        return np.zeros(0)
    with closing(recording.images()) as images:  # type: ignore[type-var]
        first = [image for _, image in islice(images, _COMPARED) if image is not None]
    return np.stack(first) if any(image.std() > 0 for image in first) else np.zeros(0)


def _check_size(source: VideoSource, size: tuple[int, int], described_by: str) -> None:
    if source.image_size != size:
        got, wanted = (f"{cols}x{rows}" for cols, rows in (source.image_size, size))
        raise InputError(f"{described_by}: calibrated for images of {wanted}; {source.name} has {got}.")
