"""Features of an articulated hand over time: what was measured in each frame, how well, and the truth where known."""

import math
import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxfilters.models.articulated.features import BLOCKS, KEYPOINTS, FeatureSet
from jaxfilters.models.articulated.layout import Layout
from jaxfilters.models.articulated.motion import FRAME_INTERVAL, MOVEMENT_TIME
from jaxfilters.models.camera import Pinhole
from jaxfilters.trackers.io.content_hash import content_hash
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.recording import check_times

NUM_KEYPOINTS = 21
"""Of one hand: wrist, thumb 1-4, index, middle, ring, little finger, base to tip."""
LEAST_CONFIDENCE = 0.2
"""Keypoints below it count as not visible; it is what OpenPose draws hands from."""
NOISE_SHARE = 0.03
"""Noise of a keypoint's coordinate in one frame as a share of the hand's diagonal in the image, where nobody says
better. Detectors look at a crop around the hand, so that their error grows with it. Networks on ICVL and NYU err by
1.1 to 4.3 %. MediaPipe's is said to err by 13.4 % of the palm's size (F. Zhang et al., MediaPipe Hands: on-device
real-time hand tracking, 2020; which distances it takes is not said), which would be 4.7 % of the diagonal for a palm of
half of it. `persistence` then raises what is taken for one frame, since errors last."""

_LARGEST_SHARE = 2.0
"""Coordinates that all stay within it are shares of the image, some of them outside: no hand fits into two pixels."""
_PATTERNS = {
    "wrist": "wrist_[xy]",
    "bases": "p_([1-9][0-9]*)0_[xy]",
    "joints": "p_([1-9][0-9]*)[12]_[xy]",
    "tips": "p_([1-9][0-9]*)3_[xy]",
    "lines": "(?:alpha|rho)_([1-9][0-9]*)[123]",
    "palm": "palm_(?:alpha|rho_min|rho_max)",
}
"""Names of the rows of each block, with the number of the finger."""


class FeatureFrame(NamedTuple):
    """One frame, float32."""

    y: Any
    """(rows,) pixels and radians; 0 where nothing was measured."""
    mask: Any
    """(rows,) bool, False where nothing was measured."""
    std: Any
    """(rows,) standard deviations of the noise, pixels and radians, positive."""


class Start(NamedTuple):
    """What is believed before the first frame."""

    mean: Any
    """(n,), in the order of the layout."""
    covariance: Any
    """(n, n)."""


@dataclass(frozen=True)
class FeatureSequence:
    """A recording of features."""

    num_fingers: int
    features: FeatureSet
    """Which rows there are, and in which order."""
    times_s: np.ndarray
    """(frames,) float64 seconds, strictly increasing."""
    y: np.ndarray
    """(frames, rows) pixels and radians, NaN where nothing was measured."""
    std: np.ndarray
    """(frames, rows) standard deviations of the noise."""
    name: str
    """For messages and reports."""
    image_shape: tuple[int, int] | None = None
    """Rows and columns of the camera's image, where known."""
    start: Start | None = None
    truth: np.ndarray | None = None
    """True states (frames, n), where known; NaN in frames without."""
    noise_px: float | None = None
    """Standard deviation of a keypoint's coordinate in one frame at full confidence, pixels; `std` is larger by
    `persistence`. `None` for other features."""

    def __post_init__(self) -> None:
        check_times(self.times_s, self.name)
        expected = (len(self.times_s), self.features.size(self.num_fingers))
        for field in ("y", "std"):
            if getattr(self, field).shape != expected:
                raise InputError(f"{self.name}: {field} must be {expected}; got {getattr(self, field).shape}.")
        _check_measured(self)
        if self.start is not None:
            _check_start(self.start, self.num_fingers, self.name)
        states = (len(self), Layout(self.num_fingers).size)
        if self.truth is not None and self.truth.shape != states:
            raise InputError(
                f"{self.name}: truth must be {states} for {self.num_fingers} fingers; got {self.truth.shape}."
            )

    def __len__(self) -> int:
        return len(self.times_s)

    def __getitem__(self, index: int) -> FeatureFrame:
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}.")
        mask = np.isfinite(self.y[index])
        y = np.where(mask, self.y[index], 0.0).astype(np.float32)
        return FeatureFrame(y, mask, np.where(mask, self.std[index], 1.0).astype(np.float32))

    def fingerprint(self) -> str:
        """A hash of everything that an estimate rests on: equal for the same recording wherever it lies."""
        blocks = [block in self.features.blocks for block in BLOCKS]
        measured = (self.times_s, self.y, self.std)
        return content_hash(self.num_fingers, blocks, self.image_shape or (), *measured, *(self.start or ()))


def from_keypoints(
    times_s: np.ndarray,
    points: np.ndarray,
    name: str,
    *,
    confidence: np.ndarray | None = None,
    noise_px: float | None = None,
    image_shape: tuple[int, int] | None = None,
) -> FeatureSequence:
    """Keypoints of a hand with five fingers as features: rows wrist, bases, joints.

    A keypoint of confidence c is off by `noise_px / min(c, 1)` in each coordinate (standard deviation), and was not
    observed where c < `LEAST_CONFIDENCE` or one of its coordinates is NaN. The filter gets that times `persistence`.

    Args:
        times_s: (frames,) seconds.
        points: (frames, 21, 2) pixels, in the order of `NUM_KEYPOINTS`, NaN where nothing was observed.
        name: For messages and reports.
        confidence: (frames, 21), 0 or more; 1 for all unless given.
        noise_px: Standard deviation of a coordinate in one frame at full confidence; `keypoint_noise` unless given.
        image_shape: Rows and columns of the camera's image.

    Raises:
        InputError: wrong shapes, times, confidences or noise, or nothing was observed.
    """
    expected = (len(times_s), NUM_KEYPOINTS)
    if points.shape != (*expected, 2):
        raise InputError(f"{name}: keypoints must be ({expected[0]}, {NUM_KEYPOINTS}, 2); got {points.shape}.")
    if np.isinf(points).any():
        frame, keypoint, _ = np.argwhere(np.isinf(points))[0]
        raise InputError(f"{name}: keypoints must be finite or NaN; frame {frame}, keypoint {keypoint} is not.")
    confidence = np.ones(expected) if confidence is None else confidence
    if confidence.shape != expected:
        raise InputError(f"{name}: confidence must be {expected}; got {confidence.shape}.")
    if (wrong := ~(np.isfinite(confidence) & (confidence >= 0))).any():
        frame, keypoint = np.argwhere(wrong)[0]
        raise InputError(
            f"{name}: confidence must be 0 or more; frame {frame}, keypoint {keypoint}: {confidence[frame, keypoint]}."
        )
    observed = (confidence >= LEAST_CONFIDENCE) & ~np.isnan(points).any(axis=-1)
    if not observed.any():
        raise InputError(f"{name}: no keypoint has a confidence of {LEAST_CONFIDENCE} or more in any frame.")
    points = np.where(observed[..., None], points, np.nan)
    if looks_normalized(points):
        raise InputError(
            f"{name}: keypoints must be in pixels; got coordinates within {np.nanmin(points):.3g} and "
            f"{np.nanmax(points):.3g}, shares of the image's width and height: multiply by these."
        )
    noise_px = keypoint_noise(points) if noise_px is None else noise_px
    if not 0 < noise_px < np.inf:
        raise InputError(f"{name}: noise must be positive, in pixels; got {noise_px}.")
    check_times(times_s, name)
    std = np.where(observed, persistence(times_s) * noise_px / np.clip(confidence, LEAST_CONFIDENCE, 1.0), 1.0)
    return FeatureSequence(
        num_fingers=(NUM_KEYPOINTS - 1) // 4,
        features=KEYPOINTS,
        times_s=times_s,
        y=_keypoint_rows(points),
        std=_keypoint_rows(np.repeat(std[..., None], 2, axis=-1)),
        name=name,
        image_shape=image_shape,
        noise_px=noise_px,
    )


def looks_normalized(points: np.ndarray) -> bool:
    """Whether coordinates, NaN aside, can only be shares of the image's width and height."""
    observed = points[np.isfinite(points)]
    return bool(observed.size) and float(np.abs(observed).max()) <= _LARGEST_SHARE


def keypoint_noise(points: np.ndarray) -> float:
    """Pixels: `NOISE_SHARE` of the hand's diagonal, the median over the frames of points (frames, 21, 2), NaN missing.

    Frames in which fewer than half of the keypoints were observed count only where there are no others.
    """
    observed = np.isfinite(points).all(axis=-1)
    counts = observed.sum(axis=-1)
    whole = counts >= min(NUM_KEYPOINTS // 2, counts.max())
    low = np.where(observed[..., None], points, np.inf)[whole].min(axis=1)
    high = np.where(observed[..., None], points, -np.inf)[whole].max(axis=1)
    # A single keypoint has no extent; a pixel is better than certainty.
    return NOISE_SHARE * float(np.median(np.linalg.norm(high - low, axis=-1))) or 1.0


def persistence(times_s: np.ndarray) -> float:
    """By which a filter of white noise has to raise the noise of a detector that looks at times (frames,), seconds.

    A detector errs by what it sees: its errors last as long as a pose. A filter that forgets by exp(-t / M) takes a
    mean of errors with the correlation exp(-t / T). For frames dt apart, the variance of this mean is
    coth(dt (1 / T + 1 / M) / 2) times that of white errors. T and M are both `MOVEMENT_TIME`, in which errors and pose
    change; at 30 frames/s the standard deviation is raised by 3.2. The median of the steps counts.
    """
    if len(times_s) < 2:
        return 1.0
    step = float(np.median(np.diff(times_s))) / (FRAME_INTERVAL * MOVEMENT_TIME)
    return 1 / math.sqrt(math.tanh(step))


def features_named(names: list[str], recording: str) -> tuple[int, FeatureSet, list[int]]:
    """Number of fingers, feature set, and for each of its rows the place of its name in `names`.

    Raises:
        InputError: the names are not those of whole blocks of features for any number of fingers.
    """
    places = {name: place for place, name in enumerate(names)}
    if len(places) < len(names):
        raise InputError(f"{recording}: names must differ; {max(names, key=names.count)} is there more than once.")
    found = {name: _block_and_finger(name) for name in names}
    if unknown := [name for name, block in found.items() if block is None]:
        example = ", ".join(FeatureSet(("wrist", "joints", "lines")).names(1)[:3])
        raise InputError(
            f"{recording}: names that are no feature: {_some(unknown)}; expected those of whole blocks "
            f"({', '.join(BLOCKS)}), such as {example}."
        )
    blocks = {block for block, _ in filter(None, found.values())}
    if not blocks:
        raise InputError(f"{recording}: names are empty.")
    features = FeatureSet(tuple(blocks - {"tips"} if "joints" in blocks else blocks))
    # No more fingers than names, lest a number that is far off asks for as many rows.
    num_fingers = min(max(1, *(finger for _, finger in filter(None, found.values()))), len(names))
    expected = features.names(num_fingers)
    if missing := [name for name in expected if name not in places]:
        raise InputError(
            f"{recording}: names lack {_some(missing)}: blocks ({', '.join(BLOCKS)}) must be whole, with NaN where "
            "nothing was measured."
        )
    return num_fingers, features, [places[name] for name in expected]


def _check_measured(sequence: FeatureSequence) -> None:
    names = sequence.features.names(sequence.num_fingers)
    if np.isinf(sequence.y).any():
        frame, row = np.argwhere(np.isinf(sequence.y))[0]
        raise InputError(f"{sequence.name}: features must be finite or NaN; frame {frame}, {names[row]} is not.")
    observed = np.isfinite(sequence.y)
    if not observed.any():
        raise InputError(f"{sequence.name}: no feature was measured in any frame.")
    good = np.isfinite(sequence.std) & (sequence.std > 0)
    if not good[observed].all():
        frame, row = np.argwhere(observed & ~good)[0]
        raise InputError(
            f"{sequence.name}: noise must be positive where a feature was measured; frame {frame}, "
            f"{names[row]}: {sequence.std[frame, row]}."
        )


def _check_start(start: Start, num_fingers: int, name: str) -> None:
    layout = Layout(num_fingers)
    n = layout.size
    shapes = (start.mean.shape, start.covariance.shape)
    if shapes != ((n,), (n, n)):
        raise InputError(
            f"{name}: start must be a mean ({n},) and a covariance ({n}, {n}) for {num_fingers} fingers; "
            f"got {shapes[0]} and {shapes[1]}."
        )
    for part, value in (("mean", start.mean), ("covariance", start.covariance)):
        if not np.isfinite(value).all():
            raise InputError(f"{name}: start {part} must be finite.")
    if not np.linalg.norm(start.mean[layout.quaternion]) > 1e-6:
        raise InputError(f"{name}: the quaternion of the start mean must not be zero.")
    largest = max(float(np.abs(start.covariance).max()), 1e-30)
    if np.abs(start.covariance - start.covariance.T).max() > 1e-5 * largest:
        raise InputError(f"{name}: start covariance must be symmetric.")
    # A variance of zero is a belief; rounding to float32 leaves one slightly below it.
    if (smallest := float(np.linalg.eigvalsh(start.covariance.astype(float)).min())) < -1e-5 * largest:
        raise InputError(f"{name}: start covariance must have no negative eigenvalue; got {smallest:.3g}.")


def _keypoint_rows(values: np.ndarray) -> np.ndarray:
    """(frames, 21, 2) in the order of detectors to (frames, 42) in the order of `KEYPOINTS`."""
    frames = len(values)
    fingers = values[:, 1:].reshape(frames, -1, 4, 2)
    parts = (values[:, 0], fingers[:, :, 0], fingers[:, :, 1:])
    return np.concatenate([part.reshape(frames, -1) for part in parts], axis=1)


def _block_and_finger(name: str) -> tuple[str, int] | None:
    """The block that a row belongs to and the number of its finger, 0 without one; ends of fingers count as tips."""
    for block, pattern in _PATTERNS.items():
        if match := re.fullmatch(pattern, name):
            return block, int(match[1]) if match.lastindex else 0
    return None


def _some(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def camera_of(sequence: FeatureSequence, focal: float) -> Pinhole:
    """The camera in perspective with this focal length in pixels, and its axis in the middle of the image.

    Raises:
        ValueError: If the recording has no size of the image, or has a start or true states, which are in pixels.
    """
    if sequence.start is not None or sequence.truth is not None:
        raise ValueError(f"{sequence.name}: a start and true states are in pixels; they cannot be used with focal.")
    if sequence.image_shape is None:
        raise ValueError(f"{sequence.name}: focal needs the size of the image, whose middle is on the camera's axis.")
    rows, columns = sequence.image_shape
    return Pinhole.from_intrinsics(focal, (0.5 * (columns - 1), 0.5 * (rows - 1)), (rows, columns))
