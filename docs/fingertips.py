"""The README's picture from the results of `jaxfilters track fingertips --out DIR`: python docs/fingertips.py DIR."""

import sys
from pathlib import Path

import cv2
import numpy as np

FRAMES = (126, 208, 404, 560)
ROWS = slice(0, 400)
WIDTH = 720
"""Of the picture, pixels."""


def main(results: Path, picture: Path) -> None:
    """A square, a circle and a triangle nearly drawn, and something turned between thumb and forefinger."""
    video = cv2.VideoCapture(str(results / "overlay.mp4"))
    frames = []
    while len(frames) <= max(FRAMES):
        there, image = video.read()
        if not there:
            raise SystemExit(f"{results / 'overlay.mp4'}: fewer than {max(FRAMES) + 1} frames")
        frames.append(image)
    first, second, third, fourth = (frames[i][ROWS] for i in FRAMES)
    whole = np.vstack([np.hstack([first, second]), np.hstack([third, fourth])])
    small = cv2.resize(whole, (WIDTH, round(len(whole) * WIDTH / whole.shape[1])), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(picture), small, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).with_suffix(".png"))
