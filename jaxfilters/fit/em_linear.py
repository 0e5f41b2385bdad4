"""Expectation-maximisation of linear Gaussian models: the M-step in closed form."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxfilters._full_precision import einsum, tensordot
from jaxfilters.filter import Filter
from jaxfilters.fit.em_moments import (
    Imputed,
    Moments,
    Pairs,
    imputation,
    initial_moments,
    regression,
    residual_covariance,
)
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.linear import Kalman
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.math import linalg

LINEAR = ("F", "Q", "H", "R", "b", "d", "mean", "covariance")
"""What can be estimated of a linear model."""


def maximized(filter: Filter, found: Moments, free: tuple[str, ...], is_partial: bool) -> Filter:
    """The M-step: the filter with the free parameters of the greatest expected log density.

    Args:
        filter: A filter made by `kalman`.
        found: The E-step.
        free: Names of `LINEAR`.
        is_partial: Whether some frames were read in part.
    """
    model = filter.params
    change: dict[str, Any] = {}
    if {"F", "Q", "b"} & set(free):
        pairs, b = _transitions(found), _vectors(model.b, found)
        F, b = regression(pairs, model.F, b, ("F" in free, "b" in free))
        change |= {"F": F, "b": b, "Q": lambda: residual_covariance(pairs, F, b)}
    if {"H", "R", "d"} & set(free):
        readings, d = _observations(model, found, is_partial), _vectors(model.d, found)
        H, d = regression(readings, model.H, d, ("H" in free, "d" in free))
        change |= {"H": H, "d": d, "R": lambda: residual_covariance(readings, H, d)}
    change = {name: value for name, value in change.items() if name in free}
    for name in {"Q", "R"} & set(change):
        change[name] = from_covariance(model.prior, change[name]())
    return replace(filter, params=replace(model, prior=start(model.prior, found, free), **change))


def estimable(model: Kalman) -> tuple[str, ...]:
    """The names of `LINEAR` that can be estimated: not what is a function of the inputs, nor what that determines."""
    names = {"mean", "covariance"}
    for matrix, noise, vector in (("F", "Q", "b"), ("H", "R", "d")):
        if not callable(getattr(model, matrix)) and not callable(getattr(model, noise)):
            value = getattr(model, vector)
            names |= {matrix, noise} | (set() if value is None or callable(value) else {vector})
    return tuple(name for name in LINEAR if name in names)


def start(prior: Belief, found: Moments, free: tuple[str, ...]) -> Belief:
    """The prior with the mean and the covariance of the first states, where they are free."""
    mean, covariance = initial_moments(found, prior.mean, ("mean" in free, "covariance" in free))
    if "covariance" not in free:
        return replace(prior, mean=mean)
    return Gaussian(mean, covariance) if isinstance(prior, Gaussian) else GaussianRoot(mean, factor.root(covariance))


def from_covariance(prior: Belief, C: Array) -> Array:
    """A noise as the arithmetic of a prior writes it: a covariance, or a root of one."""
    return C if isinstance(prior, Gaussian) else factor.root(C)


def as_covariance(prior: Belief, noise: Array) -> Array:
    """The covariance of a noise that is written as the arithmetic of a prior has it."""
    return noise if isinstance(prior, Gaussian) else factor.outer(noise, noise)


def _vectors(value: Any, found: Moments) -> Array | None:
    """A vector of the model, or that of each frame, (f, n), where it is a function of the inputs."""
    return jax.vmap(value)(jax.tree.map(_flat, found.inputs)) if callable(value) else value


def _transitions(found: Moments) -> Pairs:
    weight = found.inside.ravel().astype(found.mean.dtype)
    total = lambda each: tensordot(weight, _flat(each), axes=1)
    P, cross = found.covariance, total(found.cross).T
    earlier, later = _flat(found.mean[:, :-1]), _flat(found.mean[:, 1:])
    return Pairs(weight, earlier, later, total(P[:, :-1]), cross, total(P[:, 1:]))


def _observations(model: Kalman, found: Moments, is_partial: bool) -> Pairs:
    y, read, x, P = (_flat(each) for each in (found.y, found.read, found.mean[:, 1:], found.covariance[:, 1:]))
    weight = jnp.any(read, axis=1).astype(x.dtype)
    covariance, (k, n) = tensordot(weight, P, axes=1), jnp.shape(_as_array(model.H))
    if not is_partial:
        return Pairs(weight, x, y, covariance, jnp.zeros((k, n), x.dtype), jnp.zeros((k, k), x.dtype))
    full = _imputed(model, found, y, read)
    target = full.g + einsum("fkn,fn->fk", full.G, x)
    cross = einsum("f,fkn,fnm->fkm", weight, full.G, P)
    spread = einsum("fkn,fln->kl", cross, full.G) + tensordot(weight, full.C, axes=1)
    return Pairs(weight, x, target, covariance, cross.sum(axis=0), spread)


def _imputed(model: Kalman, found: Moments, y: Array, read: Array) -> Imputed:
    R, d = as_covariance(model.prior, _as_array(model.R)), _vectors(model.d, found)
    d = jnp.broadcast_to(jnp.zeros((), y.dtype) if d is None else d, y.shape)

    def one(y: Array, read: Array, d: Array) -> Imputed:
        A, C = imputation(R, read)
        rest = jnp.eye(len(y), dtype=y.dtype) - A
        return Imputed(factor.apply(A, y) + factor.apply(rest, d), linalg.matmul(rest, _as_array(model.H)), C)

    return jax.vmap(one)(y, read, d)


def _as_array(matrix: Any) -> Array:
    """A matrix of the model, which is not a function of the inputs here: `em` refuses those to be estimated."""
    assert not callable(matrix)
    return matrix


def _flat(array: Array) -> Array:
    return array.reshape(-1, *array.shape[2:])
