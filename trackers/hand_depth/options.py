"""The options of `jaxfilters track hand-depth`, apart from what carries them out so that `--help` answers at once."""

import argparse

from jaxfilters.trackers.app.options import add_recording, add_results_options, add_seed


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    add_recording(parser, "folder of 16-bit PNGs with camera.json, or .npz with depth_mm and K")
    add_tracker_options(parser)
    add_results_options(parser)


def add_tracker_options(parser: argparse.ArgumentParser) -> None:
    """Options that are None unless given, so that the defaults stand in one place, `HandDepthConfig`."""
    parser.add_argument("--filter", choices=("rbpf", "pf"), help="Rao-Blackwellized (default) or plain particle filter")
    parser.add_argument("--particles", type=int, dest="num_particles", metavar="N", help="number of particles")
    parser.add_argument(
        "--stride", type=int, metavar="PIXELS", help="compare every PIXELS-th row and column (default: by distance)"
    )
    parser.add_argument(
        "--scale", type=float, metavar="FACTOR", help="size of the hand, 1 = average adult (default: fitted)"
    )
    parser.add_argument(
        "--surface", choices=("capsules", "mesh"), help="what particles are rendered as (default: capsules)"
    )
    parser.add_argument(
        "--guide",
        action=argparse.BooleanOptionalAction,
        help="draw particles around what registration finds (default), or from the motion model alone",
    )
    parser.add_argument(
        "--missing",
        choices=("auto", "background", "unknown"),
        help="what pixels without a reading are (default: auto, background if more than half of the first frame)",
    )
    parser.add_argument(
        "--hand", choices=("right", "left", "auto"), help="which hand (default: auto, by what the depth shows)"
    )
    add_seed(parser)
