"""Depth of 512 hypotheses of a hand: capsules and triangle meshes against Embree, speed and accuracy.

One frame of the hand tracker: every hypothesis rendered into a window of 128 x 128 pixels of a Kinect v2 (focal length
365 pixels) with the hand at 0.7 m, and compared with an observed depth image. `capsules` are analytic, `mesh` are the
608 triangles of the same hand as 19 convex parts, `triangles` the same triangles as a mesh without structure. Embree
gets the 608 triangles too, builds its tree for each pose as it must, and runs on all cores; it is measured between the
others on fewer poses and scaled. Accuracy is that of each renderer against Embree on its own geometry: finely
tessellated capsules for `capsules`.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.timing import interleaved
from jaxfilters.math.lie import RigidTransform
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.mesh import HandMesh, capsule_mesh, hand_mesh, part_meshes, pose_vertices
from jaxfilters.models.hand.parts import part_transforms
from jaxfilters.models.hand.skeleton import forward_kinematics, hand_geometry, open_palm, retract
from jaxfilters.models.rendering.comparison import DepthTerms, compare_capsules, compare_convex_parts, compare_mesh
from jaxfilters.models.rendering.depth import render_capsules, render_convex_parts
from jaxfilters.models.rendering.geometry import Capsules, ConvexParts, Mesh, convex_parts
from jaxfilters.models.synthetic.hand import START, kinect_v2

NUM_POSES, WINDOW = 512, 128
COUNTS, WINDOWS, STRIDES = (128, 512, 2048), (64, 128, 256), (1, 2, 4)
EMBREE_SHARE, ACCURACY_POSES = 8, 8
MAX_ERROR = 0.1
"""Metres."""
ROUNDS, QUICK_ROUNDS = 15, 3
SPREAD = np.repeat([0.005, 0.03, np.deg2rad(5.0)], [3, 3, 15])
"""Standard deviations of the cloud of hypotheses: metres, radians, radians."""
GEOMETRY = hand_geometry()


class Cloud(NamedTuple):
    """Hypotheses of one hand in all forms, the ensemble on the last axis."""

    poses: Float[Array, "22 n"]
    capsules: Capsules
    T_camera_parts: RigidTransform
    vertices: Float[Array, "v 3 n"]


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Measure times, growth and accuracy; `out` is not used."""
    del out
    rounds = QUICK_ROUNDS if quick else ROUNDS
    metrics = _headline(seed, rounds)
    if not quick:
        metrics |= _growth(seed, rounds)
    return metrics


def window_camera(size: int, stride: int = 1) -> Pinhole:
    """A square window of `size` pixels of the full image, every `stride`-th kept, the hand at 0.7 m in its middle."""
    camera = kinect_v2()
    corner = camera.center - 0.5 * (size - 1)
    return camera.crop(corner, (size // stride, size // stride), stride)


def cloud(seed: int, count: int, mesh: HandMesh) -> Cloud:
    """Hypotheses around an open hand."""
    delta = jnp.asarray(np.random.default_rng(seed).normal(size=(len(SPREAD), count)) * SPREAD[:, None], float)
    poses = jax.vmap(retract, in_axes=(None, -1), out_axes=-1)(open_palm(jnp.asarray(START[:3])), delta)

    @jax.jit
    def forms(poses):
        over = lambda function: jax.vmap(function, in_axes=-1, out_axes=-1)(poses)
        return (
            over(lambda pose: forward_kinematics(pose, GEOMETRY).capsules),
            over(lambda pose: part_transforms(pose, GEOMETRY)),
            over(lambda pose: pose_vertices(pose, mesh, GEOMETRY)),
        )

    return Cloud(poses, *forms(poses))


def comparing(compare: Callable, shapes: PyTree, camera: Pinhole, observed: Float[Array, "rows cols"]) -> Callable:
    """A function without arguments that compares all shapes with the image, compiled."""
    compiled = jax.jit(lambda s, y: jax.vmap(lambda one: compare(camera, one, y), in_axes=-1)(s).absolute_sum)
    return lambda: compiled(shapes, observed)


def compare_hand_capsules(camera: Pinhole, capsules: Capsules, observed: Float[Array, "rows cols"]) -> DepthTerms:
    """Depth terms of capsules in an image."""
    return compare_capsules(camera, capsules, observed, MAX_ERROR)


def compare_parts(parts: ConvexParts) -> Callable:
    """`(camera, T_camera_parts, observed) -> terms` of the posed parts in an image."""
    return lambda camera, T, observed: compare_convex_parts(camera, parts, T, observed, MAX_ERROR)


def _compare_triangles(mesh: HandMesh) -> Callable:
    return lambda camera, vertices, observed: compare_mesh(
        camera, Mesh(vertices, mesh.faces, closed=True), observed, MAX_ERROR
    )


def _headline(seed, rounds):
    mesh, camera = hand_mesh(GEOMETRY), window_camera(WINDOW)
    parts, hypotheses = convex_parts(part_meshes(mesh)), cloud(seed, NUM_POSES, mesh)
    first = jax.tree.map(lambda leaf: leaf[..., 0], hypotheses)
    observed = render_capsules(camera, first.capsules)
    functions = {
        "capsules": comparing(compare_hand_capsules, hypotheses.capsules, camera, observed),
        "mesh": comparing(compare_parts(parts), hypotheses.T_camera_parts, camera, observed),
        "triangles": comparing(_compare_triangles(mesh), hypotheses.vertices, camera, observed),
    }
    with_embree = importlib.util.find_spec("embreex") is not None
    if with_embree:
        functions["embree"] = _embree_errors(camera, hypotheses, mesh, observed)
    else:
        sys.stdout.write("embreex is not installed: no ratios, no accuracy; pip install 'jaxfilters[bench]'\n")
    seconds = interleaved(functions, rounds)
    times = {name: value * 1e3 * (EMBREE_SHARE if name == "embree" else 1) for name, value in seconds.items()}
    metrics = {f"frame_ms_{name}": Metric(value, "ms", "lower") for name, value in times.items()}
    if with_embree:
        ours = [name for name in times if name != "embree"]
        metrics |= {f"ratio_to_embree_{name}": Metric(times[name] / times["embree"], "", "lower") for name in ours}
        metrics |= _accuracy(camera, hypotheses, mesh, parts)
    return metrics


def _embree_errors(camera, hypotheses, mesh, observed):
    from jaxfilters.benchmarks.scenarios._embree import Embree

    embree, faces = Embree(camera), np.asarray(mesh.faces)
    some = np.moveaxis(np.asarray(hypotheses.vertices)[..., : NUM_POSES // EMBREE_SHARE], -1, 0)
    image = np.asarray(observed)
    return lambda: embree.errors(some[:, faces], image, MAX_ERROR)


def _accuracy(camera, hypotheses, mesh, parts):
    from jaxfilters.benchmarks.scenarios._embree import Embree, joined

    embree, faces = Embree(camera), np.asarray(mesh.faces)
    render_parts = jax.jit(lambda T: render_convex_parts(camera, parts, T))
    pairs: dict[str, list] = {"capsules": [], "mesh": []}
    for index in range(ACCURACY_POSES):
        one = jax.tree.map(lambda leaf, index=index: leaf[..., index], hypotheses)
        fine = joined(fine_capsules(one.capsules))
        pairs["capsules"].append((np.asarray(render_capsules(camera, one.capsules)), embree.depth(fine)))
        triangles = np.asarray(one.vertices)[faces]
        pairs["mesh"].append((np.asarray(render_parts(one.T_camera_parts)), embree.depth(triangles)))
    metrics = {}
    for name, images in pairs.items():
        error, iou = agreement(images)
        metrics[f"depth_mean_abs_error_mm_{name}"] = Metric(1e3 * error, "mm", "lower")
        metrics[f"silhouette_iou_{name}"] = Metric(iou, "", "higher")
    return metrics


def fine_capsules(capsules: Capsules) -> list:
    """Tessellations of equal volume that leave the capsules' surfaces by some hundredths of a millimetre at most."""
    values = zip(*(np.asarray(v, float) for v in (capsules.start, capsules.end, capsules.radius)), strict=True)
    return [capsule_mesh(*value, sections=96, latitudes=24) for value in values]


def agreement(images: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[float, float]:
    """Mean absolute difference where both images are finite, and the intersection over union of their masks."""
    total, both_count, any_count = 0.0, 0, 0
    for ours, theirs in images:
        both = np.isfinite(ours) & np.isfinite(theirs)
        total += np.abs(ours[both] - theirs[both]).sum()
        both_count += both.sum()
        any_count += (np.isfinite(ours) | np.isfinite(theirs)).sum()
    return total / both_count, both_count / any_count


def _growth(seed, rounds):
    """Times with more hypotheses, triangles and pixels than the headline's, and with fewer."""
    coarse, fine = hand_mesh(GEOMETRY), hand_mesh(GEOMETRY, sections=10, latitudes=1)
    hypotheses = {count: cloud(seed, count, coarse) for count in COUNTS}
    usual = hypotheses[NUM_POSES]
    first = jax.tree.map(lambda leaf: leaf[..., 0], usual)
    functions = {}

    def add(name, camera, shapes, compare):
        functions[name] = comparing(compare, shapes, camera, render_capsules(camera, first.capsules))

    for count, many in hypotheses.items():
        add(f"capsules_n{count}", window_camera(WINDOW), many.capsules, compare_hand_capsules)
    for size in WINDOWS:
        add(f"capsules_window{size}", window_camera(size), usual.capsules, compare_hand_capsules)
    for stride in STRIDES:
        add(f"capsules_stride{stride}", window_camera(WINDOW, stride), usual.capsules, compare_hand_capsules)
    for mesh in (coarse, fine):
        compare = compare_parts(convex_parts(part_meshes(mesh)))
        for stride in STRIDES[:2]:
            camera = window_camera(WINDOW, stride)
            add(f"mesh_f{len(mesh.faces)}_stride{stride}", camera, usual.T_camera_parts, compare)
    seconds = interleaved(functions, max(3, rounds // 2))
    return {f"frame_ms_{name}": Metric(1e3 * value, "ms", "lower") for name, value in seconds.items()}
