"""What one camera takes for granted and cannot measure, as a part of the standard deviations of a pose."""

import numpy as np

from jaxfilters.trackers.head.common.state import HeadTrack
from jaxfilters.trackers.io.face_models import SIZE_STD


def with_assumptions(track: HeadTrack, focal_log_std: float) -> HeadTrack:
    """A track of one camera whose standard deviations contain those of the face's size and of the focal length.

    A larger face is as much farther from the camera, on the same line of sight. With a longer focal length it is
    farther away and as far from the optical axis, so that its line of sight, and the head with it, turns to the axis.

    Args:
        track: Of a camera that is the world, for a face of average size, millimetres and radians.
        focal_log_std: Standard deviation of the logarithm of the focal length; 0 where it is calibrated.
    """
    x, y, z = np.moveaxis(np.asarray(track.pose[:, :3]), -1, 0)
    by_size = SIZE_STD * np.stack([x, y, z], axis=-1)
    by_focal = focal_log_std * np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=-1)
    ray = np.stack([x, y], axis=-1) / z[:, None]
    turned = focal_log_std * np.column_stack([np.zeros_like(z), ray / (1 + ray**2)])
    more = np.concatenate([by_size**2 + by_focal**2, turned**2], axis=1)
    return track._replace(pose_std=np.sqrt(np.asarray(track.pose_std) ** 2 + more))
