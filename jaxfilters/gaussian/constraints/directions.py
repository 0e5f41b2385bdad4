"""What a Gaussian belief says along one direction, and changes of it: the atoms of truncation, for both beliefs.

A change of the marginal of `normal^T x` from N(mean, deviation^2) to another Gaussian changes the whole belief by one
rank: nothing is factorised, inverted or downdated, and zero variances are welcome. Roots keep their width but not a
triangular shape.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.math import linalg

Belief = TypeVar("Belief", Gaussian, GaussianRoot)
Rest = ParamSpec("Rest")
Result = TypeVar("Result")


class Direction(NamedTuple):
    """The marginal of a belief along a normal, and how the belief hangs on it."""

    mean: Float[Array, "..."]
    """`normal^T mean`."""
    deviation: Float[Array, "..."]
    """Standard deviation s of `normal^T x`, at least 0."""
    gain: Float[Array, "..."]
    """(n,), `P normal / s`: how far x moves with `normal^T x`, per standard deviation; 0 where certain."""
    weight: Float[Array, "..."]
    """The gain again for a covariance; for a root (m,) the unit vector `root^T normal / s`."""
    certain: Bool[Array, "..."]
    """Whether s is no more than rounding of the belief."""
    rounding: Float[Array, "..."]
    """How far `normal^T x` may be off by rounding of the belief."""


def along(belief: Gaussian | GaussianRoot, normal: Float[Array, " n"]) -> Direction:
    """The belief along `normal`."""
    if isinstance(belief, GaussianRoot):
        # A sum of products, because a batch of products with thin matrices takes twice the time.
        turned = jnp.sum(normal[:, None] * belief.root, axis=0)
        deviation, deviations = linalg.safe_norm(turned), linalg.safe_norm(belief.root)
    else:
        turned = jnp.matmul(belief.covariance, normal, precision="highest")
        deviation = linalg.safe_sqrt(normal @ turned)
        deviations = linalg.safe_sqrt(jnp.diagonal(belief.covariance))
    floor = resolution(belief) * (abs(normal) @ deviations)
    certain = deviation <= floor
    weight = turned * jnp.where(certain, 0.0, 1 / jnp.where(certain, 1.0, deviation))
    gain = jnp.sum(belief.root * weight, axis=1) if isinstance(belief, GaussianRoot) else weight
    rounding = floor + _rounding(belief) * (abs(normal) @ abs(belief.mean))
    return Direction(normal @ belief.mean, deviation, gain, weight, certain, rounding)


def component(belief: GaussianRoot, index: Int[Array, ""]) -> Direction:
    """The belief along one axis, at less cost; certain where it has no variance at all."""
    row = belief.root[index]
    deviation = linalg.safe_norm(row)
    certain = deviation == 0
    weight = row * jnp.where(certain, 0.0, 1 / jnp.where(certain, 1.0, deviation))
    gain = jnp.sum(belief.root * weight, axis=1)
    return Direction(belief.mean[index], deviation, gain, weight, certain, jnp.zeros_like(deviation))


def reshape(belief: Belief, direction: Direction, shift: Float[Array, ""], ratio: Float[Array, ""]) -> Belief:
    """Belief whose marginal along the direction has moved by `shift` deviations and has `ratio` times its variance.

    What is uncorrelated with the direction stays as it was.
    """
    mean = belief.mean + shift * direction.gain
    if isinstance(belief, GaussianRoot):
        return GaussianRoot(
            mean, belief.root + (linalg.safe_sqrt(ratio) - 1) * jnp.outer(direction.gain, direction.weight)
        )
    return Gaussian(mean, belief.covariance + (ratio - 1) * jnp.outer(direction.gain, direction.weight))


def image(belief: Belief, normals: Float[Array, "k n"]) -> Belief:
    """Belief in `normals x`."""
    mean = normals @ belief.mean
    if isinstance(belief, GaussianRoot):
        return GaussianRoot(mean, linalg.matmul(normals, belief.root))
    return Gaussian(mean, linalg.matmul(linalg.matmul(normals, belief.covariance), normals.T))


def resolution(belief: Gaussian | GaussianRoot) -> float:
    """Standard deviation, relative to those it is combined from, up to which it may be rounding."""
    return _rounding(belief) if isinstance(belief, GaussianRoot) else _rounding(belief) ** 0.5


def _rounding(belief):
    return belief.mean.size * float(jnp.finfo(belief.mean.dtype).eps)


def compiled(function: Callable[Rest, Result]) -> Callable[Rest, Result]:
    """The function of a belief, compiled once for each kind of belief and each set of shapes.

    For JAX (0.10) any two dataclasses with as many fields are equal as trees, and once in some hundred times it runs
    what it has compiled for a covariance on a square root. So the kind is an argument of its own.
    """
    of_kind = jax.jit(lambda _kind, *args, **kwargs: function(*args, **kwargs), static_argnums=0)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        return of_kind(type(args[0]), *args, **kwargs)

    return call
