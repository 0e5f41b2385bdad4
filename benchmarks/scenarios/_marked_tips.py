"""Fingertips of real videos beside positions marked by hand, in 20 frames of each: found, false, and their names.

`marked_fingertips.json` holds the frames in the middle of 20 equal parts of a video, and in each, by name, the middle
of every fingertip whose end a person sees; fingers folded onto the palm, or whose end another finger hides, are left
out. What the border of the image cuts is marked apart, and is neither missed nor false. A tip is found if a fingertip
of the tracker is nearer than half the width of a finger; what is near no mark is false. The simplest thing that finds
fingertips in one image is counted beside the tracker: a threshold in colour and the gaps of the convex hull.
"""

import json
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from jaxfilters.benchmarks.recordings import RecordingError
from jaxfilters.benchmarks.scenarios._simplest import hand_by_colour, tips_by_hull
from jaxfilters.trackers.fingertips.images import OPEN_HAND_IMAGES, track
from jaxfilters.trackers.fingertips.state import HandReport

NAMES = ("thumb", "index", "middle", "ring", "little")
"""By the numbers that the tracker gives."""
VIDEOS = ("desk_hand_video", "dexretarget_hand_video")


class Tips(NamedTuple):
    """Fingertips that the tracker reports in a frame."""

    position: np.ndarray
    """(tips, 2) pixels."""
    identity: np.ndarray
    """(tips,) names."""


class Count(NamedTuple):
    """Of all marked frames of a video."""

    marked: int
    found: int
    reported: int
    false: int
    names: dict[str, set[int]]
    """That each finger had where it was found."""

    @property
    def metrics(self) -> dict[str, float]:
        """Percentages, and the largest number of names of a finger."""
        return {
            "found_pct": 100 * self.found / max(self.marked, 1),
            "false_pct": 100 * self.false / max(self.reported, 1),
            "names_per_finger": float(max((len(names) for names in self.names.values()), default=0)),
        }


def marks(name: str) -> dict[str, Any]:
    """The marked frames of a video, its file, and half the width of a finger in it."""
    text = (files("jaxfilters.benchmarks") / "scenarios" / "marked_fingertips.json").read_text(encoding="utf-8")
    return json.loads(text)[name]


def marked_counts(name: str, folder: Path) -> dict[str, Count]:
    """Of the tracker with `--mask colour` on the whole video, and `_simple`, of every marked frame by itself.

    Raises:
        RecordingError: if the video cannot be read.
    """
    marked = marks(name)
    return counts(images_of(folder / marked["file"]), marked)


def counts(images: list[np.ndarray], marked: dict[str, Any]) -> dict[str, Count]:
    """The same of a video's images (rows, cols, 3) uint8, 30 a second, and what `marks` gives of it."""
    report, _ = track(images, np.arange(len(images)) / 30, "colour")
    frames = [int(i) for i in marked["frames"]]
    hulls = {i: tips_by_hull(hand_by_colour(images[i])) for i in frames}
    simple = {i: Tips(tips, np.zeros(len(tips), int)) for i, tips in hulls.items()}
    return {"": counted(marked, {i: tips_of(report, i) for i in frames}), "_simple": counted(marked, simple)}


def tips_of(report: HandReport, frame: int) -> Tips:
    """What is reported of the first hand."""
    there = report.is_tip[frame, 0]
    return Tips(np.asarray(report.position[frame, 0][there]), np.asarray(report.identity[frame, 0][there]))


def counted(marked: dict[str, Any], frames: dict[int, Tips]) -> Count:
    """Reported tips, by frame, beside the marks of a video."""
    num_marked = num_found = reported = false = 0
    names: dict[str, set[int]] = {name: set() for name in NAMES}
    for i, own in marked["frames"].items():
        tips = frames[int(i)]
        pairs = pairs_of(own, tips, float(marked["half_width_px"]))
        num_marked += len(own["tips"])
        num_found += sum(name in own["tips"] for name in pairs)
        reported += len(tips.position)
        false += len(tips.position) - len(pairs)
        for name, tip in pairs.items():
            names[name].add(int(tips.identity[tip]))
    return Count(num_marked, num_found, reported, false, names)


def pairs_of(own: dict[str, Any], tips: Tips, most: float) -> dict[str, int]:
    """The tip of each marked or cut finger that has one within `most` pixels, by the least sum of distances."""
    fingers = own["tips"] | own["cut"]
    if not fingers or not len(tips.position):
        return {}
    pairs = pairs_within(np.array(list(fingers.values()), float), tips.position, most)
    return {list(fingers)[finger]: tip for finger, tip in pairs}


def pairs_within(fingers: np.ndarray, tips: np.ndarray, most: float) -> list[tuple[int, int]]:
    """Pairs of (m, 2) and (n, 2) places that are nearer than `most`, by the least sum of distances."""
    apart = np.linalg.norm(fingers[:, None] - tips, axis=-1)
    # As many pairs as possible, whatever is beyond the gate.
    rows, columns = linear_sum_assignment(np.where(apart < most, apart, 1e3 * most))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if apart[i, j] < most]


def images_of(path: Path) -> list[np.ndarray]:
    """All images (rows, cols, 3) uint8 of a video.

    Raises:
        RecordingError: if it cannot be read, or is too short to show an open hand.
    """
    video, images = cv2.VideoCapture(str(path)), list[np.ndarray]()
    while True:
        ok, image = video.read()
        if not ok:
            break
        images.append(image)
    if len(images) < OPEN_HAND_IMAGES:
        raise RecordingError(f"{path} cannot be read, or has fewer than {OPEN_HAND_IMAGES} frames.")
    return images
