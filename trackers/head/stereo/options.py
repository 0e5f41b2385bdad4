"""The options of `jaxfilters track head-stereo`, apart from what carries them out so that `--help` answers at once."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_number


def add_head(what: Any, seed: Callable[[str], int]) -> None:
    """Add the command to the parser's `what`; `seed` reads random seeds.

    Options of the tracker are None unless given, so that the defaults stand in one place, `HeadOptions`.
    """
    head: argparse.ArgumentParser = what.add_parser(
        "head-stereo", help="pose and deformation of one face, from two calibrated cameras or from one"
    )
    head.add_argument(
        "sources",
        nargs="*",
        metavar="VIDEO|CAMERA",
        help="LEFT and RIGHT: video files, folders of images or numbers of live cameras, in the order of the rig; one "
        "alone is followed with a rigid face; without any, a synthetic face",
    )
    head.add_argument(
        "--rig", type=Path, metavar="RIG.json", help="the cameras; `jaxfilters calibrate stereo` makes it"
    )
    head.add_argument(
        "--camera",
        type=Path,
        metavar="CAMERA.json",
        help="intrinsics of a single camera (default: a focal length of 1.2 image widths)",
    )
    head.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    head.add_argument(
        "--points",
        type=Path,
        metavar="FILE.csv",
        help="columns name,u,v: the ten landmarks in the first image of the first camera, pixels from the centre of "
        "the top left one (default: they are detected)",
    )
    head.add_argument(
        "--mode", choices=("modern", "paper"), help="improved filter (default: modern), or the one of the papers"
    )
    head.add_argument(
        "--detector",
        choices=("cascades", "mediapipe"),
        help="what finds the landmarks at the start: OpenCV's cascades (default) or MediaPipe's face mesh",
    )
    head.add_argument("--num-particles", type=int, metavar="N", help="number of particles (default: 1000)")
    head.add_argument("--seed", type=seed, metavar="SEED", help="random seed, also of the synthetic face")
    head.add_argument("--fps", type=positive_number, metavar="FPS", help="of the recordings, in place of what they say")
    head.add_argument("--seconds", type=positive_number, metavar="S", help="stop after so long, as with live cameras")
    head.add_argument("--no-video", action="store_false", dest="video", help="do not write overlay.mp4")
