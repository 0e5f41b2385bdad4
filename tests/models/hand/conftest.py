import jax
import numpy as np
import pytest

BASES = [(22, -22, -8), (24, -92, 0), (3, -95, 0), (-17, -88, 0), (-35, -78, 0)]
LENGTHS = [(46, 32, 27), (42, 24, 20), (46, 28, 21), (42, 27, 21), (33, 20, 19)]


def rotation(axis, angle):
    """4 x 4 rotation about a coordinate axis by Rodrigues' formula."""
    K = np.cross(np.eye(3), np.eye(3)["xyz".index(axis)])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return T


def translation(*offset):
    T = np.eye(4)
    T[:3, 3] = offset
    return T


def wrist_transform(pose):
    """4 x 4, camera from palm, by the sandwich product of quaternions written as a 4 x 4 matrix."""
    w, x, y, z = pose[3:7] / np.linalg.norm(pose[3:7])
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    right = np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    T = np.eye(4)
    T[:3, :3] = (left @ right)[1:, 1:]
    T[:3, 3] = pose[:3]
    return T


def phalanx_frames(pose):
    """(5, 4) homogeneous frames, camera from phalanx 1-3 and tip, by the chains of the specification (metres)."""
    wrist, angles = wrist_transform(pose), pose[7:]
    frames = []
    for digit, (base, lengths) in enumerate(zip(BASES, LENGTHS, strict=True)):
        step = [translation(0, -length / 1000, 0) for length in lengths]
        T = wrist @ translation(*np.array(base) / 1000)
        if digit == 0:
            cmc, mcp, spread = angles[:3]
            turns = [
                rotation("z", np.pi / 4) @ rotation("x", np.pi / 9) @ rotation("y", np.pi / 3) @ rotation("x", cmc),
                rotation("z", spread) @ rotation("x", mcp),
                rotation("x", mcp / 2),
            ]
        else:
            mcp, spread, pip = angles[3 * digit : 3 * digit + 3]
            turns = [rotation("z", spread) @ rotation("x", mcp), rotation("x", pip), rotation("x", pip / 2)]
        chain = []
        for turn, forward in zip(turns, step, strict=True):
            chain.append(T @ turn)
            T = chain[-1] @ forward
        frames.append([*chain, T])
    return np.array(frames)


@pytest.fixture
def phalanx_frames_oracle():
    return phalanx_frames


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def random_pose():
    """Draws a pose anywhere near the camera: every rotation, angles well beyond their limits."""

    def draw(rng):
        position = rng.uniform((-0.3, -0.3, 0.4), (0.3, 0.3, 1.0))
        quaternion = rng.normal(size=4)
        return np.concatenate([position, quaternion / np.linalg.norm(quaternion), rng.uniform(-2, 2, 15)])

    return draw
