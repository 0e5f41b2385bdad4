"""Depth terms against sums over rendered images, pixel by pixel in numpy; batches, devices and derivatives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.rendering.comparison import compare_capsules
from jaxfilters.models.rendering.depth import render_capsules

MAX_ERROR = 0.08


def observed_image(shape, seed=0):
    """A tilted plane with noise, background on the right, and readings missing here and there."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices(shape)
    image = 0.45 + 0.002 * rows + rng.normal(0, 0.03, shape)
    image[cols > 0.45 * shape[1]] = np.inf
    image[rng.random(shape) < 0.1] = np.nan
    return jnp.asarray(image, float)


def terms_by_pixel(rendered, observed):
    """(absolute sum, rendered count, overlap count) with explicit masks."""
    rendered, observed = np.asarray(rendered, float), np.asarray(observed, float)
    use = np.isfinite(rendered) & ~np.isnan(observed)
    errors = np.minimum(np.abs(rendered[use] - observed[use]), MAX_ERROR)
    return errors.sum(), use.sum(), (use & np.isfinite(observed)).sum()


def stacked(capsules, axis):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=axis), *capsules)


@pytest.mark.system
def test_terms_against_the_rendered_image(x64, camera, kind, random_transform):
    shape, T, observed = kind.shape(), random_transform(8), observed_image(camera.shape)
    terms = jax.jit(lambda: kind.compare(camera, shape, T, observed, MAX_ERROR))()
    expected = terms_by_pixel(jax.jit(lambda: kind.render(camera, shape, T))(), observed)
    assert expected[1] > expected[2] > 30
    np.testing.assert_allclose(terms, expected, rtol=1e-12)


@pytest.mark.system
def test_counts_of_a_large_image_do_not_overflow(camera, random_capsules):
    """Both counts of a small image share one word; 2^16 pixels and more need two."""
    near = random_capsules(0, 1)
    ball = jax.tree.map(lambda leaf: leaf * 0, near)
    ball = type(near)(ball.start.at[:, 2].set(0.5), ball.end.at[:, 2].set(0.5), ball.radius + 0.499)
    wide = camera.crop(jnp.asarray([-100.0, -100.0]), (256, 257))
    terms = compare_capsules(wide, ball, jnp.full((256, 257), 0.1), MAX_ERROR)
    rendered = np.isfinite(render_capsules(wide, ball)).sum()
    assert rendered > 2**15
    assert terms.rendered_count == terms.overlap_count == rendered


@pytest.mark.system
@pytest.mark.parametrize("axis", [0, -1])
def test_a_batch_is_each_in_turn(camera, random_capsules, axis):
    observed = observed_image(camera.shape)
    many = [random_capsules(seed) for seed in range(5)]
    compare = lambda capsules: compare_capsules(camera, capsules, observed, MAX_ERROR)
    together = jax.jit(jax.vmap(compare, in_axes=axis))(stacked(many, axis))
    for index, capsules in enumerate(many):
        np.testing.assert_allclose([leaf[index] for leaf in together], compare(capsules), rtol=1e-5)


@pytest.mark.system
def test_batches_of_batches_and_of_images(camera, random_capsules):
    images = jnp.stack([observed_image(camera.shape, seed) for seed in range(2)])
    many = stacked([random_capsules(seed) for seed in range(3)], -1)
    compare = lambda capsules, observed: compare_capsules(camera, capsules, observed, MAX_ERROR)
    inner = jax.vmap(compare, in_axes=(-1, None))
    each = [jax.jit(inner)(many, image) for image in images]
    of_images = jax.jit(jax.vmap(inner, in_axes=(None, 0)))(many, images)
    for index in range(2):
        np.testing.assert_allclose([leaf[index] for leaf in of_images], each[index], rtol=1e-5)
    twice = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), many)
    of_batches = jax.jit(jax.vmap(lambda capsules: inner(capsules, images[1])))(twice)
    assert of_batches.absolute_sum.shape == (2, 3)
    np.testing.assert_allclose([leaf[1] for leaf in of_batches], each[1], rtol=1e-5)


@pytest.mark.system
def test_whole_images_at_once_equal_windows_in_turn(monkeypatch, camera, random_capsules):
    """What runs on an accelerator, run here, for an image of a size that no other test has: its program is new."""
    observed = observed_image(camera.shape)
    many = stacked([random_capsules(seed) for seed in range(3)], 0)

    def value_and_gradient(camera, observed):
        compare = lambda capsules: compare_capsules(camera, capsules, observed, MAX_ERROR).absolute_sum
        return jax.jit(jax.vmap(jax.value_and_grad(compare)))(many)

    in_turn = value_and_gradient(camera, observed)
    # Around the image nothing was read: there it says nothing.
    wider, framed = camera.crop(jnp.asarray([-1.0, -1.0]), (50, 67)), jnp.full((50, 67), jnp.nan)
    asked = []
    monkeypatch.setattr(jax, "default_backend", lambda: asked.append(True) or "gpu")
    at_once = value_and_gradient(wider, framed.at[1:49, 1:65].set(observed))
    assert asked
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-3), at_once, in_turn)


@pytest.mark.system
def test_derivatives_against_those_of_the_rendered_image(x64, camera, kind, random_transform):
    """In camera, pose and largest error; the image's own derivative is tested elsewhere."""
    shape, T, observed = kind.shape(), random_transform(8), observed_image(camera.shape)

    def by_image(camera, T, max_error):
        image = kind.render(camera, shape, T)
        use = jnp.isfinite(image) & ~jnp.isnan(observed)
        error = jnp.abs(jnp.where(use, image, 0.0) - jnp.where(use, observed, 0.0))
        return jnp.sum(jnp.where(use, jnp.where(error < max_error, error, max_error), 0.0))

    fused = lambda camera, T, max_error: kind.compare(camera, shape, T, observed, max_error).absolute_sum
    expected, gradient = (jax.jit(jax.grad(f, argnums=(0, 1, 2)))(camera, T, MAX_ERROR) for f in (by_image, fused))
    assert all(max(np.abs(leaf).max() for leaf in jax.tree.leaves(part)) > 1e-3 for part in expected)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9), gradient, expected)


@pytest.mark.system
def test_forward_and_batched_derivatives(x64, camera, random_capsules):
    observed = observed_image(camera.shape)
    many = [random_capsules(seed) for seed in range(3)]
    loss = lambda capsules: compare_capsules(camera, capsules, observed, MAX_ERROR).absolute_sum
    together = jax.jit(jax.vmap(jax.grad(loss), in_axes=-1, out_axes=-1))(stacked(many, -1))
    direction = jax.tree.map(jnp.cos, many[1])
    _, forward = jax.jit(partial(jax.jvp, loss))((many[1],), (direction,))
    mine = jax.tree.map(lambda leaf: leaf[..., 1], together)
    reverse = sum(jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), mine, direction)))
    np.testing.assert_allclose(forward, reverse, rtol=1e-10)


def test_an_image_is_no_variable(camera, random_capsules):
    capsules = random_capsules(0)
    with pytest.raises(ValueError, match="observed is data"):
        jax.grad(lambda y: compare_capsules(camera, capsules, y, MAX_ERROR)[0])(observed_image(camera.shape))


@pytest.mark.system
def test_a_pose_that_is_no_number_has_no_cost(camera, random_capsules):
    capsules = random_capsules(0)
    broken = jax.tree.map(lambda leaf: leaf.at[0].set(jnp.nan), capsules)
    many = stacked([capsules, broken], 0)
    observed = observed_image(camera.shape)
    sums = jax.vmap(lambda c: compare_capsules(camera, c, observed, MAX_ERROR).absolute_sum)(many)
    assert np.isfinite(sums[0])
    assert np.isnan(sums[1])


def test_out_of_sight_and_without_readings_all_terms_are_zero(camera, random_capsules):
    capsules = random_capsules(0)
    behind = capsules.moved(RigidTransform(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([0, 0, -2.0])))
    aside = capsules.moved(RigidTransform(jnp.asarray([1.0, 0, 0, 0]), jnp.asarray([5.0, 0, 0])))
    observed = observed_image(camera.shape)
    for shape, image in ((behind, observed), (aside, observed), (capsules, jnp.full_like(observed, jnp.nan))):
        assert compare_capsules(camera, shape, image, MAX_ERROR) == (0, 0, 0)


_ON_TWO_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.comparison import compare_capsules
from jaxfilters.models.rendering.geometry import Capsules

assert len(jax.devices()) == 2
camera = Pinhole.from_intrinsics((60.0, 66.0), (27.3, 25.9), (48, 64))
rng = np.random.default_rng(0)
start = jnp.asarray(rng.uniform((-0.15, -0.12, 0.4), (0.15, 0.12, 0.6), (7, 6, 3)).T.swapaxes(0, 1), float)
capsules = Capsules(start, start + 0.05, jnp.full((6, 7), 0.03))
images = jnp.asarray(rng.uniform(0.4, 0.6, (2, 48, 64)), float)
one = lambda c, y: compare_capsules(camera, c, y, 0.08)

@jax.jit
def sequence(capsules, images):
    def step(carry, image):
        def sum_beside_terms(c):
            terms = one(c, image)
            return terms.absolute_sum, terms
        gradient, terms = jax.vmap(jax.grad(sum_beside_terms, has_aux=True), in_axes=-1)(carry)
        return jax.tree.map(lambda leaf: leaf + 1e-3, carry), (terms, gradient)
    return jax.lax.scan(step, capsules, images)[1]

together, _ = sequence(capsules, images)
assert together.absolute_sum.sharding.is_fully_replicated
for index in range(7):
    alone = one(jax.tree.map(lambda leaf: leaf[..., index], capsules), images[0])
    np.testing.assert_allclose([leaf[0, index] for leaf in together], alone, rtol=1e-5)
"""


@pytest.mark.system
def test_two_devices_share_the_poses_of_a_sequence(on_two_devices):
    """Seven poses leave one over."""
    done = on_two_devices(_ON_TWO_DEVICES)
    assert done.returncode == 0, done.stderr
