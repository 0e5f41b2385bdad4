"""The options of `jaxfilters fit gestures` and `recognise`, apart from what carries them out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import finite_number, positive_integer

WRITERS, TRIALS = 6, 30
"""Of the generator, and how often each draws every shape with one finger and with two: what the model that comes with
the package was made with."""
SHOWN_SEED = 1
"""Of the symbols that `recognise` draws where it has no data."""
_DATA = (
    "strokes: .csv with a row for each point (columns stroke,label,time,x,y and perhaps z, person, fingers), folder "
    "with a folder of such files for each symbol, .npz with points, length, label and perhaps person, or file of "
    "UNIPEN, InkML (.inkml) or JSON (.json, .ndjson); without it, symbols that are drawn at random"
)
_STREAMS = (
    "an .npz, or a folder of them, with points (F, J, 2 or 3) of all frames, length, the frames of each stream, "
    "annotations, rows of stream, gesture, first and last frame, and perhaps fps and names; or gesture, a number for "
    "each stream that is one example"
)


def add_fit_gestures(what: Any, seed: Callable[[str], int]) -> None:
    """Add `gestures` to what can be fitted; `seed` reads random seeds."""
    gestures = what.add_parser("gestures", help="symbols from examples of their strokes")
    gestures.add_argument("data", nargs="?", type=Path, metavar="DATA", help=_DATA)
    gestures.add_argument("--out", type=Path, required=True, metavar="MODEL.npz", help="the file to write")
    gestures.add_argument(
        "--add",
        type=Path,
        metavar="MODEL.npz",
        help="keep the symbols of this model (`default` is the package's) and add those of DATA; five do",
    )
    gestures.add_argument(
        "--held-out",
        choices=("person", "sequence"),
        help="also say how strokes of each person are recognised by the others', or how gestures of streams are found "
        "by the others'",
    )
    gestures.add_argument("--stream", action="store_true", help=f"find gestures in streams: DATA is {_STREAMS}")
    gestures.add_argument(
        "--states",
        type=positive_integer,
        metavar="N",
        help="of each model (default: 10; 16 for paths in a plane, 18 for few other strokes)",
    )
    gestures.add_argument(
        "--ways",
        type=positive_integer,
        metavar="N",
        help="to draw each symbol (default: one for 40 examples, at most 20, or 8 if trained by gradient)",
    )
    gestures.add_argument(
        "--seed",
        type=seed,
        default=0,
        metavar="SEED",
        help="of symbols drawn at random, and of the training with --stream (default: %(default)s)",
    )


def add_recognise(commands: Any, seed: Callable[[str], int]) -> None:
    """Add the command to the parser's `commands`; `seed` reads random seeds."""
    recognise = commands.add_parser("recognise", help="say which symbols strokes are")
    recognise.add_argument(
        "model", type=Path, metavar="MODEL.npz", help="of `fit gestures`; `default` is the package's, of strokes"
    )
    recognise.add_argument("data", nargs="?", type=Path, metavar="DATA", help=_DATA)
    recognise.add_argument("--out", type=Path, metavar="FILE.csv", help="write a row for each stroke there")
    recognise.add_argument(
        "--stream", action="store_true", help=f"find gestures in streams, by such a MODEL: DATA is {_STREAMS}"
    )
    recognise.add_argument(
        "--margin",
        type=finite_number,
        metavar="NATS",
        help="a point by which a symbol has to beat what all of them are made of, beside its own margin, which `fit "
        "gestures` measures (default: 0)",
    )
    recognise.add_argument(
        "--seed", type=seed, metavar="SEED", help=f"of symbols drawn at random (default: {SHOWN_SEED})"
    )
