"""The options of `jaxfilters track fingertips`, apart from what carries them out so that `--help` answers at once."""

import argparse
from pathlib import Path

from jaxfilters.trackers.app.argument_types import image_size
from jaxfilters.trackers.app.options import (
    add_config,
    add_results_options,
    add_resume,
    add_seed,
    add_variant,
    add_video_options,
)
from jaxfilters.trackers.fingertips.config import RunConfig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    parser.add_argument(
        "video_source",
        nargs="?",
        metavar="VIDEO|CAMERA",
        help="video file, folder of images or number of a live camera, which show an open hand at some time early on; "
        "without it, a synthetic hand",
    )
    add_config(parser, RunConfig, "mask", "hands")
    parser.add_argument(
        "--depth",
        type=Path,
        metavar="RECORDING",
        help="depth images aligned to those of VIDEO, one for each, whose edges part fingers that touch: folder of "
        "16-bit PNGs with camera.json, or .npz; with --mask depth, VIDEO has them itself",
    )
    parser.add_argument(
        "--keypoints",
        type=Path,
        metavar="FILE",
        help="of a detector in place of images: folder of OpenPose's *_keypoints.json, or .json or .csv of MediaPipe's "
        "hand landmarks; VIDEO is then what they are drawn on",
    )
    parser.add_argument(
        "--image-size",
        type=image_size,
        metavar="WIDTHxHEIGHT",
        help="of the images that keypoints without VIDEO are of",
    )
    parser.add_argument(
        "--gestures",
        default="default",
        metavar="MODEL.npz",
        help="the symbols; `jaxfilters fit gestures` makes such a file (default: twelve shapes)",
    )
    add_variant(parser, ("recommended", "published"))
    add_seed(parser)
    add_video_options(parser)
    add_resume(parser)
    add_results_options(parser)
