"""Expectation-maximisation of nonlinear Gaussian models: expectations by sigma points of the smoothed states.

The points are those of the third-degree rule about the smoothed joint Gaussian of two neighbouring states (J. Kokkala,
A. Solin and S. Särkkä, "Sigma-point filtering and smoothing based parameter estimation in nonlinear dynamic systems",
Journal of Advances in Information Fusion 11(1), 2016).
"""

import math
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jaxfilters._full_precision import einsum, tensordot
from jaxfilters.filter import Filter
from jaxfilters.fit.em_linear import as_covariance, from_covariance, start
from jaxfilters.fit.em_moments import Moments, imputation
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.extended import ExtendedKalman
from jaxfilters.gaussian.noise_models import NonAdditiveNoise, StateNoise
from jaxfilters.math import linalg

NONLINEAR = ("transition", "process_noise", "observe", "observation_noise", "mean", "covariance")
"""What can be estimated of a nonlinear model."""
_HALVINGS = 5


def estimable(model: ExtendedKalman) -> tuple[str, ...]:
    """The names of `NONLINEAR` that can be estimated: noises that are matrices and additive, functions with arrays."""
    names = {"mean", "covariance"}
    for function, noise in (("transition", "process_noise"), ("observe", "observation_noise")):
        callback, matrix = getattr(model, function), getattr(model, noise)
        if isinstance(callback, NonAdditiveNoise) or isinstance(matrix, StateNoise):
            continue
        if not callable(matrix):
            names.add(noise)
        if jax.tree.leaves(callback) and (not callable(matrix) or function == "transition"):
            names.add(function)
    return tuple(name for name in NONLINEAR if name in names)


def maximized(filter: Filter, found: Moments, free: tuple[str, ...], is_partial: bool) -> Filter:
    """The M-step: noises in closed form; parameters of functions by a Gauss-Newton step, exact where they are linear.

    Of observations read in part, the rest is missing data for the noise, and is left out for the function.

    Args:
        filter: A filter made by `extended_kalman`.
        found: The E-step.
        free: Names of `NONLINEAR`.
        is_partial: Whether some frames were read in part.
    """
    model = filter.params
    del is_partial
    prior = start(model.prior, found, free)
    transition, Q = _transition_step(model, found, free)
    observe, R = _observation_step(model, found, free)
    return replace(
        filter,
        params=replace(
            model, prior=prior, transition=transition, process_noise=Q, observe=observe, observation_noise=R
        ),
    )


def _transition_step(model, found, free):
    if not {"transition", "process_noise"} & set(free):
        return model.transition, model.process_noise
    weight = found.inside.ravel().astype(found.mean.dtype)
    n = found.mean.shape[-1]
    pairs = jax.vmap(_joint_points)(*(_flat(each) for each in _neighbours(found)))
    inputs = jax.tree.map(_flat, found.inputs)

    def residual(transition: Callable, pair: Array, u: PyTree) -> Array:
        return pair[n:] - transition(pair[:n], u)

    transition = model.transition
    if "transition" in free:
        noises = _process_noises(model, inputs, len(weight))
        whiten = jax.vmap(factor.root)(noises)
        transition = _improved(transition, residual, pairs, inputs, whiten, weight)
    if "process_noise" not in free:
        return transition, model.process_noise
    errors = _residuals(transition, residual, pairs, inputs)
    Q = einsum("f,fpk,fpl->kl", weight, errors, errors) / (weight.sum() * pairs.shape[1])
    return transition, from_covariance(model.prior, Q)


def _observation_step(model, found, free):
    if not {"observe", "observation_noise"} & set(free):
        return model.observe, model.observation_noise
    y, read = _flat(found.y), _flat(found.read)
    weight = jnp.any(read, axis=1).astype(found.mean.dtype)
    points = jax.vmap(_points)(_flat(found.mean[:, 1:]), _flat(found.covariance[:, 1:]))
    R = as_covariance(model.prior, model.observation_noise)
    A, C = jax.vmap(imputation, in_axes=(None, 0))(R, read)

    def residual(observe: Callable, x: Array, data: tuple) -> Array:
        y, read, A, inputs = data
        y_hat = observe(x, inputs)
        return factor.apply(A, jnp.where(read, model.residual(jnp.where(read, y, y_hat), y_hat), 0.0))

    observe, data = model.observe, (y, read, A, jax.tree.map(_flat, found.inputs))
    if "observe" in free:
        among = jnp.where(read[:, :, None] & read[:, None], R, 0.0)
        observe = _improved(observe, residual, points, data, jax.vmap(factor.root)(among), weight)
    if "observation_noise" not in free:
        return observe, model.observation_noise
    errors = _residuals(observe, residual, points, data)
    total = einsum("f,fpk,fpl->kl", weight, errors, errors) / points.shape[1]
    R = (total + tensordot(weight, C, axes=1)) / weight.sum()
    return observe, from_covariance(model.prior, R)


def _improved(function, residual, points, data, roots, weight):
    """The function with parameters after a Gauss-Newton step, halved until the expected cost is no larger."""
    theta, restore = ravel_pytree(function)

    def whitened(theta: Array, points: Array, data: PyTree, root: Array) -> Array:
        return jax.vmap(lambda x: linalg.solve_triangular(root, residual(restore(theta), x, data)))(points)

    def normal(points: Array, data: PyTree, root: Array, weight: Array) -> tuple[Array, Array]:
        J = jax.jacfwd(whitened)(theta, points, data, root).reshape(-1, theta.size)
        error = whitened(theta, points, data, root).ravel()
        return weight * factor.inner(J, J), weight * factor.apply(J.T, error)

    square, slope = (jnp.sum(each, axis=0) for each in jax.vmap(normal)(points, data, roots, weight))
    scale = jnp.sqrt(jnp.diagonal(square))
    scale = jnp.where(scale > 0, scale, 1.0)
    root = factor.root(square / scale / scale[:, None])
    step = linalg.solve_triangular(root, linalg.solve_triangular(root, slope / scale), transpose=True) / scale

    def cost(length: Array) -> Array:
        each = jax.vmap(whitened, in_axes=(None, 0, 0, 0))(theta - length * step, points, data, roots)
        return jnp.sum(weight[:, None, None] * each**2)

    lengths = jnp.append(0.5 ** jnp.arange(_HALVINGS, dtype=theta.dtype), 0.0)
    costs = jax.lax.map(cost, lengths)
    return restore(theta - lengths[jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))] * step)


def _residuals(function, residual, points, data):
    return jax.vmap(lambda points, data: jax.vmap(lambda x: residual(function, x, data))(points))(points, data)


def _process_noises(model, inputs, count):
    if not callable(model.process_noise):
        noise = as_covariance(model.prior, model.process_noise)
        return jnp.broadcast_to(noise, (count, *noise.shape))
    return jax.vmap(lambda u: as_covariance(model.prior, model.process_noise_of(model.prior, u)))(inputs)


def _neighbours(found):
    return found.mean[:, :-1], found.mean[:, 1:], found.covariance[:, :-1], found.covariance[:, 1:], found.cross


def _joint_points(mean, next_mean, P, next_P, cross) -> Float[Array, "p k"]:
    joint = jnp.block([[P, cross], [cross.T, next_P]])
    return _points(jnp.concatenate([mean, next_mean]), joint)


def _points(mean, P) -> Float[Array, "p k"]:
    offsets = math.sqrt(mean.size) * factor.root(P).T
    return jnp.concatenate([mean + offsets, mean - offsets])


def _flat(array: Array) -> Array:
    return array.reshape(-1, *array.shape[2:])
