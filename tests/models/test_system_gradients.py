"""Log evidence through the models of all five systems has finite derivatives in float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxfilters
from jaxfilters import Gaussian, StandardNormal
from jaxfilters.gaussian.extended import extended_kalman
from jaxfilters.models.articulated import filters
from jaxfilters.models.articulated.limits import limit_rows, table_1
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.face.landmarks import MEAN_SHAPE
from jaxfilters.models.face.rig import nominal, project_shape
from jaxfilters.models.hand.cost import gibbs_abs
from jaxfilters.models.hand.observation import HandLikelihood, crop, hand_image, union
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_center, hand_geometry, open_palm, retract
from jaxfilters.models.hand.surface import CapsuleHand
from jaxfilters.models.moving_points import PointFilter, PointNoise
from jaxfilters.models.person.ellipsoid import outline, soft_ellipse_mask, standing
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.synthetic import articulated as synthetic

KEY = jax.random.key(0)
PERSON_P = jnp.array([[70.0, -40.0, 0.0, 200.0], [0.0, -20.0, -75.0, 220.0], [0.0, -1.0, 0.0, 5.0]])


def articulated(theta):
    """Length and noise of the hand seen by one camera; cuts, quaternion and views included."""
    with jax.ensure_compile_time_eval():  # checked on the host, though the caller traces this
        sequence, hand = synthetic.simulate_paper(KEY, 1), synthetic.paper_hand()
        limits = filters.inequalities(limit_rows(synthetic.LAYOUT, table_1()))
    rows = slice(0, 4)
    std = theta["noise"] * jnp.broadcast_to(sequence.noise_std, sequence.features.shape)
    looks = filters.FeatureObservation(sequence.features[rows], sequence.masks[rows], std[rows])
    prior = Gaussian(sequence.initial_mean, theta["spread"] * sequence.initial_covariance)
    filter = filters.recommended(hand, prior, limits)
    return jaxfilters.log_evidence(filter, KEY, looks, jnp.ones(4).at[0].set(0.0))


def depth_hand(theta):
    """Size of a rendered hand, and scale of the cost of its depth."""
    camera = Pinhole.from_intrinsics(150.0, (80.0, 60.0), (120, 160))
    pose = open_palm(jnp.array([0.0, 0.09, 0.6]))
    depth = render_capsules(camera, forward_kinematics(pose, hand_geometry()).capsules)
    image = hand_image(*crop(camera, depth, hand_center(pose), (32, 32), 2))
    likelihood = HandLikelihood(CapsuleHand(hand_geometry()), theta["sigma"], 0.03, union, gibbs_abs)
    likelihood = likelihood.scaled(theta["size"])

    def move(noise, x, inputs):
        del inputs
        return retract(x, theta["step"] * noise)

    filter = jaxfilters.bootstrap(
        lambda key: retract(pose, 0.01 * jax.random.normal(key, (21,))),
        move,
        likelihood.log_likelihood,
        num_particles=8,
        noise=StandardNormal(21),
    )
    return jaxfilters.log_evidence(filter, KEY, jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), image))


def person(theta):
    """Height of somebody on a floor, from soft silhouettes."""
    observed = soft_ellipse_mask(
        outline(PERSON_P, standing(jnp.array([0.2, 0.1]), jnp.array(1.7), jnp.array(0.45))), (60, 80)
    )

    def log_likelihood(x, y):
        expected = soft_ellipse_mask(outline(PERSON_P, standing(x, theta["height"], jnp.array(0.45))), (60, 80))
        expected = jnp.clip(expected, 0.01, 0.99)
        return theta["trust"] * jnp.sum(y * jnp.log(expected) + (1 - y) * jnp.log1p(-expected))

    filter = jaxfilters.bootstrap(
        lambda key: 0.3 * jax.random.normal(key, (2,)),
        lambda noise, x, inputs: x + 0.05 * noise,
        log_likelihood,
        num_particles=8,
        noise=StandardNormal(2),
    )
    return jaxfilters.log_evidence(filter, KEY, jnp.stack([observed] * 2))


def head(theta):
    """Landmarks of a face before two cameras: noises, and a size."""
    shape = jnp.asarray(MEAN_SHAPE, jnp.float32)
    with jax.ensure_compile_time_eval():
        rig = nominal()  # read on the host, though the caller compiles this

    def observed(pose):
        return project_shape(rig, theta["size"] * shape, pose)[0].ravel()

    start = jnp.array([0.0, 0.0, 650.0, 0.1, 0.2, -0.1])
    prior = Gaussian(start, jnp.diag(jnp.array([10.0, 10, 30, 0.2, 0.2, 0.2]) ** 2))
    y = observed(start + jnp.array([3.0, 2, 5, 0.05, 0, 0.05]))
    filter = extended_kalman(
        prior, lambda x, _: x, theta["step"] ** 2 * jnp.eye(6), observed, theta["noise"] ** 2 * jnp.eye(y.size)
    )
    return jaxfilters.log_evidence(filter, KEY, jnp.stack([y] * 2))


def fingertips(theta):
    """Noises of points that move."""
    filter = PointFilter(jnp.float32(50.0))(PointNoise(theta["sensor"], theta["drive"]))
    y = jnp.array([[1.0], [2.5], [jnp.nan], [6.0]])
    return jaxfilters.log_evidence(filter, KEY, y, jnp.array([0.0, 0.03, 0.03, 0.04]))


SYSTEMS = [
    (articulated, {"noise": 1.0, "spread": 1.0}),
    (depth_hand, {"sigma": 0.002, "size": 1.02, "step": 0.01}),
    (person, {"height": 1.6, "trust": 0.1}),
    (head, {"size": 1.0, "step": 0.1, "noise": 0.5}),
    (fingertips, {"sensor": 1.5, "drive": 60.0}),
]


@pytest.mark.system
@pytest.mark.parametrize(("evidence", "theta"), SYSTEMS, ids=[system.__name__ for system, _ in SYSTEMS])
def test_derivatives_are_finite_and_something(evidence, theta):
    theta = jax.tree.map(jnp.float32, theta)
    value_and_slope = jax.value_and_grad(evidence)
    # The limits of an articulated hand are checked outside of compiled functions.
    value, slope = (value_and_slope if evidence is articulated else jax.jit(value_and_slope))(theta)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf) and leaf != 0 for leaf in jax.tree.leaves(slope)), slope


@pytest.mark.system
@pytest.mark.parametrize(("evidence", "theta"), SYSTEMS, ids=[system.__name__ for system, _ in SYSTEMS])
def test_products_have_full_precision(products_at_default_precision, evidence, theta):
    assert not products_at_default_precision(jax.value_and_grad(evidence), jax.tree.map(jnp.float32, theta))
