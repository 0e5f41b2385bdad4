"""The options of `jaxfilters track head-stereo`, apart from what carries them out so that `--help` answers at once."""

import argparse
from pathlib import Path

from jaxfilters.trackers.app.options import add_config, add_results_options, add_resume, add_seed, add_video_options
from jaxfilters.trackers.head.common.config import HeadConfig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    parser.add_argument(
        "sources",
        nargs="*",
        metavar="VIDEO|CAMERA",
        help="LEFT and RIGHT: video files, folders of images or numbers of live cameras, in the order of the rig; one "
        "alone is followed with a rigid face; without any, a synthetic face",
    )
    parser.add_argument(
        "--rig", type=Path, metavar="RIG.json", help="the cameras; `jaxfilters calibrate stereo` makes it"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="CAMERA.json",
        help="intrinsics of a single camera (default: the focal length in the file's metadata, or a usual one)",
    )
    parser.add_argument(
        "--points",
        type=Path,
        metavar="FILE.csv",
        help="columns name,u,v: the ten landmarks in the first image of the first camera, pixels from the centre of "
        "the top left one (default: they are detected)",
    )
    add_config(parser, HeadConfig, "variant", "detector", "num_particles")
    add_seed(parser)
    add_video_options(parser)
    add_resume(parser)
    add_results_options(parser)
