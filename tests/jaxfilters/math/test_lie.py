import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfilters.math import lie

ANGLES = [0.0, 1e-9, 1e-5, 9.9e-3, 1.01e-2, 0.3, 2.0, np.pi - 1e-3, np.pi - 1e-9, np.pi]


of_tangent = jax.jit(jax.jacfwd(lambda q, d: lie.so3_local(q, lie.so3_retract(q, d)), argnums=1))


@jax.jit
def derivatives(rotvec, q):
    """Of the exponential and of the logarithm, forwards and backwards."""
    return [(of(lie.so3_exp)(rotvec), of(lie.so3_log)(q)) for of in (jax.jacfwd, jax.jacrev)]


def scalar_first(rotation):
    return np.roll(rotation.as_quat(), 1)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def axes(rng):
    axis = rng.normal(size=3)
    return [axis / np.linalg.norm(axis), np.array([0.0, 0.0, 1.0])]


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_agree_with_scipy(x64, rng, angle):
    for axis in axes(rng):
        rotation = Rotation.from_rotvec(angle * axis)
        q = lie.so3_exp(jnp.asarray(angle * axis))
        np.testing.assert_allclose(abs(q @ scalar_first(rotation)), 1, atol=1e-15)
        np.testing.assert_allclose(lie.quaternion_to_matrix(q), rotation.as_matrix(), atol=4e-16)
        for sign in (1.0, -1.0):
            logarithm = lie.so3_log(sign * q)
            # At half a turn both vectors are the rotation; compare rotations there, vectors elsewhere.
            np.testing.assert_allclose(
                lie.quaternion_to_matrix(lie.so3_exp(logarithm)), rotation.as_matrix(), atol=2e-15
            )
            if angle < 3:
                np.testing.assert_allclose(logarithm, angle * axis, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_in_float32_is_right_to_rounding(rng, angle):
    for axis in axes(rng):
        rotvec = jnp.asarray(angle * axis, jnp.float32)
        turned = lie.quaternion_to_matrix(lie.so3_exp(lie.so3_log(lie.so3_exp(rotvec))))
        np.testing.assert_allclose(turned, Rotation.from_rotvec(angle * axis).as_matrix(), atol=2e-6)


@pytest.mark.system
@pytest.mark.parametrize("angle", ANGLES)
def test_derivatives_are_finite_and_right_at_every_angle(x64, rng, angle):
    rotvec = jnp.asarray(angle * axes(rng)[0])
    # exp after log is the identity on unit quaternions, log after exp on vectors shorter than half a turn.
    q = lie.so3_exp(rotvec)
    np.testing.assert_allclose(of_tangent(q, jnp.zeros(3)), np.eye(3), atol=1e-12)
    for d_exp, d_log in derivatives(rotvec, q):
        assert np.isfinite(d_exp).all()
        assert np.isfinite(d_log).all()
        if angle < 3:
            np.testing.assert_allclose(d_log @ d_exp, np.eye(3), atol=1e-9)


@pytest.mark.system
def test_product_matrices_and_inverse_agree_with_scipy(x64, rng):
    a, b = Rotation.random(50, random_state=1), Rotation.random(50, random_state=2)
    p, q = jnp.asarray(scalar_first(a[0])), jnp.asarray(scalar_first(b[0]))
    np.testing.assert_allclose(
        lie.quaternion_to_matrix(lie.quaternion_multiply(p, q)), (a[0] * b[0]).as_matrix(), atol=1e-15
    )
    for rotation in [*a, *(Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3)), Rotation.identity()]:
        back = lie.quaternion_from_matrix(jnp.asarray(rotation.as_matrix()))
        np.testing.assert_allclose(abs(back @ scalar_first(rotation)), 1, atol=1e-14)
        assert back[0] >= 0
        gradient = jax.jacrev(lie.quaternion_from_matrix)(jnp.asarray(rotation.as_matrix()))
        assert np.isfinite(gradient).all()


def test_normalising_survives_tiny_quaternions_and_reports_zero_as_nan():
    tiny = jnp.array([0.0, 3e-25, 0.0, 4e-25], jnp.float32)
    np.testing.assert_allclose(lie.quaternion_normalize(tiny), [0, 0.6, 0, 0.8], rtol=1e-6)
    assert np.isnan(lie.quaternion_normalize(jnp.zeros(4))).all()
    q = jnp.array([1.0, -2.0, 0.5, 3.0])
    # The direction does not change along q itself.
    np.testing.assert_allclose(np.asarray(jax.jacfwd(lie.quaternion_normalize)(q)) @ np.asarray(q), 0, atol=1e-6)


def test_mean_ignores_signs_and_returns_what_all_agree_on(x64, rng):
    q = jnp.asarray(np.roll(Rotation.random(1, random_state=5).as_quat(), 1, axis=1).T)
    q = q * jnp.sign(q[0])
    same = jnp.tile(q, 7)
    log_weights = jnp.asarray(rng.normal(size=7))
    np.testing.assert_allclose(lie.quaternion_mean(same, log_weights), q[:, 0], atol=1e-14)

    spread = jax.vmap(lie.so3_retract, (None, -1), -1)(q[:, 0], 0.4 * jnp.asarray(rng.normal(size=(3, 7))))
    expected = lie.quaternion_mean(spread, log_weights)
    flips = jnp.asarray(rng.choice([-1.0, 1.0], size=7))
    np.testing.assert_array_equal(lie.quaternion_mean(spread * flips, log_weights), expected)
    oracle = Rotation.from_quat(np.roll(np.asarray(spread).T, -1, axis=1)).mean(np.exp(log_weights))
    np.testing.assert_allclose(abs(expected @ scalar_first(oracle)), 1, atol=1e-14)


@pytest.mark.system
def test_mean_has_the_right_derivative_even_of_like_rotations(x64, rng):
    log_weights = jnp.log(jnp.array([0.5, 0.3, 0.2]))
    same = jnp.tile(lie.so3_exp(jnp.array([0.1, -0.5, 0.3]))[:, None], 3)

    def mean_turn(turns):
        turned = jax.vmap(lie.so3_retract, (-1, -1), -1)(same, turns)
        return lie.so3_local(same[:, 0], lie.quaternion_mean(turned, log_weights))

    # To first order the mean rotation turns by the weighted mean of the turns.
    jacobian = jax.jacrev(mean_turn)(jnp.zeros((3, 3)))
    np.testing.assert_allclose(jacobian, np.einsum("ij,k->ijk", np.eye(3), np.exp(log_weights)), atol=1e-12)


def test_functions_map_over_the_last_axis(rng):
    q = jnp.asarray(np.roll(Rotation.random(6, random_state=8).as_quat(), 1, axis=1).T, jnp.float32)
    turns = jnp.asarray(rng.normal(size=(3, 6)), jnp.float32)
    mapped = jax.vmap(lie.so3_retract, (-1, -1), -1)(q, turns)
    for i in range(6):
        np.testing.assert_allclose(mapped[:, i], lie.so3_retract(q[:, i], turns[:, i]), atol=1e-6)


def test_transforms_compose_invert_and_apply(x64, rng):
    rotations = Rotation.random(2, random_state=4)
    T_a_b, T_b_c = (
        lie.RigidTransform(jnp.asarray(scalar_first(r)), jnp.asarray(rng.normal(size=3))) for r in rotations
    )
    points = jnp.asarray(rng.normal(size=(5, 2, 3)))
    expected = np.einsum("ij,abj->abi", rotations[0].as_matrix(), points) + T_a_b.translation
    np.testing.assert_allclose(T_a_b.apply(points), expected, atol=1e-14)
    np.testing.assert_allclose(lie.compose(T_a_b, T_b_c).apply(points), T_a_b.apply(T_b_c.apply(points)), atol=1e-14)
    np.testing.assert_allclose(T_a_b.inverse().apply(T_a_b.apply(points)), points, atol=1e-14)
    np.testing.assert_array_equal(lie.RigidTransform.identity().apply(points), points)
