"""Laws of every renderer: derivatives, regions of interest, strides, batches, and what must not be seen."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.rendering.geometry import convex_parts, mesh_from_trimesh

STEP = 1e-7


@partial(jax.jit, static_argnames="kind")
def rendered(kind, camera, shape, T):
    return kind.render(camera, shape, T)


@partial(jax.jit, static_argnames="kind")
@partial(jax.grad, argnums=3)
def slope_of_all_depths(kind, camera, shape, T):
    image = kind.render(camera, shape, T)
    return jnp.sum(jnp.where(jnp.isfinite(image), image, 0.0))


def render_at(kind, camera, shape):
    """Depth as a function of seven pose numbers."""
    return jax.jit(lambda pose: kind.render(camera, shape, RigidTransform(pose[:4], pose[4:])))


@pytest.mark.system
def test_derivative_against_central_differences(x64, camera, kind, random_transform):
    T = random_transform(8)
    pose = jnp.concatenate([T.rotation, T.translation])
    render = render_at(kind, camera, kind.shape())
    derivative = np.asarray(jax.jit(jax.jacfwd(render))(pose))
    assert np.all(np.isfinite(derivative))
    for index in range(7):
        after, before = (np.asarray(render(pose + sign * STEP * jnp.eye(7)[index])) for sign in (1, -1))
        inside = np.isfinite(after) & np.isfinite(before)
        assert inside.mean() > 0.03
        expected = (after[inside] - before[inside]) / (2 * STEP)
        error = np.abs(derivative[..., index][inside] - expected) / (1 + np.abs(expected))
        # Rounding is 1e-16 / STEP; a pixel in two hundred may change its surface within a step or lie at an outline.
        assert np.quantile(error, 0.995) < 1e-6


@pytest.mark.system
def test_forward_and_reverse_derivatives_agree(x64, camera, kind, random_transform):
    shape, T = kind.shape(), random_transform(3)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=camera.shape))
    floats, others = _floats(shape)

    def loss(floats, T):
        image = kind.render(camera, others(floats), T)
        return jnp.sum(jnp.where(jnp.isfinite(image), image * weights, 0.0))

    direction = jax.tree.map(lambda leaf: jnp.sin(7 * jnp.arange(leaf.size)).reshape(leaf.shape), (floats, T))
    forward = jax.jit(lambda: jax.jvp(loss, (floats, T), direction)[1])()
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)))(floats, T)
    reverse = sum(jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), gradient, direction)))
    assert abs(forward) > 1e-3
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)


def _floats(shape):
    """The float leaves of a shape, and how to make a shape of such leaves."""
    leaves, structure = jax.tree.flatten(shape)
    is_float = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]

    def rebuilt(floats):
        values = iter(floats)
        return structure.unflatten([next(values) if f else leaf for leaf, f in zip(leaves, is_float, strict=True)])

    return [leaf for leaf, f in zip(leaves, is_float, strict=True) if f], rebuilt


@pytest.mark.system
def test_a_region_with_a_stride_is_part_of_the_image(x64, camera, kind, random_transform):
    shape, T = kind.shape(), random_transform(1)
    whole = np.asarray(rendered(kind, camera, shape, T))
    part = rendered(kind, camera.crop(jnp.asarray([5.0, 3.0]), (20, 25), 2), shape, T)
    np.testing.assert_allclose(part, whole[3:43:2, 5:55:2], rtol=1e-12)


@pytest.mark.system
def test_a_batch_is_each_in_turn(x64, camera, kind, random_transform):
    shape = kind.shape()
    poses = [random_transform(seed) for seed in range(3)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=-1), *poses)
    together = jax.jit(jax.vmap(lambda T: kind.render(camera, shape, T), in_axes=-1))(batch)
    for image, T in zip(together, poses, strict=True):
        np.testing.assert_allclose(image, rendered(kind, camera, shape, T), rtol=1e-9)


@pytest.mark.system
def test_whole_images_at_once_equal_windows_in_turn(x64, monkeypatch, camera, kind, random_transform):
    """What runs on an accelerator, run here, for a window of a size that no other test has: its program is new."""
    shape, T = kind.shape(), random_transform(2)
    in_turn, window = rendered(kind, camera, shape, T), camera.crop(jnp.asarray([2.0, 1.0]), (46, 61))
    asked = []
    monkeypatch.setattr(jax, "default_backend", lambda: asked.append(True) or "gpu")
    np.testing.assert_allclose(kind.render(window, shape, T), in_turn[1:47, 2:63], rtol=1e-9)
    assert asked


@pytest.mark.system
def test_nothing_behind_the_camera_is_seen(x64, camera, kind, random_transform):
    T = random_transform(2)
    behind = RigidTransform(T.rotation, T.translation * jnp.asarray([1, 1, -1.0]))
    assert np.all(np.isinf(rendered(kind, camera, kind.shape(), behind)))


@pytest.mark.system
def test_gradients_are_finite_wherever_the_object_is(camera, kind, random_transform):
    shape, T = kind.shape(), random_transform(6)
    for depth_of_center in (-0.5, -0.02, 0.0, 0.05, 0.5, 1e4):
        T = RigidTransform(T.rotation, T.translation.at[2].set(depth_of_center))
        gradient = slope_of_all_depths(kind, camera, shape, T)
        assert np.all(np.isfinite(gradient.rotation)), depth_of_center
        assert np.all(np.isfinite(gradient.translation)), depth_of_center


def test_meshes_and_parts_without_content_are_refused():
    flat = trimesh.Trimesh([[0, 0, 1], [1, 0, 1], [0, 1, 1]], [[0, 1, 2]], process=False)
    with pytest.raises(ValueError, match="meshes must hold one"):
        convex_parts([])
    with pytest.raises(ValueError, match=r"meshes\[0\] must have a volume"):
        convex_parts([flat])
    with pytest.raises(ValueError, match="must have faces"):
        mesh_from_trimesh(trimesh.Trimesh())
    assert not mesh_from_trimesh(flat).closed
