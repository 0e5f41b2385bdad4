"""Recordings that nobody may redistribute, in the folder that JAXFILTERS_DATA names."""

import os
from pathlib import Path

VARIABLE = "JAXFILTERS_DATA"
"""Of the environment."""


class RecordingError(Exception):
    """A recording that is not there, or a file of it that cannot be used; the message says what to do."""


def recording_folder(name: str) -> Path:
    """The folder of one recording.

    Raises:
        RecordingError: if it is not there.
    """
    root = os.environ.get(VARIABLE)
    if not root:
        raise RecordingError(f"{VARIABLE} is not set; it must name the folder that holds {name}.")
    folder = Path(root) / name
    if not folder.is_dir():
        raise RecordingError(f"{VARIABLE} is {root}, which holds no folder {name}.")
    return folder
