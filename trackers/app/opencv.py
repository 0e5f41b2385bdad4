"""The version of OpenCV that answers to the name `cv2`, which several packages share and overwrite."""

import cv2

from jaxfilters.trackers.io.errors import InputError

MAJOR = 4
"""OpenCV 5 has neither the cascades of faces nor the detector of people, and shapes some results differently."""


def check_version() -> None:
    """Refuse another major version: `pip` cannot, where another package has replaced the folder `cv2`.

    Raises:
        InputError: OpenCV is not of version 4; the message says how to install it.
    """
    if cv2.__version__.split(".")[0] != str(MAJOR):
        raise InputError(
            f"OpenCV {cv2.__version__} is installed, and OpenCV {MAJOR} is needed: uninstall the packages"
            " opencv-python and opencv-contrib-python, which replace it, and run"
            f" pip install --force-reinstall 'opencv-python-headless<{MAJOR + 1}'"
        )
