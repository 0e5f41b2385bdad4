"""Expectation-maximisation of linear Gaussian models: the M-step in closed form."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

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
    transitions = _transitions(found)
    F, b = regression(transitions, model.F, model.b, ("F" in free, "b" in free))
    observations = _observations(model, found, is_partial)
    H, d = regression(observations, model.H, model.d, ("H" in free, "d" in free))
    Q = from_covariance(model.prior, residual_covariance(transitions, F, b)) if "Q" in free else model.Q
    R = from_covariance(model.prior, residual_covariance(observations, H, d)) if "R" in free else model.R
    prior = start(model.prior, found, free)
    return replace(filter, params=replace(model, prior=prior, F=F, Q=Q, H=H, R=R, b=b, d=d))


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


def _transitions(found: Moments) -> Pairs:
    weight = found.inside.ravel().astype(found.mean.dtype)
    total = lambda each: jnp.tensordot(weight, _flat(each), axes=1)
    P, cross = found.covariance, total(found.cross).T
    earlier, later = _flat(found.mean[:, :-1]), _flat(found.mean[:, 1:])
    return Pairs(weight, earlier, later, total(P[:, :-1]), cross, total(P[:, 1:]))


def _observations(model: Kalman, found: Moments, is_partial: bool) -> Pairs:
    y, read, x, P = (_flat(each) for each in (found.y, found.read, found.mean[:, 1:], found.covariance[:, 1:]))
    weight = jnp.any(read, axis=1).astype(x.dtype)
    covariance, (k, n) = jnp.tensordot(weight, P, axes=1), model.H.shape
    if not is_partial:
        return Pairs(weight, x, y, covariance, jnp.zeros((k, n), x.dtype), jnp.zeros((k, k), x.dtype))
    full = _imputed(model, y, read)
    target = full.g + jnp.einsum("fkn,fn->fk", full.G, x, precision="highest")
    cross = jnp.einsum("f,fkn,fnm->fkm", weight, full.G, P, precision="highest")
    spread = jnp.einsum("fkn,fln->kl", cross, full.G, precision="highest") + jnp.tensordot(weight, full.C, axes=1)
    return Pairs(weight, x, target, covariance, cross.sum(axis=0), spread)


def _imputed(model: Kalman, y: Array, read: Array) -> Imputed:
    R, d = as_covariance(model.prior, model.R), jnp.zeros(model.H.shape[0]) if model.d is None else model.d

    def one(y: Array, read: Array) -> Imputed:
        A, C = imputation(R, read)
        rest = jnp.eye(len(y), dtype=y.dtype) - A
        return Imputed(factor.apply(A, y) + factor.apply(rest, d), linalg.matmul(rest, model.H), C)

    return jax.vmap(one)(y, read)


def _flat(array: Array) -> Array:
    return array.reshape(-1, *array.shape[2:])
