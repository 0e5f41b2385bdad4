"""The options of `jaxfilters track hand-depth`, apart from what carries them out so that `--help` answers at once."""

import argparse

from jaxfilters.trackers.app.options import add_config, add_recording, add_results_options, add_seed
from jaxfilters.trackers.hand_depth.config import HandDepthConfig


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser of the command."""
    add_recording(parser, "folder of 16-bit PNGs with camera.json, or .npz with depth_mm and K")
    add_tracker_options(parser)
    add_results_options(parser)


def add_tracker_options(parser: argparse.ArgumentParser) -> None:
    """Options of the tracker itself, which the demo has, too."""
    add_config(
        parser,
        HandDepthConfig,
        *("filter", "num_particles", "stride", "scale", "surface", "guide", "missing", "hand"),
    )
    add_seed(parser)
