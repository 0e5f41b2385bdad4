"""The tracking systems, by the names of their commands.

A system is a package with `options.add_options(parser)`, which imports nothing that computes, `command.track(options)`,
which runs it for the command line, and `track`, which runs it from Python. What `track` calls is one of two
interfaces, of which `jaxfilters.trackers.tracker` tells when each is used.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple


class System(NamedTuple):
    """One tracking system."""

    name: str
    """After `jaxfilters track`."""
    package: str
    summary: str
    """What it follows, in a few words."""

    def part(self, module: str, name: str) -> Callable[..., Any]:
        """A function of one of its modules, which is imported now."""
        return getattr(import_module(f"{self.package}.{module}"), name)


SYSTEMS = (
    System("hand-depth", "jaxfilters.trackers.hand_depth", "the pose of one hand in depth images"),
    System(
        "articulated",
        "jaxfilters.trackers.articulated",
        "lengths and angles of one hand from 2-D features or keypoints",
    ),
    System("people", "jaxfilters.trackers.people", "everybody on a floor, from fixed cameras"),
    System(
        "head-stereo",
        "jaxfilters.trackers.head.stereo",
        "pose and deformation of one face, from two calibrated cameras or from one",
    ),
    System("head-mono", "jaxfilters.trackers.head.mono", "pose, expression and identity of one face, from one camera"),
    System(
        "fingertips",
        "jaxfilters.trackers.fingertips",
        "the fingertips of hands over a desk, from above; what they draw, and what they handle",
    ),
)


def system(name: str) -> System:
    """The system of this name.

    Raises:
        ValueError: There is none.
    """
    for one in SYSTEMS:
        if one.name == name:
            return one
    raise ValueError(f"name: expected one of {', '.join(one.name for one in SYSTEMS)}; got {name!r}.")
