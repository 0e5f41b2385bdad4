import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def homogeneous(rotation, offset):
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = offset
    return T


def finger_chains(x, layout, wrist_pivot):
    """(F, 4, 3) joints in the palm frame by chains of homogeneous frames, each link along its own x."""
    width, height, _ = x[layout.palm]
    still = Rotation.identity()
    chains = []
    for i in range(layout.num_fingers):
        abduction, *flexions = x[layout.angles][4 * i : 4 * i + 4]
        lengths = x[layout.lengths][3 * i : 3 * i + 3]
        share = layout.base_shares[i]
        base = homogeneous(still, (share[0] * height, 0, share[1] * width))
        frame = homogeneous(Rotation.from_rotvec((0, 0, 0) if layout.frames is None else layout.frames[i]), (0, 0, 0))
        spread = homogeneous(Rotation.from_rotvec((0, abduction, 0)), (0, 0, 0))
        T = spread @ base @ frame if wrist_pivot else base @ frame @ spread
        chain = [T[:3, 3]]
        for flexion, length in zip(flexions, lengths, strict=True):
            T = T @ homogeneous(Rotation.from_rotvec((0, 0, flexion)), (0, 0, 0)) @ homogeneous(still, (length, 0, 0))
            chain.append(T[:3, 3])
        chains.append(chain)
    return np.array(chains)


@pytest.fixture
def finger_chains_oracle():
    return finger_chains


@pytest.fixture
def random_state():
    """Draws states in any rotation, bent any way, of a hand of some 80 pixels, or of 80 mm in front of a camera."""

    def draw(rng, layout):
        in_space = layout.position_size == 3
        position = rng.uniform((-0.1, -0.1, 0.5), (0.1, 0.1, 0.9)) if in_space else rng.uniform(-50, 50, 2)
        q = rng.normal(size=4)
        q *= rng.uniform(0.8, 1.2) / np.linalg.norm(q)
        angles = rng.uniform(-1.2, 1.2, 4 * layout.num_fingers)
        shape = np.concatenate([rng.uniform(25, 70, 3 * layout.num_fingers), [60, 80, 20] * rng.uniform(0.8, 1.2, 3)])
        rates = 0.1 * rng.normal(size=layout.num_moving)
        return np.concatenate([position, q, angles, rates, shape * (1e-3 if in_space else 1)])

    return draw
