"""The options of `jaxfilters track people`, apart from what carries them out so that `--help` answers at once."""

import argparse
from pathlib import Path

from jaxfilters.trackers.app.options import add_config, add_results_options, add_resume, add_seed, add_video_options
from jaxfilters.trackers.people.config import PeopleConfig

DEFAULT_BACKGROUND = "median"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    parser.add_argument(
        "sources",
        nargs="*",
        metavar="VIDEO|CAMERA",
        help="video files, folders of images or numbers of live cameras; without any, a synthetic room",
    )
    parser.add_argument(
        "--camera",
        type=Path,
        action="append",
        default=[],
        metavar="CAMERA.json",
        help="one for each source, in their order; `jaxfilters calibrate` makes them",
    )
    parser.add_argument("--scene", type=Path, metavar="SCENE.json", help="floor and furniture, in metres")
    parser.add_argument(
        "--background",
        choices=("median", "mog2", "knn"),
        help=f"background subtraction (default: {DEFAULT_BACKGROUND}; none with --detections, unless it is given)",
    )
    parser.add_argument(
        "--detections",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="boxes of any detector (MOT text or COCO .json), one for each source; in place of background subtraction, "
        "or beside it with --background",
    )
    add_config(parser, PeopleConfig, "capacity", "height_m", "height_sd_m", "memory_s", "hidden_s", "calibration_error")
    add_video_options(parser)
    add_resume(parser)
    parser.add_argument("--mot", action="store_true", help="write tracks_mot.txt as well (MOT challenge)")
    parser.add_argument("--coco", action="store_true", help="write tracks_coco.json as well (COCO annotations)")
    add_seed(parser)
    add_results_options(parser)
