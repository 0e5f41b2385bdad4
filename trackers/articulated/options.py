"""The options of `jaxfilters track articulated`, apart from what carries them out so that `--help` answers at once."""

import argparse

from jaxfilters.trackers.app.argument_types import image_size, positive_number
from jaxfilters.trackers.app.options import add_config, add_recording, add_results_options, add_seed
from jaxfilters.trackers.articulated.config import ArticulatedConfig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    add_recording(
        parser,
        ".npz with features or keypoints, folder of OpenPose's *_keypoints.json, or .json or .csv of MediaPipe's "
        "landmarks",
    )
    add_config(parser, ArticulatedConfig, "variant", "hypotheses", "gate", "hand", "focal", "palm_width")
    parser.add_argument(
        "--image-size", type=image_size, metavar="WIDTHxHEIGHT", help="of the image, for coordinates from 0 to 1"
    )
    parser.add_argument(
        "--noise",
        type=positive_number,
        metavar="PIXELS",
        help="standard deviation of a keypoint's coordinate (default: a share of the hand's diagonal)",
    )
    parser.add_argument(
        "--fps",
        type=positive_number,
        metavar="FPS",
        help="frames per second of a recording without times (default: 30)",
    )
    add_seed(parser)
    add_results_options(parser)
