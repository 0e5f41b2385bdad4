"""Fingertips of the marked real videos, changed: turned, mirrored, backwards, in other light, noisy, of another size.

Needs the folders of `_marked_tips.VIDEOS` in JAXFILTERS_DATA. Every change applies to all images of a video and to its
marks, and the changed video is followed as by `jaxfilters track fingertips --mask colour`. `found_pct_<change>` and
`false_pct_<change>` are of the marks of both videos together, as `_marked_tips` counts them, and
`names_per_finger_<change>` is the largest number of names that a finger of either had where it was found. `found_pct`
and `false_pct` are means over the changes, `found_pct_least` and `false_pct_most` the extremes; `_simple` is a
threshold in colour and the gaps of the convex hull of each image. Nothing was chosen on changed videos.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.benchmarks.scenarios import _marked_tips as marked_tips
from jaxfilters.benchmarks.scenarios._marked_tips import Count

NOISE_SD = 8.0
"""Of every colour of every pixel, grey levels."""
QUICK_CHANGES, QUICK_FRAMES = 2, 60

Image = UInt8[np.ndarray, "rows cols 3"]


class Changed(NamedTuple):
    """A video whose images and marks are changed alike."""

    images: list[Image]
    marks: dict[str, Any]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Follow every changed video, print and return the shares."""
    del out
    originals = [_original(name, quick) for name in marked_tips.VIDEOS]
    ways: dict[str, list[dict[str, float]]] = {"": [], "_simple": []}
    metrics: dict[str, Metric] = {}
    for name, change in list(changes(seed).items())[: QUICK_CHANGES if quick else None]:
        counts = [marked_tips.counts(one.images, one.marks) for one in map(change, originals)]
        for way, of_all in ways.items():
            found = total([count[way] for count in counts]).metrics
            of_all.append(found)
            metrics |= _shares(found, f"_{name}{way}")
        metrics[f"names_per_finger_{name}"] = Metric(ways[""][-1]["names_per_finger"], "", "lower")
        sys.stderr.write(f"  {name}: {ways[''][-1]}\n")
    for way, of_all in ways.items():
        shares = {share: [one[share] for one in of_all] for share in ("found_pct", "false_pct")}
        metrics |= _shares({share: float(np.mean(values)) for share, values in shares.items()}, way)
        metrics[f"found_pct_least{way}"] = Metric(min(shares["found_pct"]), "%", "higher")
        metrics[f"false_pct_most{way}"] = Metric(max(shares["false_pct"]), "%", "lower")
    return metrics


def changes(seed: int) -> dict[str, Callable[[Changed], Changed]]:
    """Every change by its name.

    Args:
        seed: Of the noise.
    """

    def in_colour(factors: float | tuple[float, float, float]) -> Callable[[Changed], Changed]:
        return _each(lambda image: np.clip(image * np.asarray(factors), 0, 255).astype(np.uint8))

    rng = np.random.default_rng(seed)
    noisy = _each(lambda image: np.clip(image + rng.normal(0, NOISE_SD, image.shape), 0, 255).astype(np.uint8))
    return {
        "turned_20": lambda video: moved(video, lambda size: turned(size, 20.0)),
        "turned_90": lambda video: moved(video, lambda size: turned(size, 90.0)),
        "turned_180": lambda video: moved(video, lambda size: turned(size, 180.0)),
        "turned_270": lambda video: moved(video, lambda size: turned(size, 270.0)),
        "mirrored": lambda video: moved(video, mirrored),
        "backwards": backwards,
        "half_size": lambda video: moved(video, lambda size: scaled(size, 0.5)),
        "larger": lambda video: moved(video, lambda size: scaled(size, 1.5)),
        "dark": in_colour(0.55),
        "bright": in_colour(1.3),
        "warm": in_colour((0.85, 1.0, 1.12)),
        "cold": in_colour((1.15, 1.0, 0.88)),
        "noisy": noisy,
    }


class Motion(NamedTuple):
    """An affine map of pixels (u, v), and the size of the image that it leads to."""

    matrix: np.ndarray
    """(2, 3)."""
    size: tuple[int, int]
    """Columns and rows."""


def turned(size: tuple[int, int], degrees: float) -> Motion:
    """About the middle of the image; quarter turns exchange columns and rows, others keep what is in the image."""
    quarter = degrees % 180 == 90
    new = size[::-1] if quarter else size
    matrix = cv2.getRotationMatrix2D(((size[0] - 1) / 2, (size[1] - 1) / 2), degrees, 1.0)
    middle = (np.array(new) - np.array(size)) / 2
    return Motion(matrix + np.pad(middle[:, None], ((0, 0), (2, 0))), (new[0], new[1]))


def mirrored(size: tuple[int, int]) -> Motion:
    """With left and right exchanged."""
    return Motion(np.array([[-1.0, 0.0, size[0] - 1], [0.0, 1.0, 0.0]]), size)


def scaled(size: tuple[int, int], factor: float) -> Motion:
    """Of another resolution; the outer borders of pixels stay the borders of the image."""
    offset = (factor - 1) / 2
    return Motion(
        np.array([[factor, 0.0, offset], [0.0, factor, offset]]), (round(factor * size[0]), round(factor * size[1]))
    )


def moved(video: Changed, motion_of: Callable[[tuple[int, int]], Motion]) -> Changed:
    """A video whose images are mapped, with its marks; what comes into an image repeats its border."""
    rows, cols = video.images[0].shape[:2]
    matrix, size = motion_of((cols, rows))
    factor = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))

    def image(one: Image) -> UInt8[np.ndarray, "new_rows new_cols 3"]:
        if factor < 1:
            return cv2.resize(one, size, interpolation=cv2.INTER_AREA)
        return cv2.warpAffine(one, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def points(named: dict[str, Any]) -> dict[str, Any]:
        return {name: (matrix[:, :2] @ np.array(uv, float) + matrix[:, 2]).tolist() for name, uv in named.items()}

    frames = {i: {kind: points(of) for kind, of in one.items()} for i, one in video.marks["frames"].items()}
    width = factor * video.marks["half_width_px"]
    return Changed([image(one) for one in video.images], video.marks | {"frames": frames, "half_width_px": width})


def backwards(video: Changed) -> Changed:
    """The same images in the opposite order."""
    last = len(video.images) - 1
    frames = {str(last - int(i)): one for i, one in video.marks["frames"].items()}
    return Changed(video.images[::-1], video.marks | {"frames": frames})


def total(counts: list[Count]) -> Count:
    """Of several videos; a finger's number of names is the largest of one video."""
    names = {name: max((count.names[name] for count in counts), key=len) for name in counts[0].names}
    marked, found, reported, false = (sum(column) for column in zip(*(count[:4] for count in counts), strict=True))
    return Count(marked, found, reported, false, names)


def _each(change: Callable[[Image], Image]) -> Callable[[Changed], Changed]:
    return lambda video: video._replace(images=[change(image) for image in video.images])


def _original(name: str, quick: bool) -> Changed:
    marks = marked_tips.marks(name)
    images = marked_tips.images_of(recording_folder(name) / marks["file"])[: QUICK_FRAMES if quick else None]
    frames = {i: one for i, one in marks["frames"].items() if int(i) < len(images)}
    return Changed(images, marks | {"frames": frames})


def _shares(found: dict[str, float], suffix: str) -> dict[str, Metric]:
    return {
        f"found_pct{suffix}": Metric(found["found_pct"], "%", "higher"),
        f"false_pct{suffix}": Metric(found["false_pct"], "%", "lower"),
    }
