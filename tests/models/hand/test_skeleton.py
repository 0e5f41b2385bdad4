from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.models.hand.skeleton import (
    ANGLE_LIMITS,
    JOINT_NAMES,
    PART_NAMES,
    anatomical_hand,
    check_geometry,
    forward_kinematics,
    hand_center,
    hand_geometry,
    local,
    mirrored,
    open_palm,
    retract,
)

pytestmark = pytest.mark.usefixtures("x64")
SEEDS = range(5)
# Rounding of a dozen float64 operations on lengths below a metre.
EXACT = 1e-14


def joints_of(pose, geometry=None):
    return np.asarray(forward_kinematics(jnp.asarray(pose), geometry or hand_geometry()).joints)


def mirror_of(pose):
    """The pose seen in a mirror: x -> -x, R -> M R M; angles are anatomical and stay."""
    return pose * np.array([-1, 1, 1, 1, 1, -1, -1] + [1] * 15)


GOLDEN_MM = {
    "wrist": (0, 90, 700),
    "thumb_1": (22, 68, 692),
    "thumb_2": (52.6, 37.4, 676.3),
    "thumb_3": (73.8, 16.2, 665.3),
    "thumb_4": (91.8, -1.8, 656.1),
    "index_1": (24, -2, 700),
    "index_2": (24, -44, 700),
    "index_3": (24, -68, 700),
    "index_4": (24, -88, 700),
    "middle_4": (3, -100, 700),
    "ring_4": (-17, -88, 700),
    "little_4": (-35, -60, 700),
}


@pytest.mark.system
@pytest.mark.parametrize("name", GOLDEN_MM)
@pytest.mark.parametrize("x64_on", [True, False])
def test_golden_joints_of_the_open_palm(name, x64_on):
    with jax.enable_x64(x64_on):
        joints = joints_of(open_palm(jnp.array([0, 0.09, 0.7])))
    # The specification prints one decimal of a millimetre.
    np.testing.assert_allclose(1000 * joints[JOINT_NAMES.index(name)], GOLDEN_MM[name], atol=0.05)


def test_bent_index_comes_closer_and_couples_its_last_joint():
    pose = open_palm(jnp.array([0, 0.09, 0.7])).at[10].set(0.5).at[12].set(0.8)
    index = joints_of(pose)[5:9]
    assert 1000 * (0.7 - index[3, 2]) == pytest.approx(63.09, abs=0.005)
    bones = np.diff(index, axis=0)
    bones /= np.linalg.norm(bones, axis=1, keepdims=True)
    np.testing.assert_allclose(np.arccos(np.sum(bones[1:] * bones[:-1], axis=1)), [0.8, 0.4], atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_joints_match_homogeneous_matrices(seed, random_pose, phalanx_frames_oracle):
    pose = random_pose(np.random.default_rng(seed))
    expected = phalanx_frames_oracle(pose)[..., :3, 3].reshape(20, 3)
    joints = joints_of(pose)
    np.testing.assert_allclose(joints[1:], expected, atol=EXACT)
    np.testing.assert_array_equal(joints[0], pose[:3])


@pytest.mark.system
@pytest.mark.parametrize("seed", SEEDS)
def test_capsules_lie_on_the_bones_in_the_stated_order(seed, random_pose):
    geometry = hand_geometry()
    kinematics = forward_kinematics(jnp.asarray(random_pose(np.random.default_rng(seed))), geometry)
    joints, capsules = kinematics.joints, kinematics.capsules
    for part, name in enumerate(PART_NAMES[:15]):
        digit, _, number = name.split("_")
        first = JOINT_NAMES.index(f"{digit}_{number}")
        np.testing.assert_array_equal(capsules.start[part], joints[first])
        np.testing.assert_array_equal(capsules.end[part], joints[first + 1])
        assert capsules.radius[part] == geometry.radii.reshape(15)[part]
    for part, name in enumerate(PART_NAMES[15:], start=15):
        np.testing.assert_array_equal(capsules.end[part], joints[JOINT_NAMES.index(name.replace("metacarpal", "1"))])
        assert capsules.radius[part] == geometry.metacarpal_radius
    lengths = np.linalg.norm(geometry.bases[1:] - geometry.metacarpal_starts, axis=1)
    np.testing.assert_allclose(np.linalg.norm(capsules.end[15:] - capsules.start[15:], axis=1), lengths, atol=EXACT)


@pytest.mark.parametrize("seed", SEEDS)
def test_bone_lengths_do_not_depend_on_the_pose(seed, random_pose):
    chains = joints_of(random_pose(np.random.default_rng(seed)))[1:].reshape(5, 4, 3)
    lengths = np.linalg.norm(np.diff(chains, axis=1), axis=2)
    np.testing.assert_allclose(lengths, hand_geometry().lengths, rtol=1e-9)


@pytest.mark.system
@pytest.mark.parametrize("seed", SEEDS)
def test_moving_the_wrist_rigidly_moves_all_joints(seed, random_pose):
    rng = np.random.default_rng(seed)
    pose, motion = random_pose(rng), random_pose(rng)
    w, x, y, z = motion[3:7]
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    right = np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    R = (left @ right)[1:, 1:]
    moved = np.concatenate([R @ pose[:3] + motion[:3], left @ pose[3:7], pose[7:]])
    np.testing.assert_allclose(joints_of(moved), joints_of(pose) @ R.T + motion[:3], atol=EXACT)


@pytest.mark.parametrize("seed", SEEDS)
def test_left_hand_is_the_right_hand_in_a_mirror(seed, random_pose):
    pose = random_pose(np.random.default_rng(seed))
    left = joints_of(mirror_of(pose), mirrored(hand_geometry()))
    np.testing.assert_allclose(left, joints_of(pose) * (-1, 1, 1), atol=EXACT)


def test_left_thumb_of_an_open_palm_is_on_the_left():
    joints = joints_of(open_palm(jnp.array([0.0, 0.0, 0.7])), mirrored(hand_geometry()))
    assert joints[JOINT_NAMES.index("thumb_4"), 0] < joints[JOINT_NAMES.index("little_4"), 0]


@pytest.mark.system
def test_scale_stretches_the_hand_from_the_wrist(random_pose):
    pose = random_pose(np.random.default_rng(0))
    scaled = forward_kinematics(jnp.asarray(pose), hand_geometry().scaled(1.2))
    plain = forward_kinematics(jnp.asarray(pose), hand_geometry())
    np.testing.assert_allclose(scaled.joints - pose[:3], 1.2 * (plain.joints - pose[:3]), atol=EXACT)
    np.testing.assert_allclose(scaled.capsules.radius, 1.2 * plain.capsules.radius, atol=EXACT)
    slope = jax.jacfwd(lambda s: forward_kinematics(jnp.asarray(pose), hand_geometry().scaled(s)).joints)(1.0)
    np.testing.assert_allclose(slope, plain.joints - pose[:3], atol=EXACT)


def test_wrist_to_middle_tip_is_190_mm():
    joints = joints_of(open_palm(jnp.zeros(3)))
    assert np.linalg.norm(joints[JOINT_NAMES.index("middle_4")] - joints[0]) == pytest.approx(0.190, abs=1e-4)


def test_length_of_the_quaternion_does_not_matter(random_pose):
    pose = random_pose(np.random.default_rng(3))
    stretched = pose.copy()
    stretched[3:7] *= 1.7
    np.testing.assert_allclose(joints_of(stretched), joints_of(pose), atol=EXACT)


def test_hand_center_is_90_mm_along_the_fingers_and_scales():
    np.testing.assert_allclose(hand_center(open_palm(jnp.array([0.0, 0.09, 0.7]))), [0, 0, 0.7], atol=EXACT)
    np.testing.assert_allclose(hand_center(open_palm(jnp.zeros(3)), 2.0), [0, -0.18, 0], atol=EXACT)


@pytest.mark.parametrize("seed", SEEDS)
def test_local_inverts_retract(seed, random_pose):
    rng = np.random.default_rng(seed)
    pose = jnp.asarray(random_pose(rng))
    # Rotation vectors shorter than half a turn.
    delta = jnp.asarray(rng.uniform(-1, 1, 21))
    moved = retract(pose, delta)
    np.testing.assert_allclose(local(pose, moved), delta, atol=1e-13)
    assert np.linalg.norm(moved[3:7]) == pytest.approx(1, abs=1e-14)


def test_retract_turns_about_the_axes_of_the_palm():
    turned = open_palm(jnp.zeros(3)).at[3:7].set(jnp.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))
    # The palm's x axis is the camera's y axis here; a quarter turn about it sends the fingers (camera +x) to camera -z.
    fingers = joints_of(retract(turned, jnp.zeros(21).at[3].set(np.pi / 2)))[JOINT_NAMES.index("middle_1")]
    assert fingers[2] == pytest.approx(-0.095, abs=1e-12)


@pytest.mark.system
def test_vmap_over_the_last_axis_equals_a_loop(random_pose):
    rng = np.random.default_rng(0)
    poses = jnp.asarray(np.stack([random_pose(rng) for _ in range(7)], axis=-1))
    geometry = hand_geometry()
    mapped = jax.jit(jax.vmap(lambda pose: forward_kinematics(pose, geometry), in_axes=-1, out_axes=-1))(poses)
    for i in range(7):
        single = forward_kinematics(poses[:, i], geometry)
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[..., i], b, atol=EXACT), mapped, single)


@pytest.mark.system
def test_derivative_is_that_of_central_differences(random_pose):
    pose = jnp.asarray(random_pose(np.random.default_rng(1)))
    geometry = hand_geometry()

    def joints(delta):
        return forward_kinematics(retract(pose, delta), geometry).joints

    slope = jax.jacfwd(joints)(jnp.zeros(21))
    step = 1e-5
    # Error of a central difference: step^2 / 6 times third derivatives below a metre, and rounding 1e-16 / step.
    for i in range(21):
        delta = jnp.zeros(21).at[i].set(step)
        np.testing.assert_allclose(slope[..., i], (joints(delta) - joints(-delta)) / (2 * step), atol=1e-10)


def test_limits_follow_the_order_of_the_angles():
    degrees = np.rad2deg(ANGLE_LIMITS)
    np.testing.assert_allclose(degrees[:3], [(-20, 60), (-5, 55), (-30, 30)])
    for finger in range(4):
        np.testing.assert_allclose(degrees[3 + 3 * finger : 6 + 3 * finger], [(-10, 90), (-20, 20), (0, 105)])


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("lengths", jnp.zeros((5, 3)), "lengths must be positive"),
        ("radii", -jnp.ones((5, 3)), "radii must be positive"),
        ("radii", jnp.full((5, 3), jnp.nan), "radii must be positive"),
        ("metacarpal_radius", jnp.array(0.0), "metacarpal_radius must be positive"),
        ("bases", jnp.zeros((4, 3)), r"bases must be \(5, 3\)"),
    ],
)
def test_bad_geometry_is_refused(field, value, message):
    with pytest.raises(ValueError, match=message):
        check_geometry(replace(hand_geometry(), **{field: value}))


def test_the_default_geometry_is_accepted():
    check_geometry(hand_geometry())


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_tips_of_the_anatomical_hand_are_on_its_skin_and_bones_are_as_measured(scale, random_pose):
    hand = anatomical_hand().scaled(scale)
    check_geometry(hand)
    found = forward_kinematics(jnp.asarray(random_pose(np.random.default_rng(3))), hand)
    chains = np.asarray(found.joints[1:]).reshape(5, 4, 3)
    ends, radii = np.asarray(found.capsules.end)[2:15:3], np.asarray(found.capsules.radius)[2:15:3]
    beyond = chains[:, 3] - ends
    np.testing.assert_allclose(np.linalg.norm(beyond, axis=1), radii, atol=EXACT)
    np.testing.assert_allclose(np.cross(beyond, chains[:, 3] - chains[:, 2]), 0, atol=EXACT)
    # Buryanov and Kotiuk 2010, the middle finger: three phalanges and 3.95 mm of soft tissue, millimetres.
    bones = 1000 * np.linalg.norm(np.diff(chains, axis=1), axis=2) / scale
    np.testing.assert_allclose(bones[2], [44.63, 26.33, 17.40 + 3.95], atol=1e-9)
