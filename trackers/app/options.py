"""Between the options of a command line and the configuration of a tracker."""

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from jaxfilters.trackers.app.argument_types import positive_number, seed
from jaxfilters.trackers.configuration import settings_of

VIEWER = "viewer"
"""The value of `--rerun` without a file."""
Made = TypeVar("Made")
_SHORT = {"num_particles": "--particles"}
"""Further names of options."""


def config_from_args(config: Made, options: argparse.Namespace) -> Made:
    """A configuration with the options of the command line; those that are None keep what it has."""
    names = (field.name for field in dataclasses.fields(config))  # type: ignore[arg-type]
    given = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    return dataclasses.replace(config, **given)  # type: ignore[type-var]


def add_variant(parser: argparse.ArgumentParser, variants: Iterable[str]) -> None:
    """Which tracker: the first of the variants unless given."""
    names = tuple(variants)
    parser.add_argument(
        "--variant", choices=names, default=names[0], help="this tracker, or the published one (default: %(default)s)"
    )


def add_config(parser: argparse.ArgumentParser, config: type, *names: str) -> None:
    """Options from fields of a configuration, with their types, choices and docstrings; None unless given.

    Args:
        parser: Of the command.
        config: A dataclass whose fields `jaxfilters.trackers.configuration` can read.
        names: The fields, in the order of the help.
    """
    settings = settings_of(config)
    for setting in (settings[name] for name in names):
        flags = [f"--{setting.name.replace('_', '-')}", *filter(None, [_SHORT.get(setting.name)])]
        text = _lowered(setting.meaning).removesuffix(".").replace("%", "%%")
        if setting.kind is bool:
            parser.add_argument(
                *flags,
                action=argparse.BooleanOptionalAction,
                help=f"{text} (default: {'' if setting.default else 'no-'}{setting.name})",
            )
            continue
        default = "" if setting.default is None else f" (default: {setting.default})"
        metavar = {int: "N", float: "X"}.get(setting.kind)
        parser.add_argument(
            *flags, type=setting.kind, choices=setting.choices or None, metavar=metavar, help=text + default
        )


def _lowered(text: str) -> str:
    """A sentence with a small letter first, as in lines of help, unless it begins as "Rao-Blackwellized" does."""
    word = text.split(maxsplit=1)[0] if text else ""
    return text if any(letter.isupper() for letter in word[1:]) else text[:1].lower() + text[1:]


def add_recording(parser: argparse.ArgumentParser, what: str) -> None:
    """A recording of frames on disk, whose run can be resumed."""
    parser.add_argument(
        "input", nargs="?", type=Path, metavar="INPUT", help=f"{what}; without it, a synthetic recording"
    )
    add_resume(parser)


def add_resume(parser: argparse.ArgumentParser) -> None:
    """Whether an interrupted run is continued."""
    parser.add_argument("--resume", action="store_true", help="continue an interrupted run in DIR")
    parser.set_defaults(overwrite=False)


def add_results_options(parser: argparse.ArgumentParser) -> None:
    """Where a run writes, and whether it draws a video."""
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    add_picture_options(parser)


def add_picture_options(parser: argparse.ArgumentParser) -> None:
    """Whether a run draws a video, and whether it can be watched."""
    parser.add_argument("--no-video", action="store_false", dest="video", help="do not write overlay.mp4")
    parser.add_argument(
        "--rerun",
        nargs="?",
        const=VIEWER,
        metavar="FILE.rrd",
        help="show the run in the Rerun viewer while it goes on, or write it into a file for it (needs rerun-sdk)",
    )


def add_video_options(parser: argparse.ArgumentParser) -> None:
    """The rate and the length of what video sources deliver."""
    parser.add_argument(
        "--fps", type=positive_number, metavar="FPS", help="of the recordings, in place of what they say"
    )
    parser.add_argument("--seconds", type=positive_number, metavar="S", help="stop after so long, as with live cameras")


def add_seed(parser: argparse.ArgumentParser, default: int | None = None) -> None:
    """The random seed; None unless given where the configuration has the default."""
    parser.add_argument("--seed", type=seed, default=default, metavar="SEED", help="random seed")
