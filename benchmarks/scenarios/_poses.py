"""Poses of heads beside the truth, as tables show them."""

from typing import Any

import numpy as np
from jaxtyping import Float

DISPLAY = np.array([1.0, 1.0, 1.0, *np.rad2deg(np.ones(3))])
"""From millimetres and radians to millimetres and degrees."""

_LENGTHS = ("shape", "offset")
"""Fields of tracks, beside poses, that are lengths."""


def in_millimetres(track: Any) -> Any:
    """A track of a head, which is in metres, in the unit of synthetic faces; with the fields of `HeadTrack`.

    All but `deformation`, which is a length with two cameras and a number of standard deviations with one.
    """
    scale = np.repeat(np.array([1e3, 1.0]), 3)
    poses = {name: scale * np.asarray(getattr(track, name)) for name in ("pose", "pose_std")}
    others = {name: 1e3 * np.asarray(getattr(track, name)) for name in _LENGTHS if name in track._fields}
    return track._replace(**poses, **others)


def pose_errors(poses: Any, truth: Any) -> Float[np.ndarray, "t 6"]:
    """Millimetres and degrees, angles within half a turn.

    Args:
        poses: (t, 6) estimates, millimetres and radians.
        truth: (t, 6).
    """
    errors = (np.asarray(poses, float) - np.asarray(truth, float)) * DISPLAY
    errors[:, 3:] = (errors[:, 3:] + 180) % 360 - 180
    return errors
