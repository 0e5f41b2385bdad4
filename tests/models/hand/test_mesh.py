import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfilters.math.lie import quaternion_to_matrix
from jaxfilters.models.hand.mesh import capsule_mesh, hand_mesh, part_meshes, pose_vertices, posed_trimesh
from jaxfilters.models.hand.parts import part_transforms
from jaxfilters.models.hand.skeleton import PART_NAMES, forward_kinematics, hand_geometry, mirrored, open_palm

pytestmark = pytest.mark.usefixtures("x64")
SEEDS = range(3)
TESSELLATIONS = {608: dict(), 1520: dict(sections=10, latitudes=1)}
# Rounding of a few dozen float64 operations on lengths below a metre.
EXACT = 1e-14


@pytest.mark.system
@pytest.mark.parametrize("seed", SEEDS)
def test_part_frames_match_homogeneous_matrices(seed, random_pose, phalanx_frames_oracle):
    pose = random_pose(np.random.default_rng(seed))
    expected = phalanx_frames_oracle(pose)[:, :3].reshape(15, 4, 4)
    T_camera_part = part_transforms(jnp.asarray(pose), hand_geometry())
    rotations = jax.vmap(quaternion_to_matrix)(T_camera_part.rotation)
    np.testing.assert_allclose(rotations[:15], expected[:, :3, :3], atol=EXACT)
    np.testing.assert_allclose(T_camera_part.translation[:15], expected[:, :3, 3], atol=EXACT)
    palm = rotations[15]
    np.testing.assert_allclose(palm @ np.array([0.003, -0.095, 0]) + pose[:3], expected[6, :3, 3], atol=EXACT)


@pytest.mark.system
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("side", ["right", "left"])
def test_part_frames_carry_the_capsules(seed, side, random_pose):
    geometry = hand_geometry() if side == "right" else mirrored(hand_geometry())
    pose = jnp.asarray(random_pose(np.random.default_rng(seed)))
    capsules = forward_kinematics(pose, geometry).capsules
    T_camera_part = part_transforms(pose, geometry)
    rotations = jax.vmap(quaternion_to_matrix)(T_camera_part.rotation)
    along = -geometry.lengths.reshape(15, 1) * rotations[:15, :, 1]
    np.testing.assert_allclose(T_camera_part.translation[:15] + along, capsules.end[:15], atol=EXACT)


@pytest.mark.system
@pytest.mark.parametrize("triangles", TESSELLATIONS)
def test_number_of_triangles_and_one_closed_convex_solid_for_every_part(triangles):
    mesh = hand_mesh(hand_geometry(), **TESSELLATIONS[triangles])
    assert mesh.faces.shape == (triangles, 3)
    parts = part_meshes(mesh)
    assert len(parts) == len(PART_NAMES)
    assert all(part.is_watertight and part.is_convex and part.is_winding_consistent for part in parts)
    assert posed_trimesh(open_palm(jnp.array([0.0, 0.09, 0.7])), mesh, hand_geometry()).is_watertight


@pytest.mark.parametrize(("sections", "latitudes"), [(3, 0), (8, 0), (10, 1), (16, 4)])
def test_capsule_mesh_has_the_volume_of_the_capsule(sections, latitudes):
    start, end, radius = np.array([0.01, 0.02, 0.5]), np.array([0.03, -0.02, 0.53]), 0.011
    mesh = capsule_mesh(start, end, radius, sections=sections, latitudes=latitudes)
    assert len(mesh.faces) == 4 * sections * (1 + latitudes)
    length = np.linalg.norm(end - start)
    assert mesh.volume == pytest.approx(np.pi * radius**2 * length + 4 / 3 * np.pi * radius**3, rel=1e-9)
    np.testing.assert_allclose(mesh.center_mass, (start + end) / 2, atol=1e-12)


def test_a_fine_capsule_mesh_approaches_the_capsule():
    start, end, radius = np.zeros(3), np.array([0.0, -0.04, 0.0]), 0.01
    mesh = capsule_mesh(start, end, radius, sections=64, latitudes=15)
    along = np.clip(mesh.vertices @ (end - start) / 0.04**2, 0, 1)[:, None]
    distance = np.linalg.norm(mesh.vertices - along * (end - start), axis=1)
    # Volume error of a 64-gon: 1 - sin(2 pi / 64) / (2 pi / 64) = 1.6e-3, half of it in the radius.
    np.testing.assert_allclose(distance, radius, rtol=2e-3)


@pytest.mark.system
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("side", ["right", "left"])
def test_posed_vertices_surround_their_capsules(seed, side, random_pose):
    geometry = hand_geometry() if side == "right" else mirrored(hand_geometry())
    pose = jnp.asarray(random_pose(np.random.default_rng(seed)))
    mesh = hand_mesh(geometry, sections=32, latitudes=7)
    vertices = np.asarray(pose_vertices(pose, mesh, geometry))
    capsules = jax.tree.map(np.asarray, forward_kinematics(pose, geometry).capsules)
    start, end, radius = (leaf[np.asarray(mesh.part)] for leaf in (capsules.start, capsules.end, capsules.radius))
    axis = end - start
    along = np.clip(np.sum((vertices - start) * axis, 1) / np.sum(axis**2, 1), 0, 1)[:, None]
    # Volume error of a 32-gon is 6.4e-3, that of the cap's 8 x 32 facets below 1.5e-2; half of it in the radius.
    np.testing.assert_allclose(np.linalg.norm(vertices - start - along * axis, axis=1), radius, rtol=1e-2)


def test_posed_mesh_can_be_exported_and_read_again(tmp_path):
    pose = open_palm(jnp.array([0.0, 0.09, 0.7]))
    posed_trimesh(pose, hand_mesh(hand_geometry()), hand_geometry()).export(tmp_path / "hand.ply")
    again = trimesh.load_mesh(tmp_path / "hand.ply")
    assert len(again.faces) == 608
    # Palm to the camera, fingers up: from the middle tip at -100 mm to the metacarpals' ends at 76 mm, and a radius
    # more at both ends, which volume-preserving tessellation stretches by some percent.
    np.testing.assert_allclose(again.bounds[:, 1], [-0.1 - 0.0075, 0.076 + 0.013], atol=0.2 * 0.013)


@pytest.mark.parametrize(("options", "message"), [(dict(sections=2), "sections"), (dict(latitudes=-1), "latitudes")])
def test_bad_tessellations_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        hand_mesh(hand_geometry(), **options)
