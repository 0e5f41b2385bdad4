"""Marginals of a Gaussian belief along a direction, and rank-one changes of the belief that change such a marginal.

A change of the marginal of `normal^T x` from N(mean, deviation^2) to another Gaussian changes the whole belief by one
rank. No matrix is factorised, inverted or downdated, and variances may be zero. Roots keep their width but not a
triangular shape.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters._full_precision import dot
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.math import linalg

Belief = TypeVar("Belief", Gaussian, GaussianRoot)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class Direction(NamedTuple):
    """The marginal of a belief along a normal, and the covariance of the state with it."""

    mean: Float[Array, "..."]
    """`normal^T mean`."""
    deviation: Float[Array, "..."]
    """Standard deviation s of `normal^T x`, at least 0."""
    gain: Float[Array, "..."]
    """(n,), `P normal / s`: the change of E[x] when `normal^T x` changes by one standard deviation; 0 where certain."""
    weight: Float[Array, "..."]
    """The gain again for a covariance; for a root (m,) the unit vector `root^T normal / s`."""
    certain: Bool[Array, "..."]
    """Whether s is no larger than the rounding error of the belief."""
    rounding: Float[Array, "..."]
    """Bound of the rounding error of `normal^T x`."""
    noise: Float[Array, "..."]
    """Bound of the relative rounding error of the variance s^2."""
    axis: Bool[Array, "..."]
    """(n,), True for the component that the normal is parallel to, if any."""


def along(belief: Gaussian | GaussianRoot, normal: Float[Array, " n"]) -> Direction:
    """Marginal of the belief along `normal`, (n,)."""
    if isinstance(belief, GaussianRoot):
        # A sum of products, because a batch of products with thin matrices takes twice the time.
        turned = jnp.sum(normal[:, None] * belief.root, axis=0)
        deviation, deviations = linalg.safe_norm(turned), linalg.safe_norm(belief.root)
    else:
        turned = jnp.matmul(belief.covariance, normal, precision="highest")
        deviation = linalg.safe_sqrt(dot(normal, turned))
        deviations = linalg.safe_sqrt(jnp.diagonal(belief.covariance))
    floor = resolution(belief) * dot(abs(normal), deviations)
    certain = deviation <= floor
    weight = turned * jnp.where(certain, 0.0, 1 / jnp.where(certain, 1.0, deviation))
    gain = jnp.sum(belief.root * weight, axis=1) if isinstance(belief, GaussianRoot) else weight
    rounding = floor + _rounding(belief) * dot(abs(normal), abs(belief.mean))
    share = floor / jnp.where(certain, 1.0, deviation)
    noise = 2 * share if isinstance(belief, GaussianRoot) else share**2
    axis = (normal != 0) & (jnp.sum(normal != 0) == 1) & ~certain
    return Direction(dot(normal, belief.mean), deviation, gain, weight, certain, rounding, noise, axis)


def component(belief: GaussianRoot, index: Int[Array, ""]) -> Direction:
    """Marginal of one component, at less cost than `along`; certain where its variance is exactly zero."""
    row = belief.root[index]
    deviation = linalg.safe_norm(row)
    certain = deviation == 0
    weight = row * jnp.where(certain, 0.0, 1 / jnp.where(certain, 1.0, deviation))
    gain = jnp.sum(belief.root * weight, axis=1)
    zero = jnp.zeros_like(deviation)
    axis = (jnp.arange(len(belief.root)) == index) & ~certain
    return Direction(belief.mean[index], deviation, gain, weight, certain, zero, zero, axis)


def reshape(belief: Belief, direction: Direction, shift: Float[Array, ""], ratio: Float[Array, ""]) -> Belief:
    """Belief whose marginal along the direction has a changed mean and variance.

    Components that are uncorrelated with the direction keep their marginals.

    Args:
        belief: The belief that `direction` was computed from.
        direction: The marginal to change.
        shift: Change of its mean in standard deviations.
        ratio: New variance over old variance.
    """
    mean = belief.mean + shift * direction.gain
    # A component that the normal is parallel to is scaled: the difference would lose a small variance to rounding.
    axis = direction.axis
    if isinstance(belief, GaussianRoot):
        scale = linalg.safe_sqrt(ratio)
        changed = belief.root + (scale - 1) * jnp.outer(direction.gain, direction.weight)
        return GaussianRoot(mean, jnp.where(axis[:, None], scale * belief.root, changed))
    changed = belief.covariance + (ratio - 1) * jnp.outer(direction.gain, direction.weight)
    return Gaussian(mean, jnp.where(axis[:, None] | axis, ratio * belief.covariance, changed))


def image(belief: Belief, normals: Float[Array, "k n"]) -> Belief:
    """Belief in `normals x`, (k,), for normals (k, n)."""
    mean = dot(normals, belief.mean)
    if isinstance(belief, GaussianRoot):
        return GaussianRoot(mean, linalg.matmul(normals, belief.root))
    return Gaussian(mean, linalg.matmul(linalg.matmul(normals, belief.covariance), normals.T))


def resolution(belief: Gaussian | GaussianRoot) -> float:
    """Largest standard deviation that may be rounding error, relative to the deviations that it is computed from."""
    return _rounding(belief) if isinstance(belief, GaussianRoot) else _rounding(belief) ** 0.5


def _rounding(belief):
    return belief.mean.size * float(jnp.finfo(belief.mean.dtype).eps)


def compiled(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function whose first argument is a belief once for each class of belief and each set of shapes.

    Two registered dataclasses with equally many fields can compare equal as trees, and JAX 0.10 occasionally runs on a
    root what it compiled for a covariance. The class is therefore a static argument of its own.
    """
    of_kind = jax.jit(lambda _kind, *args, **kwargs: function(*args, **kwargs), static_argnums=0)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return of_kind(type(args[0]), *args, **kwargs)

    return call
