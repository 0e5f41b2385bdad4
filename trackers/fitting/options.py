"""The options of `jaxfilters fit`, apart from what carries them out so that `--help` answers at once."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_integer, positive_number
from jaxfilters.trackers.gestures.options import add_fit_gestures

IDENTITIES, EXPRESSIONS, PEOPLE = 15, 5, 200
"""What the model that comes with the package was made with."""
RENDERED_PEOPLE, RENDERED_IMAGES = 60, 10
"""What the detectors' errors that come with the package were measured on."""


def add_fit(commands: Any, seed: Callable[[str], int]) -> None:
    """Add the command to the parser's `commands`; `seed` reads random seeds."""
    fit = commands.add_parser("fit", help="learn a model from examples")
    what = fit.add_subparsers(dest="source", required=True, metavar="WHAT")
    face = what.add_parser("face-model", help="what faces differ in, and what expressions do to them")
    face.add_argument(
        "data",
        nargs="?",
        type=Path,
        metavar="DATA",
        help=".npz with shapes (people, expressions, landmarks, 3) in millimetres, folder with a CSV file for each "
        "person (columns expression,name,x_mm,y_mm,z_mm), or folder with the ICT face model; without it, faces of the "
        "generator",
    )
    face.add_argument("--out", type=Path, required=True, metavar="MODEL.npz", help="the file to write")
    face.add_argument(
        "--identities",
        type=positive_integer,
        default=IDENTITIES,
        metavar="N",
        help="parameters of identity (default: %(default)s)",
    )
    face.add_argument(
        "--expressions",
        type=positive_integer,
        default=EXPRESSIONS,
        metavar="N",
        help="of expression (default: %(default)s)",
    )
    face.add_argument(
        "--points", type=int, choices=(10, 68), help="landmarks (default: those of DATA; 10 where it has no own)"
    )
    face.add_argument(
        "--people",
        type=positive_integer,
        default=PEOPLE,
        metavar="N",
        help="how many to draw from the generator or the ICT face model (default: %(default)s)",
    )
    face.add_argument("--seed", type=seed, default=0, metavar="SEED", help="of that draw (default: %(default)s)")
    face.add_argument(
        "--remember",
        type=Path,
        metavar="PEOPLE.npz",
        help="a file to write of who the people of DATA are, so that `jaxfilters track head-mono --known` knows them",
    )
    _add_face_detector(what, seed)
    add_fit_gestures(what, seed)
    _add_noise(what, seed)


def _add_face_detector(what: Any, seed: Callable[[str], int]) -> None:
    detector = what.add_parser("face-detector", help="by how much detectors misplace the landmarks of faces")
    detector.add_argument(
        "data", type=Path, metavar="DATA", help="folder with the ICT face model, whose people are rendered"
    )
    detector.add_argument("--out", type=Path, required=True, metavar="ERRORS.npz", help="the file to write")
    detector.add_argument(
        "--people",
        type=positive_integer,
        default=RENDERED_PEOPLE,
        metavar="N",
        help="how many to draw (default: %(default)s)",
    )
    detector.add_argument(
        "--images",
        type=positive_integer,
        default=RENDERED_IMAGES,
        metavar="N",
        help="of each of them, in several poses, lights and expressions (default: %(default)s)",
    )
    detector.add_argument("--seed", type=seed, default=0, metavar="SEED", help="of the people (default: %(default)s)")


def _add_noise(what: Any, seed: Callable[[str], int]) -> None:
    noise = what.add_parser("noise", help="how noisy a detector is, and how points move, from tracks alone")
    noise.add_argument(
        "tracks",
        nargs="?",
        type=Path,
        metavar="TRACKS",
        help=".npz with points (frames, points, coordinates), or CSV with id, frame or time_s, and x, y (z), as the "
        "trackers write it; without it, synthetic tracks",
    )
    noise.add_argument(
        "--fps", type=positive_number, default=30.0, help="frames a second, without times (default: %(default)s)"
    )
    noise.add_argument("--out", type=Path, metavar="NOISE.json", help="a file to write")
    noise.add_argument(
        "--seed", type=seed, default=0, metavar="SEED", help="of synthetic tracks (default: %(default)s)"
    )
