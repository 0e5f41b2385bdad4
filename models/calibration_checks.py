"""Points and pixels that fix no camera, refused with what is wrong with them."""

import numpy as np

FLAT = 1e-3
"""Points whose extents differ by this factor lie in a plane."""


def checked_points(points_m: np.ndarray, pixels: np.ndarray, fewest: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) in metres and their pixels (n, 2) as float64.

    Raises:
        ValueError: wrong shapes, numbers that are not finite, or fewer points than `fewest`.
    """
    # OpenCV takes no columns of a larger array.
    points_m, pixels = np.ascontiguousarray(points_m, float), np.ascontiguousarray(pixels, float)
    if points_m.ndim != 2 or points_m.shape[1] != 3 or pixels.shape != (len(points_m), 2):
        raise ValueError(f"points_m must be (n, 3) and pixels (n, 2); got {points_m.shape} and {pixels.shape}.")
    if not (np.isfinite(points_m).all() and np.isfinite(pixels).all()):
        raise ValueError("points_m and pixels must be finite.")
    if len(points_m) < fewest:
        raise ValueError(f"points_m must be {fewest} points or more for this; got {len(points_m)}.")
    return points_m, pixels


def check_in_front(depth: np.ndarray) -> None:
    """Raise `ValueError` unless all depths (n,) are positive."""
    if (depth <= 0).any():
        raise ValueError(
            f"points_m and pixels fit only a camera with {int((depth <= 0).sum())} of {len(depth)} points behind it: "
            "the world must be right-handed with Z up, and pixels u to the right and v down."
        )


def is_flat(points: np.ndarray) -> bool:
    """Whether points (n, d) have next to no extent in some direction."""
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[-1] <= FLAT * extents[0])


def check_spread(pixels: np.ndarray) -> None:
    """Raise `ValueError` for pixels (n, 2) on one line, which show no camera how points beside the line move."""
    if is_flat(pixels):
        (u, v), (u_end, v_end) = min(pixels.tolist()), max(pixels.tolist())
        raise ValueError(
            f"pixels of all {len(pixels)} points lie on one line, or nearly, from ({u:g}, {v:g}) to ({u_end:g}, "
            f"{v_end:g}): points to the sides of it are needed."
        )
