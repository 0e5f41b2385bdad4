"""The options of `jaxfilters track head-mono`, apart from what carries them out so that `--help` answers at once."""

import argparse
from pathlib import Path

from jaxfilters.trackers.app.options import (
    add_config,
    add_results_options,
    add_resume,
    add_seed,
    add_variant,
    add_video_options,
)
from jaxfilters.trackers.head.mono.config import VARIANTS, MonoConfig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    parser.add_argument(
        "video_source",
        nargs="?",
        metavar="VIDEO|CAMERA",
        help="video file, folder of images or number of a live camera; without it, a synthetic face",
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="CAMERA.json",
        help="intrinsics (default: the focal length that the file's metadata say, or that of a usual camera)",
    )
    parser.add_argument(
        "--estimate-focal",
        action="store_true",
        help="say at the end what the face tells of the focal length, for the next run's CAMERA.json",
    )
    parser.add_argument(
        "--model",
        type=Path,
        metavar="MODEL.npz",
        help="what faces differ in; `jaxfilters fit face-model` makes one, of ten or 68 landmarks (default: a general "
        "one of ten)",
    )
    parser.add_argument(
        "--points",
        type=Path,
        metavar="FILE.csv",
        help="columns name,u,v: the ten landmarks in the first image, or the 68 of iBUG by their numbers from 0, "
        "pixels from the centre of the top left one (default: they are detected in five images)",
    )
    parser.add_argument(
        "--detector",
        choices=("cascades", "mediapipe"),
        help="what finds the landmarks: MediaPipe's face mesh (default where it is installed), which with a model of "
        "68 landmarks gives most of them, and the width of the irises, or OpenCV's cascades",
    )
    add_variant(parser, VARIANTS)
    add_config(parser, MonoConfig, "eyes_apart_mm", "num_particles")
    parser.add_argument(
        "--known",
        type=Path,
        nargs="+",
        metavar="PERSON.npz",
        help="people who may be before the camera: person.npz of earlier runs with the same model",
    )
    add_seed(parser)
    add_video_options(parser)
    add_resume(parser)
    add_results_options(parser)
