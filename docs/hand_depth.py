"""Makes `hand_depth.png`, the picture of the README, from what the demo has written.

    jaxfilters demo --out jaxfilters-demo && python docs/hand_depth.py jaxfilters-demo

Above: frames of the synthetic recording with the estimated skeleton. Below: the hand model in the estimated pose.
"""

import json
import sys
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.skeleton import anatomical_hand, forward_kinematics
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.trackers.hand_depth.drawing import color_depth, draw_skeleton
from jaxfilters.trackers.hand_depth.tracker import synthetic_sequence

FRAMES = (0, 45, 90, 120)
REACH = 0.115
"""Metres about the middle of the joints that a tile shows."""
TILE = 600
"""Pixels along a side; the picture is half as large, so that lines are smooth."""
LIGHT = np.array([-0.4, -0.5, -0.77])


def main(results: Path) -> None:
    """Draw the frames of the demo's results and write the picture beside this file."""
    seed = json.loads((results / "report.json").read_text())["config"]["seed"]
    sequence, _ = synthetic_sequence(seed)
    with np.load(results / "track.npz") as track:
        columns = [_column(sequence.camera, sequence[i], track["pose"][i], track["joints"][i]) for i in FRAMES]
    picture = cv2.resize(np.concatenate(columns, axis=1), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(Path(__file__).with_suffix(".png")), picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _column(camera: Pinhole, depth: np.ndarray, pose: np.ndarray, joints: np.ndarray) -> np.ndarray:
    center = joints.mean(axis=0)
    near, far = center[2] - REACH, center[2] + REACH
    side = 2 * REACH * float(camera.focal[0]) / center[2]
    corner = np.asarray(camera.project(jnp.asarray(center))) - side / 2
    zoom = TILE / side
    closer = Pinhole(camera.focal * zoom, (camera.center + 0.5 - corner) * zoom - 0.5, (TILE, TILE))
    to_tile = np.float32([[zoom, 0, (0.5 - corner[0]) * zoom - 0.5], [0, zoom, (0.5 - corner[1]) * zoom - 0.5]])
    observed = cv2.warpAffine(color_depth(depth, near, far), to_tile, (TILE, TILE), flags=cv2.INTER_NEAREST)
    draw_skeleton(observed, closer, joints)
    return np.concatenate([observed, _model(closer, pose, joints, near, far)])


def _model(camera: Pinhole, pose: np.ndarray, joints: np.ndarray, near: float, far: float) -> np.ndarray:
    """The capsules of the pose, in the colours of their depth and lit from the upper left."""
    palm = np.linalg.norm(joints[9] - joints[0])
    average = forward_kinematics(jnp.asarray(pose), anatomical_hand()).joints
    scale = palm / np.linalg.norm(average[9] - average[0])
    capsules = forward_kinematics(jnp.asarray(pose), anatomical_hand().scaled(jnp.asarray(scale))).capsules
    depth = np.asarray(render_capsules(camera, capsules))
    points = np.asarray(
        camera.unproject(jnp.stack(jnp.meshgrid(*[jnp.arange(float(TILE))] * 2), -1), jnp.asarray(depth))
    )
    with np.errstate(invalid="ignore"):
        normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        light = 0.35 + 0.65 * np.clip(normals @ LIGHT, 0, 1)
    light = np.where(np.isfinite(light), light, 0.5)[..., None]
    colors = color_depth(depth, near, far)
    background = color_depth(np.full_like(depth, far), near, far)
    return np.where(np.isfinite(depth)[..., None], colors * light, background).astype(np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
