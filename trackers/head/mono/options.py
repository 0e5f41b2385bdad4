"""The options of `jaxfilters track head-mono`, apart from what carries them out so that `--help` answers at once."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_number


def add_mono(what: Any, seed: Callable[[str], int]) -> None:
    """Add the command to the parser's `what`; `seed` reads random seeds.

    Options of the tracker are None unless given, so that the defaults stand in one place, `MonoOptions`.
    """
    mono: argparse.ArgumentParser = what.add_parser(
        "head-mono", help="pose, expression and identity of one face, from one camera"
    )
    mono.add_argument(
        "video_source",
        nargs="?",
        metavar="VIDEO|CAMERA",
        help="video file, folder of images or number of a live camera; without it, a synthetic face",
    )
    mono.add_argument(
        "--camera", type=Path, metavar="CAMERA.json", help="intrinsics (default: a focal length of 1.2 image widths)"
    )
    mono.add_argument(
        "--estimate-focal",
        action="store_true",
        help="say at the end what the face tells of the focal length, for the next run's CAMERA.json",
    )
    mono.add_argument(
        "--model",
        type=Path,
        metavar="MODEL.npz",
        help="what faces differ in; `jaxfilters fit face-model` makes one, of ten or 68 landmarks (default: a general "
        "one of ten)",
    )
    mono.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    mono.add_argument(
        "--points",
        type=Path,
        metavar="FILE.csv",
        help="columns name,u,v: the ten landmarks in the first image, or the 68 of iBUG by their numbers from 0, "
        "pixels from the centre of the top left one (default: they are detected in five images)",
    )
    mono.add_argument(
        "--detector",
        choices=("cascades", "mediapipe"),
        help="what finds the landmarks: OpenCV's cascades (default), or MediaPipe's face mesh, which with a model of "
        "68 landmarks gives most of them, and the width of the irises",
    )
    mono.add_argument(
        "--eyes-apart-mm",
        type=positive_number,
        metavar="MM",
        help="distance between the pupils, if it is known: without it, size and distance are known to some 3 %%",
    )
    mono.add_argument(
        "--known",
        type=Path,
        nargs="+",
        metavar="PERSON.npz",
        help="people who may be before the camera: person.npz of earlier runs with the same model",
    )
    _add_run(mono, seed)


def _add_run(mono: argparse.ArgumentParser, seed: Callable[[str], int]) -> None:
    """What is not about the face."""
    mono.add_argument("--num-particles", type=int, metavar="N", help="number of particles (default: 750)")
    mono.add_argument("--seed", type=seed, metavar="SEED", help="random seed, also of the synthetic face")
    mono.add_argument("--fps", type=positive_number, metavar="FPS", help="of the recording, in place of what it says")
    mono.add_argument("--seconds", type=positive_number, metavar="S", help="stop after so long, as with live cameras")
    mono.add_argument("--no-video", action="store_false", dest="video", help="do not write overlay.mp4")
