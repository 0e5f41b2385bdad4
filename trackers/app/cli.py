"""The command `jaxfilters`."""

import argparse
import runpy
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from jaxfilters.trackers.app.argument_types import image_size, positive_number, seed
from jaxfilters.trackers.app.compiled import keep_compiled_programs
from jaxfilters.trackers.app.devices import use_all_cores
from jaxfilters.trackers.calibration.options import add_calibrate
from jaxfilters.trackers.fingertips.options import add_fingertips
from jaxfilters.trackers.fitting.options import add_fit
from jaxfilters.trackers.gestures.options import add_recognise
from jaxfilters.trackers.head.mono.options import add_mono
from jaxfilters.trackers.head.stereo.options import add_head
from jaxfilters.trackers.people.options import add_people

FAILURE, INTERRUPTED = 2, 130
"""Exit codes: wrong input or a full disk; Ctrl-C."""


def command() -> int:
    """The console script: `main`, with compiled programs kept for the next run, except where speed is measured."""
    if sys.argv[1:2] != ["bench"] and (trouble := keep_compiled_programs()):
        print(f"jaxfilters: {trouble}.", file=sys.stderr)
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code is 0 for success."""
    argv = sys.argv[1:] if argv is None else list(argv)
    use_all_cores()
    if argv[:1] == ["bench"]:
        return _bench(argv[1:])
    options = _parser().parse_args(argv)
    # Everything that computes is imported here: `--help` answers at once, and the number of devices is set by now.
    from jaxfilters.trackers.app.track_command import track
    from jaxfilters.trackers.io.errors import CheckpointError, InputError, OutputError

    try:
        if options.command == "calibrate":
            from jaxfilters.trackers.calibration.command import calibrate

            print(calibrate(options))
        elif options.command == "fit" and options.source == "noise":
            from jaxfilters.trackers.fitting.noise import fit_noise

            print(fit_noise(options))
        elif options.command == "fit" and options.source == "gestures":
            from jaxfilters.trackers.gestures.command import fit_gestures

            print(fit_gestures(options))
        elif options.command == "recognise":
            from jaxfilters.trackers.gestures.command import recognise

            print(recognise(options))
        elif options.command == "fit":
            from jaxfilters.trackers.fitting.face_model import fit

            print(fit(options))
        elif getattr(options, "what", None) == "people":
            from jaxfilters.trackers.people.command import track_people

            track_people(options)
        elif getattr(options, "what", None) == "head-mono":
            from jaxfilters.trackers.head.mono.command import track_mono

            print(track_mono(options))
        elif getattr(options, "what", None) == "head-stereo":
            from jaxfilters.trackers.head.stereo.command import track_head

            print(track_head(options))
        elif getattr(options, "what", None) == "fingertips":
            from jaxfilters.trackers.fingertips.command import track_fingertips

            print(track_fingertips(options))
        else:
            track(_job(options), options)
    except (InputError, OutputError, CheckpointError) as error:
        print(f"jaxfilters: error: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt as interrupt:
        print(f"\njaxfilters: interrupted; {interrupt or 'nothing was kept'}.", file=sys.stderr)
        return INTERRUPTED
    return 0


def _job(options: argparse.Namespace) -> Any:
    if getattr(options, "what", None) == "articulated":
        from jaxfilters.trackers.articulated.command import articulated_job

        return articulated_job(options)
    from jaxfilters.trackers.hand_depth.command import hand_job

    return hand_job(options)


def _bench(arguments: list[str]) -> int:
    """`python -m jaxfilters.benchmarks`: the benchmarks stand above the trackers and are not imported by them."""
    previous, sys.argv = sys.argv, ["jaxfilters bench", *arguments]
    try:
        runpy.run_module("jaxfilters.benchmarks", run_name="__main__")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv = previous
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxfilters", description="Bayesian filters that follow things with cameras.")
    parser.add_argument("--version", action="version", version=f"jaxfilters {version('jaxfilters')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    track = commands.add_parser("track", help="follow something in a recording")
    what = track.add_subparsers(dest="what", required=True, metavar="WHAT")
    hand = what.add_parser("hand-depth", help="the pose of one hand in depth images")
    _add_recording(hand, "folder of 16-bit PNGs with camera.json, or .npz with depth_mm and K")
    _add_filter_options(hand)
    articulated = what.add_parser("articulated", help="lengths and angles of one hand from 2-D features or keypoints")
    _add_recording(
        articulated,
        ".npz with features or keypoints, folder of OpenPose's *_keypoints.json, or .json or .csv of MediaPipe's "
        "landmarks",
    )
    _add_articulated_options(articulated)

    add_people(what, seed)
    add_head(what, seed)
    add_mono(what, seed)
    add_fingertips(what, seed)

    demo = commands.add_parser("demo", help="follow a synthetic hand and draw what was found")
    demo.add_argument("--out", type=Path, default=Path("jaxfilters-demo"), metavar="DIR", help="default: %(default)s")
    demo.set_defaults(input=None, resume=False, overwrite=True)
    _add_filter_options(demo)

    add_calibrate(commands, image_size)
    add_fit(commands, seed)
    add_recognise(commands, seed)
    commands.add_parser("bench", add_help=False, help="measure speed and accuracy (bench --help lists scenarios)")
    return parser


def _add_recording(parser: argparse.ArgumentParser, what: str) -> None:
    parser.add_argument(
        "input", nargs="?", type=Path, metavar="INPUT", help=f"{what}; without it, a synthetic recording"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run in DIR")
    parser.set_defaults(overwrite=False)


def _add_common_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--hand", choices=("right", "left"), help="which hand (default: right)")
    parser.add_argument("--seed", type=seed, metavar="SEED", help="random seed")
    parser.add_argument("--no-video", action="store_false", dest="video", help="do not write overlay.mp4")


def _add_articulated_options(parser: argparse.ArgumentParser) -> None:
    """Options that are None unless given, as below."""
    parser.add_argument(
        "--mode",
        choices=("recommended", "literal", "unconstrained"),
        help="how estimates are kept within the limits of a hand (default: recommended; literal: as in the paper)",
    )
    parser.add_argument("--hypotheses", type=int, metavar="N", help="how many at most (default: 6)")
    parser.add_argument(
        "--gate", type=float, metavar="SIGMAS", help="leave out features that are farther off (default: 5; 0: never)"
    )
    parser.add_argument(
        "--image-size", type=image_size, metavar="WIDTHxHEIGHT", help="of the image, for coordinates from 0 to 1"
    )
    parser.add_argument(
        "--noise",
        type=positive_number,
        metavar="PIXELS",
        help="standard deviation of a keypoint's coordinate (default: 5 percent of the hand's diagonal)",
    )
    parser.add_argument(
        "--fps",
        type=positive_number,
        metavar="FPS",
        help="frames per second of a recording without times (default: 30)",
    )
    _add_common_options(parser)


def _add_filter_options(parser: argparse.ArgumentParser) -> None:
    """Options that are None unless given, so that the defaults stand in one place, the configuration."""
    parser.add_argument("--filter", choices=("rbpf", "pf"), help="Rao-Blackwellized (default) or plain particle filter")
    parser.add_argument("--particles", type=int, dest="num_particles", metavar="N", help="number of particles")
    parser.add_argument("--stride", type=int, metavar="PIXELS", help="compare every PIXELS-th row and column")
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
    _add_common_options(parser)


if __name__ == "__main__":
    sys.exit(command())
