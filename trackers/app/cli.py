"""The command `jaxfilters`."""

import argparse
import runpy
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from jaxfilters.trackers.app.argument_types import image_size, seed
from jaxfilters.trackers.app.compiled import keep_compiled_programs
from jaxfilters.trackers.app.devices import collect_rarely, keep_freed_memory, silence_decoders, use_all_cores
from jaxfilters.trackers.app.endings import Terminated, ended_by_signals, unforeseen
from jaxfilters.trackers.app.options import add_picture_options
from jaxfilters.trackers.app.output_folder import check_file, check_free
from jaxfilters.trackers.batch.options import add_batch
from jaxfilters.trackers.calibration.options import add_calibrate
from jaxfilters.trackers.fitting.options import add_fit
from jaxfilters.trackers.gestures.options import add_recognise
from jaxfilters.trackers.hand_depth.options import add_tracker_options
from jaxfilters.trackers.io.errors import CheckpointError, InputError, OutputError
from jaxfilters.trackers.registry import SYSTEMS, system

FAILURE, UNFORESEEN, INTERRUPTED, TERMINATED = 2, 70, 130, 143
"""Exit codes: wrong input or a full disk; an error of the program itself; Ctrl-C; SIGTERM."""
_LONGEST = 1000
"""Characters of an error."""


def command() -> int:
    """The console script: `main`, with compiled programs kept for the next run, except where speed is measured.

    Settings of the whole process are made here and not in `main`, which may be called from another program.
    """
    if sys.argv[1:2] != ["bench"] and (trouble := keep_compiled_programs()):
        print(f"jaxfilters: {trouble}.", file=sys.stderr)
    if "--debug" not in sys.argv:
        silence_decoders()
    keep_freed_memory()
    collect_rarely()
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code is 0 for success."""
    argv = sys.argv[1:] if argv is None else list(argv)
    use_all_cores()
    if argv[:1] == ["bench"]:
        return _bench(argv[1:])
    options = _parser().parse_args(argv)
    # What computes is imported by the commands: `--help` answers at once, and the number of devices is set by now.
    try:
        with ended_by_signals():
            import_module("jaxfilters.trackers.app.opencv").check_version()
            _check_output(options)
            print(_command_of(options)(options))
    except (InputError, OutputError, CheckpointError) as error:
        print(f"jaxfilters: error: {_shortened(str(error))}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt as interrupt:
        word = "terminated" if isinstance(interrupt, Terminated) else "interrupted"
        print(f"\njaxfilters: {word}; {interrupt or 'nothing was kept'}.", file=sys.stderr)
        return TERMINATED if isinstance(interrupt, Terminated) else INTERRUPTED
    except Exception as error:
        if options.debug:
            raise
        print(f"jaxfilters: error: {unforeseen(error, getattr(options, 'out', None))}", file=sys.stderr)
        return UNFORESEEN
    return 0


def _check_output(options: argparse.Namespace) -> None:
    """Refuse results that cannot be written before anything is read or compiled.

    Raises:
        InputError: `--rerun` cannot be used.
        OutputError: nobody can write the results, or another run writes into their folder.
    """
    if options.command in ("track", "demo", "batch"):
        check_free(options.out)
    else:
        for path in (options.out, getattr(options, "remember", None)):
            if path is not None:
                check_file(path)
    if getattr(options, "rerun", None) is not None:
        import_module("jaxfilters.trackers.app.rerun_log").check_log(options.rerun)


def _shortened(text: str) -> str:
    """A message without its middle where it is very long: names of files may be, and what is wrong stands last."""
    half = _LONGEST // 2
    return text if len(text) <= _LONGEST else f"{text[:half]}...{text[-half:]}"


def _command_of(options: argparse.Namespace) -> Callable[[argparse.Namespace], str]:
    """The function that carries out the command, imported now."""
    if options.command == "track":
        return system(options.what).part("command", "track")
    if options.command == "demo":
        return system("hand-depth").part("command", "track")
    modules = {
        ("batch", None): ("batch.command", "batch"),
        ("calibrate", None): ("calibration.command", "calibrate"),
        ("recognise", None): ("gestures.command", "recognise"),
        ("fit", "noise"): ("fitting.noise", "fit_noise"),
        ("fit", "gestures"): ("gestures.command", "fit_gestures"),
        ("fit", "face-model"): ("fitting.face_model", "fit"),
        ("fit", "face-detector"): ("fitting.face_detector", "fit_detector"),
        ("view", None): ("app.viewer", "view"),
    }
    kind = options.source if options.command == "fit" else None
    module, name = modules[options.command, kind]
    return getattr(import_module(f"jaxfilters.trackers.{module}"), name)


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
    parser.add_argument("--debug", action="store_true", help="show the traceback of an unforeseen error")
    parser.add_argument("--version", action="version", version=f"jaxfilters {version('jaxfilters')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    track = commands.add_parser("track", help="follow something in a recording")
    what = track.add_subparsers(dest="what", required=True, metavar="WHAT")
    for one in SYSTEMS:
        one.part("options", "add_options")(what.add_parser(one.name, help=one.summary))

    demo = commands.add_parser("demo", help="follow a synthetic hand and draw what was found")
    demo.add_argument("--out", type=Path, default=Path("jaxfilters-demo"), metavar="DIR", help="default: %(default)s")
    add_picture_options(demo)
    demo.set_defaults(input=None, resume=False, overwrite=True)
    add_tracker_options(demo)

    add_batch(commands)
    add_calibrate(commands, image_size)
    add_fit(commands, seed)
    add_recognise(commands, seed)
    view = commands.add_parser("view", help="the results of a run as one page for a browser")
    view.add_argument("folder", type=Path, metavar="DIR", help="folder of the results of any tracker")
    view.add_argument("--out", type=Path, metavar="FILE.html", help="where to write the page (default: DIR/view.html)")
    view.add_argument("--no-open", action="store_false", dest="open", help="do not open it in a browser")
    commands.add_parser("bench", add_help=False, help="measure speed and accuracy (bench --help lists scenarios)")
    return parser


if __name__ == "__main__":
    sys.exit(command())
