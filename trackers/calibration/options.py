"""The options of `jaxfilters calibrate`, apart from what carries them out so that `--help` answers at once."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_number

Pair = tuple[int, int]


def add_calibrate(commands: Any, pair: Callable[[str], Pair]) -> None:
    """Add the command to the parser's `commands`; `pair` reads texts such as 640x480."""
    calibrate = commands.add_parser("calibrate", help="find out where fixed cameras stand and how they image")
    sources = calibrate.add_subparsers(dest="source", required=True, metavar="SOURCE")
    _add_points(sources, pair)
    _add_charuco(sources, pair)
    _add_tsai(sources, pair)
    _add_stereo(sources, pair)


def _add_points(sources: Any, pair: Callable[[str], Pair]) -> None:
    points = sources.add_parser("points", help="from places in the room and their pixels")
    points.add_argument(
        "file",
        type=Path,
        metavar="FILE.csv",
        help="columns x_m,y_m,z_m,u,v: metres with Z up from the floor, pixels from the centre of the top left one; "
        "six or more at several heights, or four or more on the floor",
    )
    points.add_argument("--image-size", type=pair, required=True, metavar="WIDTHxHEIGHT", help="of the images")
    points.add_argument(
        "--distortion", action="store_true", help="find the lens's distortion as well; not with --intrinsics"
    )
    points.add_argument(
        "--intrinsics", type=Path, metavar="CAMERA.json", help="keep K and distortion of this file; find the pose alone"
    )
    _add_out(points)


def _add_charuco(sources: Any, pair: Callable[[str], Pair]) -> None:
    charuco = sources.add_parser("charuco", help="from pictures of a ChArUco board")
    charuco.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help="the board held in all places and ways")
    _add_board(charuco, pair)
    charuco.add_argument(
        "--floor",
        type=Path,
        metavar="IMAGE",
        help="the board on the floor, from where the camera stays: its first corner becomes the origin, its rows X; "
        "without it, the file holds the intrinsics only",
    )
    _add_out(charuco)


def _add_stereo(sources: Any, pair: Callable[[str], Pair]) -> None:
    stereo = sources.add_parser("stereo", help="two cameras relative to each other, from pictures of a ChArUco board")
    for side in ("left", "right"):
        stereo.add_argument(
            side,
            type=Path,
            metavar=side.upper(),
            help=f"folder of the {side} camera's pictures; both cameras take one at each moment, names sort alike",
        )
    _add_board(stereo, pair)
    stereo.add_argument("--out", type=Path, required=True, metavar="RIG.json", help="the file to write")


def _add_board(parser: argparse.ArgumentParser, pair: Callable[[str], Pair]) -> None:
    parser.add_argument("--squares", type=pair, required=True, metavar="COLUMNSxROWS", help="of the board, as in 7x5")
    parser.add_argument("--square-m", type=positive_number, required=True, metavar="METRES", help="side of a square")
    parser.add_argument("--marker-m", type=positive_number, required=True, metavar="METRES", help="side of a marker")
    parser.add_argument(
        "--dictionary", default="DICT_4X4_50", metavar="NAME", help="of the markers (default: %(default)s)"
    )


def _add_tsai(sources: Any, pair: Callable[[str], Pair]) -> None:
    tsai = sources.add_parser("tsai", help="from parameters of Tsai's model in XML, as of PETS 2009")
    tsai.add_argument("file", type=Path, metavar="FILE.xml")
    tsai.add_argument(
        "--image-size", type=pair, metavar="WIDTHxHEIGHT", help="of the images (default: that of the file)"
    )
    _add_out(tsai)


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="CAMERA.json", help="the file to write")
