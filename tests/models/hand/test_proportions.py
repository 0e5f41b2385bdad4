import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import fit
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.observation import crop
from jaxfilters.models.hand.proportions import HandProportions, HandStills, StillsDensity, learn
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_center, hand_geometry, open_palm, retract
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.rendering.silhouette import soft_silhouette

TRUE = HandProportions(jnp.float32(0.93), jnp.array([0.95, 0.9, 0.92, 0.93, 1.0]), jnp.float32(1.0))
AVERAGE = HandProportions(jnp.float32(1), jnp.ones(5), jnp.float32(1))
SPREAD = np.repeat(np.float32([0.03, 0.3, 0.4]), (3, 3, 15))
NOISE = 0.003


def stills(shape=(48, 48), stride=4):
    """Two rendered hands, and poses some way off."""
    rng = np.random.default_rng(1)
    camera = Pinhole.from_intrinsics(287.0, (160.0, 120.0), (240, 320))
    windows, starts = [], []
    for _ in range(2):
        turned = np.concatenate([rng.normal(size=6) * 0.1, 0.2 * np.abs(rng.normal(size=15))])
        pose = retract(open_palm(jnp.array([0.0, 0.05, 0.45])), jnp.asarray(turned, jnp.float32))
        depth = render_capsules(camera, forward_kinematics(pose, TRUE.of(hand_geometry())).capsules)
        noisy = depth + NOISE * jnp.asarray(rng.normal(size=depth.shape), jnp.float32)
        windows.append(crop(camera, noisy, hand_center(pose), shape, stride))
        starts.append(retract(pose, jnp.asarray(0.2 * SPREAD * rng.normal(size=21), jnp.float32)))
    cameras, observed = zip(*windows, strict=True)
    cameras = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    return StillsDensity(hand_geometry(), cameras, jnp.stack(observed), jnp.stack(starts), jnp.asarray(SPREAD))


@pytest.mark.system
@pytest.mark.optimised
def test_size_and_noise_of_a_rendered_hand_are_learnt_through_the_renderer():
    theta = HandStills(AVERAGE, jnp.float32(0.01), jnp.zeros((2, 21)))
    free = HandStills(HandProportions(fit.positive, fit.positive, fit.positive), fit.positive, fit.free)
    found = learn(stills(), theta, free, method=fit.adam(0.03, max_steps=120, patience=100)).theta
    # Palm and digits of two stills: some per cent; an average hand is 7 and up to 11 per cent off.
    np.testing.assert_allclose(found.proportions.palm, TRUE.palm, rtol=0.02)
    assert np.sqrt(np.mean((found.proportions.digits - TRUE.digits) ** 2)) < 0.03
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.15)


@pytest.mark.system
@pytest.mark.parametrize("softness", [0.05, 40.0])
def test_the_density_is_that_of_a_pixel_worked_out_by_hand(softness):
    """One pixel that the hand covers, wholly or in part, with a reading 4 mm off, background, or none."""
    camera = Pinhole.from_intrinsics(500.0, (0.0, 0.0), (1, 1))
    hand, noise = hand_geometry(), 0.003
    pose = open_palm(jnp.array([0.0, 0.05, 0.5]))
    capsules = forward_kinematics(pose, hand).capsules
    depth = float(render_capsules(camera, capsules)[0, 0])
    covered = float(soft_silhouette(camera, capsules, softness=softness)[0, 0])
    within = 0.95 * (2 * covered - 1)
    near = np.exp(-8 / 9) / (noise * np.sqrt(2 * np.pi))
    density = StillsDensity(hand, None, None, None, None, softness=softness)
    for observed, expected in (
        (depth + 0.004, within * near + (0.95 * covered - within + 0.05) / 0.28),
        (np.inf, 1 - 0.95 * covered),
        (np.nan, 1.0),
    ):
        found = density.pixels(camera, jnp.full((1, 1), observed), hand, pose, jnp.float32(noise))
        np.testing.assert_allclose(found, np.log(expected), rtol=2e-3, atol=1e-4)
    assert softness < 1 or 0.5 < covered < 0.9


def test_proportions_are_factors():
    hand = HandProportions(2.0, np.array([1.0, 3.0, 1.0, 1.0, 1.0]), 0.5).of(hand_geometry())
    average = hand_geometry()
    np.testing.assert_allclose(hand.bases, 2 * average.bases)
    np.testing.assert_allclose(hand.lengths[1], 3 * average.lengths[1])
    np.testing.assert_allclose(hand.radii, 0.5 * average.radii)
