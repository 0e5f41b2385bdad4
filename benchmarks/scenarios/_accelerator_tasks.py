"""What `bench accelerator` computes: programs of this library by size, and those of other libraries beside them."""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxfilters.benchmarks.scenarios import _filter_models as models
from jaxfilters.benchmarks.scenarios import _filter_peers as filter_peers
from jaxfilters.benchmarks.scenarios import _hmm_peers as hmm_peers
from jaxfilters.benchmarks.scenarios import _smoother_peers as smoother_peers
from jaxfilters.benchmarks.scenarios import hmm, render
from jaxfilters.benchmarks.scenarios._gaussian_models import build, ranging
from jaxfilters.filter import log_evidence
from jaxfilters.gaussian import arithmetic
from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.gaussian.linear import kalman
from jaxfilters.gaussian.parallel_in_time import LinearModel, parallel_kalman, parallel_rts
from jaxfilters.gaussian.smoothing import filter_and_smooth
from jaxfilters.hmm import HiddenMarkovModel
from jaxfilters.hmm import log_evidence as log_evidence_of_chains
from jaxfilters.models.hand.mesh import hand_mesh, part_meshes
from jaxfilters.models.hand.skeleton import forward_kinematics
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.rendering.geometry import convex_parts
from jaxfilters.particle.resampling import systematic

CHUNK = 512
"""Poses that are rendered at once: what bounds the memory of a hundred thousand."""
FILTER_STEPS, TRACK_STEPS = 10, 20


class Work(NamedTuple):
    """One program."""

    function: Callable[..., Any]
    """Pure; compiled by whoever measures it."""
    arguments: tuple[Any, ...]
    loops: int = 1
    """How often the body of its loop runs: XLA counts the arithmetic of one."""
    others: Mapping[str, Callable[[], Any]] = {}
    """The same by other libraries, compiled at their first call."""


class Task(NamedTuple):
    """A program for every size."""

    work: Callable[[int], Work]
    sizes: tuple[int, ...]
    """Ascending."""
    quick: int
    """A size that any processor computes in a second."""
    float64: bool = False
    """Whether it is made, compiled and called in double precision."""


def _depth(kind: str, seed: int, count: int) -> Work:
    """Cost of a depth image of 128 x 128 pixels under many poses of a hand."""
    mesh, camera = hand_mesh(render.GEOMETRY), render.window_camera(render.WINDOW)
    cloud = render.cloud(seed, count, mesh)
    first = jax.tree.map(lambda leaf: leaf[..., 0], cloud.capsules)
    observed = render_capsules(camera, first)
    compare = render.compare_hand_capsules
    shapes: PyTree = cloud.capsules
    if kind == "mesh":
        compare, shapes = render.compare_parts(convex_parts(part_meshes(mesh))), cloud.T_camera_parts
    every = jax.vmap(lambda shape, y: compare(camera, shape, y).absolute_sum, in_axes=(-1, None))
    return Work(partial(_in_chunks, every), (shapes, observed), max(1, count // CHUNK))


def _in_chunks(function: Callable, shapes: PyTree, observed: Array) -> Array:
    """`CHUNK` poses after the other, the last axis being that of poses."""
    count = jax.tree.leaves(shapes)[0].shape[-1]
    if count <= CHUNK:
        return function(shapes, observed)
    split = lambda leaf: jnp.moveaxis(leaf.reshape(*leaf.shape[:-1], count // CHUNK, CHUNK), -2, 0)
    return jax.lax.map(lambda part: function(part, observed), jax.tree.map(split, shapes)).reshape(-1)


def _depth_gradient(seed: int, count: int) -> Work:
    """The derivative of the summed cost with respect to all poses."""
    camera, cloud = render.window_camera(render.WINDOW), render.cloud(seed, count, hand_mesh(render.GEOMETRY))
    observed = render_capsules(camera, jax.tree.map(lambda leaf: leaf[..., 0], cloud.capsules))

    def total(poses: Array, observed: Array) -> Array:
        capsules = lambda pose: forward_kinematics(pose, render.GEOMETRY).capsules
        cost = lambda pose: render.compare_hand_capsules(camera, capsules(pose), observed).absolute_sum
        return jnp.sum(jax.vmap(cost, in_axes=-1)(poses))

    return Work(jax.value_and_grad(total), (cloud.poses, observed))


def _bootstrap(seed: int, count: int, *, gradient: bool = False) -> Work:
    """`count` particle-steps in at most a million particles."""
    num_particles = min(count // FILTER_STEPS, 1_000_000)
    problem = models.drift(seed, count // num_particles)
    key = jax.random.key(seed)

    def evidence(model: models.Drift, readings: Array) -> Array:
        return log_evidence(models.plain(model, num_particles), key, readings)

    others = {}
    if not gradient and find_spec("smcx"):
        others["smcx"] = partial(filter_peers.smcx(problem, num_particles), key)
    function = jax.value_and_grad(evidence) if gradient else evidence
    return Work(function, (problem.model, problem.readings), len(problem.readings), others)


def _rao_blackwell(seed: int, count: int, *, shared: bool) -> Work:
    problem = models.mixed(seed, 3, 6, FILTER_STEPS)
    filter, key = models.marginalised(problem.model, count, shared=shared), jax.random.key(seed)
    return Work(lambda readings: log_evidence(filter, key, readings), (problem.readings,), FILTER_STEPS)


def _tracks(seed: int, count: int, *, gradient: bool = False) -> Work:
    """Extended Kalman filters of many tracks, six states and three sensors."""
    problem, key = ranging(seed, count, TRACK_STEPS), jax.random.key(seed)

    def evidence(model: Any, readings: Array) -> Array:
        filter = build(problem, model, arithmetic.joseph)
        return jnp.sum(jax.vmap(lambda y: log_evidence(filter, key, y), in_axes=-1)(readings))

    function = jax.value_and_grad(evidence) if gradient else evidence
    return Work(function, (problem.model, problem.readings), TRACK_STEPS)


def _resampling(seed: int, count: int) -> Work:
    key, log_weights = jax.random.key(seed), jax.random.normal(jax.random.key(1), (count,))
    others = {}
    if find_spec("blackjax"):
        theirs = jax.jit(import_module("blackjax.smc.resampling").systematic, static_argnums=2)
        others["blackjax"] = partial(theirs, key, jax.nn.softmax(log_weights), count)
    return Work(partial(systematic, key), (log_weights,), 1, others)


def _in_time(seed: int, length: int, *, parallel: bool) -> Work:
    """Smoothed means of a linear model of four states and two sensors."""
    problem = smoother_peers.linear(seed, 1)
    problem = problem._replace(readings=jax.random.normal(jax.random.key(seed), (length, problem.H.shape[0])))
    roots = [jnp.linalg.cholesky(C) for C in (problem.prior.covariance, problem.Q, problem.R)]
    prior = GaussianRoot(problem.prior.mean, roots[0])
    if not parallel:
        filter = kalman(prior, problem.F, roots[1], problem.H, roots[2], arithmetic=arithmetic.square_root)
        key = jax.random.key(seed)
        return Work(lambda y: filter_and_smooth(filter, key, y)[0].mean, (problem.readings,), length)
    model = LinearModel(problem.F, roots[1], problem.H, roots[2])

    def means(readings: Array) -> Array:
        return parallel_rts(parallel_kalman(prior, model, readings)[0], model).mean

    # Programs of other libraries hold the operator once a doubling, and take minutes to compile for long sequences.
    peers = {"dynamax": smoother_peers.dynamax_parallel, "cuthbert": smoother_peers.cuthbert_parallel}
    others = {name: of(problem) for name, of in peers.items() if find_spec(name) and length <= 100}
    return Work(means, (problem.readings,), 1, others)


def _hidden_markov(seed: int, count: int) -> Work:
    """Forward recursions of sequences of 100 symbols, 8 states."""
    model = hmm.random_model(seed)
    codes = hmm.draw(seed, model, count)
    scores = jax.vmap(HiddenMarkovModel.log_likelihoods, (None, -1), -1)(model, jnp.asarray(codes.T))
    others = {}
    if find_spec("dynamax") and (theirs := hmm_peers.dynamax(model, codes, codes, 1).forward):
        others["dynamax"] = theirs
    return Work(log_evidence_of_chains, (model, scores), codes.shape[1], others)


def tasks(seed: int) -> dict[str, Task]:
    """All, by name."""
    return {
        "depth_capsules": Task(partial(_depth, "capsules", seed), (512, 102_400), 8),
        "depth_mesh": Task(partial(_depth, "mesh", seed), (512,), 2),
        "depth_gradient": Task(partial(_depth_gradient, seed), (512,), 2),
        "bootstrap": Task(partial(_bootstrap, seed), (10**4, 10**5, 10**6, 10**7, 10**8), 1000),
        "bootstrap_gradient": Task(partial(_bootstrap, seed, gradient=True), (10**4, 10**6), 1000),
        "rao_blackwell": Task(partial(_rao_blackwell, seed, shared=False), (1000, 100_000), 50),
        "rao_blackwell_shared": Task(partial(_rao_blackwell, seed, shared=True), (1000, 100_000), 50),
        "tracks": Task(partial(_tracks, seed), (1000, 100_000), 20),
        "tracks_gradient": Task(partial(_tracks, seed, gradient=True), (1000, 100_000), 20),
        "resampling": Task(partial(_resampling, seed), (10**6, 8 * 10**6), 1000),
        # In float32, sums of more than 2**23 weights are not exact, and are refused.
        "resampling_float64": Task(partial(_resampling, seed), (10**6, 10**7), 1000, float64=True),
        "in_turn": Task(partial(_in_time, seed, parallel=False), (100, 1000, 10_000, 100_000, 1_000_000), 50),
        "in_parallel": Task(partial(_in_time, seed, parallel=True), (100, 1000, 10_000, 100_000, 1_000_000), 50),
        "hidden_markov": Task(partial(_hidden_markov, seed), (1000, 10_000), 50),
    }
