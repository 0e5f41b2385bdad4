"""How heads turn by MediaPipe's face mesh, to compare a track with that knows nothing of it."""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.trackers.head.common.mesh import MeshDetector

EVERY = 4
"""Frames from one that the mesh is fitted to to the next."""
ROUNDS = 4
"""Alignments of all frames to their mean, which changes with them."""
AXES = ("roll", "yaw", "pitch")


def agreement(
    name: str,
    images: UInt8[np.ndarray, "t rows cols"],
    poses: Float[np.ndarray, "t 6"],
    is_tracked: Bool[np.ndarray, " t"],
) -> dict[str, Metric]:
    """Correlation and root mean square difference of the changes of roll, yaw and pitch between a track and the mesh.

    Args:
        name: Of the video.
        images: Grey.
        poses: Of the track: millimetres and radians.
        is_tracked: Where they count.

    Raises:
        ImportError: without MediaPipe.
    """
    detector = MeshDetector()
    frames = [int(i) for i in np.flatnonzero(is_tracked)[::EVERY]]
    found = [(i, mesh) for i in frames if (mesh := detector.solid(images[i])) is not None]
    where = np.array([i for i, _ in found])
    mesh_turns = turns(np.stack([mesh for _, mesh in found]))
    # Rz(roll) Ry(yaw) Rx(pitch), as the poses have them.
    track_turns = Rotation.from_euler("ZYX", poses[where, 3:])
    return {f"{name}_mesh_{key}": value for key, value in compared(track_turns, mesh_turns).items()} | {
        f"{name}_mesh_frames": Metric(float(len(where)), "", "higher")
    }


def turns(meshes: Float[np.ndarray, "t V 3"]) -> Rotation:
    """Of each mesh from their mean, by the half of the vertices that moves least beside the head.

    Args:
        meshes: The same vertices in each frame, of any place and size.
    """
    centred = meshes - meshes.mean(axis=1, keepdims=True)
    centred = centred / np.sqrt(np.mean(np.square(centred), axis=(1, 2), keepdims=True))
    mean, weights = centred[0], np.ones(centred.shape[1])
    rotation = Rotation.identity()
    for _ in range(ROUNDS):
        rotation = _aligned(centred, mean, weights)
        back = np.einsum("tij,tvi->tvj", rotation.as_matrix(), centred)
        mean = back.mean(axis=0)
        apart = np.mean(np.sum(np.square(back - mean), axis=-1), axis=0)
        weights = (apart <= np.median(apart)).astype(float)
    return rotation


def compared(one: Rotation, other: Rotation) -> dict[str, Metric]:
    """How two courses of rotations agree, each about its own mean; angles about the axes of the camera.

    The slope is how much the first turns for each degree of the other.
    """
    first, second = (np.degrees((turn * turn.mean().inv()).as_euler("ZYX")) for turn in (one, other))
    metrics: dict[str, Metric] = {}
    for i, axis in enumerate(AXES):
        apart = first[:, i] - second[:, i]
        metrics |= {
            f"{axis}_correlation": Metric(float(np.corrcoef(first[:, i], second[:, i])[0, 1]), "", "higher"),
            f"{axis}_rms": Metric(float(np.std(apart)), "deg", "lower"),
            f"{axis}_range": Metric(float(np.ptp(second[:, i])), "deg", "higher"),
            f"{axis}_slope": Metric(_slope(second[:, i], first[:, i]), "", 1.0),
        }
    return metrics


def _slope(x: Float[np.ndarray, " t"], y: Float[np.ndarray, " t"]) -> float:
    """Slope of y over x by total least squares: the first principal axis of the points (K. Pearson 1901).

    Ordinary least squares takes x for exact, and its slope shrinks with the errors of x. Here x and y are two estimates
    of one angle that both have errors; the two regressions of y on x and of x on y enclose this slope.
    """
    (x_variance, both), (_, y_variance) = np.cov(x, y)
    return float(np.tan(0.5 * np.arctan2(2 * both, x_variance - y_variance)))


def _aligned(shapes: np.ndarray, mean: np.ndarray, weights: np.ndarray) -> Rotation:
    """Of the mean to each shape (W. Kabsch 1976)."""
    w = weights[:, None] / weights.sum()
    source, target = mean - np.sum(w * mean, axis=0), shapes - np.sum(w * shapes, axis=1, keepdims=True)
    U, _, Vt = np.linalg.svd(np.einsum("vi,tvj->tij", w * source, target))
    proper = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    flip = np.stack([np.ones_like(proper), np.ones_like(proper), proper], axis=-1)
    return Rotation.from_matrix(np.einsum("tji,tj,tkj->tik", Vt, flip, U))
