"""What was read from files beside the images, as hashes: what two runs must share for one to continue the other."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxfilters.trackers.io.cameras import CameraFile
from jaxfilters.trackers.io.content_hash import content_hash
from jaxfilters.trackers.io.scenes import SceneFile


def identity_of(
    cameras: Sequence[CameraFile], scene: SceneFile, detections: Sequence[Mapping[int, np.ndarray]]
) -> dict[str, Any]:
    """Hashes of contents, by name: equal for the same contents wherever the files lie.

    Args:
        cameras: Whose projection matrices, intrinsics and distortions count.
        scene: Of which the floor and the furniture count.
        detections: For each camera, boxes (n, 5) by frame; empty without a detector.
    """
    meshes = [part for mesh in scene.meshes for part in (mesh.vertices, mesh.faces)]
    outlines = [part for one in scene.outlines for part in (one["camera"], one["polygon"], one["at"])]
    return {
        "cameras": [_camera(one) for one in cameras],
        "floor": content_hash(scene.floor),
        "furniture": content_hash(scene.patches, *meshes, *outlines),
        "detections": [content_hash(*(part for item in sorted(one.items()) for part in item)) for one in detections],
    }


def _camera(file: CameraFile) -> str:
    undistortion = file.undistortion
    K = np.zeros((0, 0)) if undistortion.K is None else undistortion.K
    return content_hash(file.camera.P, K, undistortion.distortion)
