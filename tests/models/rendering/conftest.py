import os
import subprocess
import sys
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxfilters.math.lie import RigidTransform, quaternion_normalize
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.rendering.comparison import (
    compare_capsules,
    compare_convex_parts,
    compare_ellipsoids,
    compare_mesh,
)
from jaxfilters.models.rendering.depth import (
    render_capsules,
    render_convex_parts,
    render_ellipsoids,
    render_mesh,
)
from jaxfilters.models.rendering.geometry import Capsules, Ellipsoids, convex_parts, mesh_from_trimesh

QUICK_TO_COMPILE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"


@pytest.fixture
def on_two_devices():
    """`(code) -> finished process`: one of its own, because the number of devices is fixed when JAX starts."""

    def run(code):
        flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2 {QUICK_TO_COMPILE}"
        environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        command = [sys.executable, "-c", code]
        return subprocess.run(command, check=False, env=environment, timeout=300, capture_output=True, text=True)

    return run


@pytest.fixture
def camera():
    """A window of 48 x 64 pixels, its optical axis off the middle."""
    return Pinhole.from_intrinsics((60.0, 66.0), (27.3, 25.9), (48, 64))


@pytest.fixture
def random_capsules():
    """`(seed, count) -> Capsules` that fill a good part of the window at half a metre."""

    def make(seed, count=6):
        rng = np.random.default_rng(seed)
        start = rng.uniform((-0.15, -0.12, 0.4), (0.15, 0.12, 0.6), (count, 3))
        end = start + rng.normal(size=(count, 3)) * 0.06
        return Capsules(*(jnp.asarray(value, float) for value in (start, end, rng.uniform(0.01, 0.04, count))))

    return make


@pytest.fixture
def random_transform():
    """`seed -> RigidTransform` close to half a metre in front of the camera, with any rotation."""

    def make(seed):
        rng = np.random.default_rng(seed)
        rotation = quaternion_normalize(jnp.asarray(rng.normal(size=4), float))
        return RigidTransform(rotation, jnp.asarray(rng.uniform((-0.05, -0.05, 0.45), (0.05, 0.05, 0.55)), float))

    return make


class Kind(NamedTuple):
    """One kind of shape in its own frame, made in the current float type, and what is done with it under a pose."""

    shape: Callable
    render: Callable
    """`(camera, shape, T_camera_object)`"""
    compare: Callable
    """`(camera, shape, T_camera_object, observed, max_error)`"""


def _capsules():
    rng = np.random.default_rng(5)
    start, end = rng.uniform(-0.08, 0.08, (2, 4, 3))
    return Capsules(*(jnp.asarray(value, float) for value in (start, end, rng.uniform(0.015, 0.03, 4))))


def _ellipsoids():
    rng = np.random.default_rng(6)
    rotation = rng.normal(size=(4, 4))
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    values = rng.uniform(-0.08, 0.08, (4, 3)), rotation, rng.uniform(0.015, 0.06, (4, 3))
    return Ellipsoids(*(jnp.asarray(value, float) for value in values))


def _convex():
    solids = [trimesh.creation.box((0.12, 0.05, 0.07)), trimesh.creation.icosphere(subdivisions=0, radius=0.05)]
    for solid, place in zip(solids, ((-0.04, 0.02, 0.01), (0.05, -0.02, -0.02)), strict=True):
        solid.apply_translation(place)
    return convex_parts(solids)


def _bumpy_sphere():
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.08)
    x, y, _ = (mesh.vertices / 0.08).T
    mesh.vertices *= (1 + 0.25 * np.sin(7 * x) * np.cos(5 * y))[:, None]
    return mesh_from_trimesh(mesh)


def _for_all_parts(T, parts):
    count = len(parts.offsets)
    return RigidTransform(jnp.tile(T.rotation, (count, 1)), jnp.tile(T.translation, (count, 1)))


def _of_moved(function):
    return lambda camera, shape, T, *rest: function(camera, shape.moved(T), *rest)


def _of_parts(function):
    return lambda camera, parts, T, *rest: function(camera, parts, _for_all_parts(T, parts), *rest)


KINDS = {
    "capsules": Kind(_capsules, render_capsules, _of_moved(compare_capsules)),
    "ellipsoids": Kind(_ellipsoids, render_ellipsoids, _of_moved(compare_ellipsoids)),
    "convex": Kind(_convex, _of_parts(render_convex_parts), _of_parts(compare_convex_parts)),
    "mesh": Kind(_bumpy_sphere, render_mesh, _of_moved(compare_mesh)),
}


@pytest.fixture(params=KINDS.values(), ids=KINDS)
def kind(request):
    """Every kind of shape that can be rendered and compared."""
    return request.param
