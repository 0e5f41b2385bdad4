"""The picture of the README from the results of `jaxfilters track people --out DIR`: python docs/people.py DIR."""

import sys
from pathlib import Path

import cv2
import numpy as np

FRAMES = (40, 75, 110, 150)
HEIGHT = 480


def main(results: Path, picture: Path) -> None:
    """Four frames of the overlay beside the floor plan."""
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    frames = []
    while len(frames) <= max(FRAMES):
        there, image = video.read()
        if not there:
            raise SystemExit(f"{results / 'overlay.mp4'}: fewer than {max(FRAMES) + 1} frames")
        frames.append(image)
    a, b, c, d = (frames[i] for i in FRAMES)
    left = cv2.resize(
        np.vstack([np.hstack([a, b]), np.hstack([c, d])]), None, fx=2 / 3, fy=2 / 3, interpolation=cv2.INTER_AREA
    )
    plan = cv2.imread(str(results / "summary.png"))
    plan = cv2.resize(plan, (round(plan.shape[1] * HEIGHT / len(plan)), HEIGHT), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(picture), np.hstack([left, plan]), [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).with_suffix(".png"))
