"""The options of `jaxfilters batch`, apart from what carries them out so that `--help` answers at once."""

from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import positive_integer, positive_number

STALE_S = 60.0


def add_batch(commands: Any) -> None:
    """Add the command to the parser's `commands`."""
    parser = commands.add_parser("batch", help="track a list of recordings, with any number of processes and machines")
    parser.add_argument(
        "manifest",
        type=Path,
        metavar="MANIFEST",
        help=".json with a list of objects, or .csv, with name, tracker, input and options of every recording",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results, shared by all")
    parser.add_argument(
        "--processes",
        type=positive_integer,
        default=1,
        metavar="N",
        help="recordings that this command tracks at the same time (default: %(default)s)",
    )
    parser.add_argument(
        "--stale",
        type=positive_number,
        default=STALE_S,
        metavar="S",
        help="take over a recording whose process has given no sign of life for so long (default: %(default)g seconds)",
    )
    parser.add_argument(
        "--no-wait",
        action="store_false",
        dest="wait",
        help="end when no recording is left to start; otherwise wait for those of other processes, to take over",
    )
    parser.add_argument("--retry", action="store_true", help="track the recordings again that have failed")
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="run on the machines of a Ray cluster: 'auto', host:port, or 'local' (needs the extra ray)",
    )
