"""The picture of the README from the results of `jaxfilters track head-stereo --out DIR`: python docs/head.py DIR."""

import sys
from pathlib import Path

import cv2
import numpy as np

FRAMES = (90, 300, 400)
FACE = (slice(96, 456), slice(150, 510))
"""Rows and columns of one camera's image."""
MODES = (slice(800, 1044), slice(0, 720))
"""Rows and columns of the first three of five modes in `summary.png`, 240 columns each."""


def main(results: Path, picture: Path) -> None:
    """Three frames of the first camera above the estimated modes."""
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    frames = []
    while len(frames) <= max(FRAMES):
        there, image = video.read()
        if not there:
            raise SystemExit(f"{results / 'overlay.mp4'}: fewer than {max(FRAMES) + 1} frames")
        frames.append(image)
    above = np.hstack([frames[i][FACE] for i in FRAMES])
    below = cv2.imread(str(results / "summary.png"))[MODES]
    width = above.shape[1]
    below = cv2.resize(below, (width, round(len(below) * width / below.shape[1])), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(picture), np.vstack([above, below]), [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).with_suffix(".png"))
