"""Glasses and beards of modelled faces: closed rims, the law of reflection, and nothing else that changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.rig import monocular
from jaxfilters.models.synthetic.face_motion import MONOCULAR_PLACE_MM
from jaxfilters.models.synthetic.ict_face import read_ict
from jaxfilters.models.synthetic.ict_sequence import ict_sequence
from jaxfilters.models.synthetic.ict_worn import LENS_RADIUS_MM, WINDOW, Glasses, make_glasses, reflections

LENSES = np.array([[-32.0, -20, -30], [32, -20, -30]])


def test_lenses_reflect_the_window_into_the_camera():
    """The ray to the camera, mirrored at the sphere's normal where the light is drawn, goes to the window."""
    nothing = jnp.zeros((0, 3)), jnp.zeros((0, 3), jnp.int32)
    glasses = Glasses(*nothing, jnp.asarray(LENSES), jnp.asarray([24.0, 17.0]))
    draw, shown = np.random.default_rng(0), 0
    for _ in range(60):
        pose = np.concatenate([[*draw.uniform(-80, 80, 2), 600], draw.uniform(-0.5, 0.5, 3)])
        corners = np.asarray(reflections(glasses, jnp.asarray(pose, float))).reshape(2, 4, 3)
        middle = corners.mean(axis=1) - LENSES
        if middle[0, 2] > 0:
            continue
        shown += 1
        assert np.all(np.abs(middle[:, :2]) < [24, 17])
        across = middle[0, :2] / LENS_RADIUS_MM
        turned = Rotation.from_euler("ZYX", pose[3:])
        normal = turned.apply([*across, -np.sqrt(1 - across @ across)])
        to_camera = -pose[:3] / np.linalg.norm(pose[:3])
        mirrored = 2 * (normal @ to_camera) * normal - to_camera
        np.testing.assert_allclose(mirrored, np.array(WINDOW) / np.linalg.norm(WINDOW), atol=1e-4)
    assert 5 < shown < 55


@pytest.fixture(scope="module")
def ict(data_dir):
    return read_ict(data_dir / "ict_face_model")


def before(ict, **worn):
    rig = monocular(Pinhole.from_intrinsics(400.0, (159.5, 119.5), (240, 320)))
    return ict_sequence(jax.random.key(1), ict, np.array([[*MONOCULAR_PLACE_MM, 0, 0.2, 0.0]]), rig=rig, **worn)


@pytest.mark.system
@pytest.mark.data
def test_rims_are_closed_and_lie_before_the_eyes(ict):
    for number in range(5):
        made = before(ict)
        glasses = make_glasses(jax.random.key(number), ict, made.person)
        mesh = trimesh.Trimesh(np.asarray(glasses.points), np.asarray(glasses.faces), process=False)
        # The bridge and the temples are tubes with open ends.
        parts = mesh.split(only_watertight=True, repair=False)
        assert len(parts) == 2
        for part, lens in zip(sorted(parts, key=lambda part: part.centroid[0]), glasses.lenses, strict=True):
            # Positive where triangles are wound as seen from outside.
            assert part.volume > 0
            np.testing.assert_allclose(part.centroid, lens, atol=1.0)
        eyes = np.asarray(made.person.neutral)[np.asarray(ict.landmarks)[36:48]]
        assert np.asarray(glasses.lenses)[:, 2].max() < eyes[:, 2].min()


@pytest.mark.system
@pytest.mark.data
def test_what_is_worn_changes_nothing_elsewhere(ict):
    """Glasses between forehead and nose, a beard below the nose and not on the lips; the truth stays."""
    bare, glasses, beard = before(ict), before(ict, has_glasses=True), before(ict, beard=0.9)
    for worn in (glasses, beard):
        np.testing.assert_array_equal(worn.uv68, bare.uv68)
        np.testing.assert_array_equal(worn.poses, bare.poses)
    uv = bare.uv68[0, 0]
    images = [made.frames(0, 1)[0, 0].astype(int) for made in (bare, glasses, beard)]
    changed = [np.argwhere(np.abs(image - images[0]) > 12) for image in images[1:]]
    assert all(len(where) > 100 for where in changed)
    rows = [where[:, 0] for where in changed]
    brow, tip, nostrils = uv[17:27, 1].min(), uv[33, 1], uv[31:36, 1].min()
    assert rows[0].min() > brow - 10
    assert rows[0].max() < tip
    assert rows[1].min() > nostrils - 2
    lips = np.round(uv[[61, 62, 63, 65, 66, 67]]).astype(int)
    np.testing.assert_allclose(images[2][lips[:, 1], lips[:, 0]], images[0][lips[:, 1], lips[:, 0]], atol=12)
