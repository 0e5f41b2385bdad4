"""Short clips of the six trackers from the results of their synthetic recordings.

    for each in hand-depth articulated people head-stereo head-mono fingertips; do
        jaxfilters track $each --out runs/$each
    done
    python docs/clips.py runs

writes `docs/trackers/clips/*.webp`, each at most 300 kB.
"""

import sys
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

FRAMES = {
    "hand-depth": (20, 140, 3),
    "articulated": (0, 55, 1),
    "people": (30, 150, 3),
    "head-stereo": (60, 300, 6),
    "head-mono": (60, 300, 6),
    "fingertips": (90, 330, 6),
}
"""First frame, the one after the last, and every how many."""
WIDTH = {"head-stereo": 480}
QUALITIES = (70, 50, 35, 20)
LARGEST = 300_000
"""Bytes of a clip."""


def main(runs: Path, folder: Path) -> None:
    """Write all clips."""
    folder.mkdir(exist_ok=True)
    for name, (first, end, step) in FRAMES.items():
        video = runs / name / "overlay.mp4"
        frames = list(islice(_frames(video, WIDTH.get(name, 320)), first, end, step))
        if len(frames) < (end - first) // step:
            raise SystemExit(f"{video}: fewer than {end} frames")
        _write(folder / f"{name.replace('-', '_')}.webp", frames)


def _frames(video: Path, width: int):
    capture = cv2.VideoCapture(str(video))
    while True:
        there, image = capture.read()
        if not there:
            return
        height = round(len(image) * width / image.shape[1])
        yield cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _write(path: Path, frames: list[np.ndarray]) -> None:
    animation = cv2.Animation()
    # A lossy image with an alpha channel is what OpenCV writes animations of.
    animation.frames = [cv2.cvtColor(frame, cv2.COLOR_BGR2BGRA) for frame in frames]
    animation.durations = [100] * len(frames)
    for quality in QUALITIES:
        cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, quality])
        if path.stat().st_size <= LARGEST:
            return
    raise SystemExit(f"{path}: larger than {LARGEST} bytes at the lowest quality")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).parent / "trackers" / "clips")
