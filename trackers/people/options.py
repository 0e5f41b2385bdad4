"""The options of `jaxfilters track people`, apart from what carries them out so that `--help` answers at once."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_integer, positive_number


def add_people(what: Any, seed: Callable[[str], int]) -> None:
    """Add the command to the parser's `what`; `seed` reads random seeds."""
    people: argparse.ArgumentParser = what.add_parser("people", help="everybody on a floor, from fixed cameras")
    people.add_argument(
        "sources",
        nargs="*",
        metavar="VIDEO|CAMERA",
        help="video files, folders of images or numbers of live cameras; without any, a synthetic room",
    )
    people.add_argument(
        "--camera",
        type=Path,
        action="append",
        default=[],
        metavar="CAMERA.json",
        help="one for each source, in their order; `jaxfilters calibrate` makes them",
    )
    people.add_argument("--scene", type=Path, metavar="SCENE.json", help="floor and furniture, in metres")
    people.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    people.add_argument(
        "--background",
        choices=("median", "mog2", "knn"),
        default="median",
        help="how people are told from the room (default: %(default)s)",
    )
    people.add_argument(
        "--capacity", type=positive_integer, metavar="N", help="people at a time, at most (default: 32)"
    )
    people.add_argument(
        "--fps", type=positive_number, metavar="FPS", help="of the recordings, in place of what they say"
    )
    people.add_argument("--seconds", type=positive_number, metavar="S", help="stop after so long, as with live cameras")
    people.add_argument("--mot", action="store_true", help="write tracks_mot.txt as well (MOT challenge)")
    people.add_argument("--seed", type=seed, metavar="SEED", help="of the synthetic room")
    people.add_argument("--no-video", action="store_false", dest="video", help="do not write overlay.mp4")
