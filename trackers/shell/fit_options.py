"""The options of `jaxfilters fit`, apart from what carries them out so that `--help` answers at once."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

IDENTITIES, EXPRESSIONS, PEOPLE = 15, 5, 200
"""What the model that comes with the package was made with."""


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
        "--identities", type=int, default=IDENTITIES, metavar="N", help="parameters of identity (default: %(default)s)"
    )
    face.add_argument(
        "--expressions", type=int, default=EXPRESSIONS, metavar="N", help="of expression (default: %(default)s)"
    )
    face.add_argument(
        "--points", type=int, choices=(10, 68), help="landmarks (default: those of DATA; 10 where it has no own)"
    )
    face.add_argument(
        "--people",
        type=int,
        default=PEOPLE,
        metavar="N",
        help="how many to draw from the generator or the ICT face model (default: %(default)s)",
    )
    face.add_argument("--seed", type=seed, default=0, metavar="SEED", help="of that draw (default: %(default)s)")
