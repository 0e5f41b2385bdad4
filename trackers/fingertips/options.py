"""The options of `jaxfilters track fingertips`, apart from what carries them out so that `--help` answers at once."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_number


def add_fingertips(what: Any, seed: Callable[[str], int]) -> None:
    """Add the command to the parser's `what`; `seed` reads random seeds."""
    tips: argparse.ArgumentParser = what.add_parser(
        "fingertips", help="the fingertips of hands over a desk, from above; what they draw, and what they handle"
    )
    tips.add_argument(
        "video_source",
        nargs="?",
        metavar="VIDEO|CAMERA",
        help="video file, folder of images or number of a live camera, which show an open hand at some time early on; "
        "without it, a synthetic hand",
    )
    tips.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    tips.add_argument(
        "--mask",
        choices=("infrared", "depth", "colour"),
        default="infrared",
        help="how hands are told from the desk: they are the brightest (infrared, or a dark desk; default), they lie "
        "above it (depth: 16-bit PNGs with camera.json, or .npz), or they have the colour of skin",
    )
    tips.add_argument("--hands", type=int, choices=(1, 2), default=1, help="how many at most (default: %(default)s)")
    tips.add_argument(
        "--gestures",
        default="default",
        metavar="MODEL.npz",
        help="the symbols; `jaxfilters fit gestures` makes such a file (default: twelve shapes)",
    )
    tips.add_argument("--seed", type=seed, default=0, metavar="SEED", help="of the synthetic hand")
    tips.add_argument("--fps", type=positive_number, metavar="FPS", help="of the recording, in place of what it says")
    tips.add_argument("--seconds", type=positive_number, metavar="S", help="stop after so long, as with live cameras")
    tips.add_argument("--no-video", action="store_false", dest="video", help="do not write overlay.mp4")
