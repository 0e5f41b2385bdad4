"""The focal length of a camera without a calibration: as its file says, or as cameras have it before a face."""

from pathlib import Path
from typing import NamedTuple

from jaxfilters.trackers.io.lens_metadata import equivalent_focal_mm, focal_px

USUAL_MM = 30.0
"""Assumed focal length on 35 mm film, .8 image widths of video 16:9, a horizontal field of view of 64 degrees.

Webcams show 66 to 78 degrees along the diagonal (27 to 33 mm; Microsoft LifeCam HD-3000 and Cinema, Logitech C920),
those of laptops up to 88 (22 mm); phones have 23 to 32 mm, and crop some of it while they film; older cameras with a
zoom begin at 30 to 40.
"""
USUAL_LOG_STD = 0.25
"""Of the logarithm of such a focal length: 23 to 39 mm in two of three cameras, 18 to 49 in 19 of 20."""
WRITTEN_LOG_STD = 0.1
"""Of the logarithm of one that a file says: phones write whole millimetres, and stabilising crops up to a fifth."""


class FocalPrior(NamedTuple):
    """What is known of a focal length before the images."""

    px: float
    """Pixels, the same along both axes."""
    log_std: float
    """Standard deviation of its logarithm, in which distances are wrong in proportion."""
    note: str
    """Where it is from, for a person."""


def usual_focal(image_size: tuple[int, int]) -> FocalPrior:
    """That of a camera of which nothing is known but its images (columns, rows)."""
    px = focal_px(USUAL_MM, image_size)
    share = f"give or take {100 * USUAL_LOG_STD:.0f} %"
    return FocalPrior(px, USUAL_LOG_STD, f"an assumed focal length of {px:.0f} px ({USUAL_MM:.0f} mm on film), {share}")


def focal_prior(name: str, image_size: tuple[int, int]) -> FocalPrior:
    """That of the camera of a source of images.

    Args:
        name: Video, folder of images, or number of a live camera.
        image_size: Columns and rows.
    """
    equivalent_mm = None if name.isdecimal() else equivalent_focal_mm(Path(name))
    if equivalent_mm is None:
        return usual_focal(image_size)
    px = focal_px(equivalent_mm, image_size)
    where = f"a focal length of {px:.0f} px from the file's metadata ({equivalent_mm:.0f} mm on film)"
    return FocalPrior(px, WRITTEN_LOG_STD, f"{where}, give or take {100 * WRITTEN_LOG_STD:.0f} %")
