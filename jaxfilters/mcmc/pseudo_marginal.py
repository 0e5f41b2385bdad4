r"""Correlated pseudo-marginal likelihoods: a bootstrap filter as a function of its random numbers.

All random numbers of the filter are standard normal and part of the chain. A step moves them little, so that the errors
of the two estimates in an acceptance ratio largely cancel, and far fewer particles do than with independent errors
(G. Deligiannidis, A. Doucet and M. K. Pitt, "The correlated pseudomarginal method", Journal of the Royal Statistical
Society B 80, 2018; J. Dahlin, F. Lindsten, J. Kronander and T. B. Schon, "Accelerating pseudo-marginal
Metropolis-Hastings by correlating auxiliary variables", 2015). The estimate must depend smoothly on the numbers, hence
the particles are sorted before they are resampled by a grid.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.math import linalg
from jaxfilters.mcmc import checks
from jaxfilters.mcmc.conditional_resampling import systematic_at
from jaxfilters.noise import StandardNormal
from jaxfilters.particle import checks as particle_checks
from jaxfilters.particle.bootstrap import Bootstrap
from jaxfilters.priors import FromNoise, GaussianPrior
from jaxfilters.typing import AnyKey, as_pytree


class FilterNoise(NamedTuple):
    """The random numbers of a bootstrap filter over a sequence, all standard normal."""

    prior: Float[Array, "..."]
    """Of the particles before the first observation, (..., n)."""
    transitions: Float[Array, "..."]
    """Of the particles in each frame, (t, ..., n)."""
    offsets: Float[Array, " t"]
    """Of the grid by which each frame resamples."""


@pytree_dataclass
class CorrelatedLikelihood:
    """The likelihood that a bootstrap filter estimates, with its random numbers; made by `correlated`."""

    filter_of: Callable[[PyTree], Filter]
    observations: PyTree
    inputs: PyTree
    mask: PyTree
    correlation: ArrayLike
    sort_by: Callable[[PyTree], Array]

    def draw(self, key: AnyKey, theta: PyTree) -> FilterNoise:
        """Independent numbers."""
        model = _model_of(self.filter_of(theta))
        shape, _ = _prior_of_noise(model)
        length, count = checks.shared_length(observations=self.observations), model.num_particles
        prior_key, transition_key, offset_key = jax.random.split(key, 3)
        return FilterNoise(
            jax.random.normal(prior_key, (*shape, count)),
            jax.random.normal(transition_key, (length, *_shape_of(_checked_noise(model)), count)),
            jax.random.normal(offset_key, (length,)),
        )

    def perturb(self, key: AnyKey, numbers: FilterNoise) -> FilterNoise:
        """A step of a Crank-Nicolson (first-order autoregressive) chain."""
        rho = self.correlation
        keys = FilterNoise(*jax.random.split(key, len(numbers)))

        def mixed(key: AnyKey, old: Array) -> Array:
            fresh = jax.random.normal(key, old.shape, old.dtype)
            return jnp.asarray(rho * old + jnp.sqrt(1 - jnp.square(rho)) * fresh, old.dtype)

        return jax.tree.map(mixed, keys, numbers)

    def evaluate(self, numbers: FilterNoise, theta: PyTree) -> Float[Array, ""]:
        """Log of the estimate, an exact function of the numbers."""
        model = _model_of(self.filter_of(theta))
        _, transform = _prior_of_noise(model)
        particles = transform(numbers.prior)
        _check_order(self.sort_by, particles)
        start = particles, weights.uniform(model.num_particles)
        frames = numbers.transitions, numbers.offsets, self.observations, self.inputs, self.mask
        _, log_evidences = jax.lax.scan(_frame(model, self.sort_by), start, frames)
        return jnp.sum(log_evidences)


def correlated(
    filter_of: Callable[[PyTree], Filter],
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
    correlation: ArrayLike = 0.99,
    sort_by: Callable[[PyTree], Array] | None = None,
) -> CorrelatedLikelihood:
    """Build the correlated estimate of a likelihood, for `pmmh`.

    Args:
        filter_of: `theta -> Filter`, made by `bootstrap` with `noise=StandardNormal(...)` and a `sample_prior` by
            `priors.gaussian_prior`, or by `priors.from_noise` of a `StandardNormal`. It resamples before every frame.
        observations: Pytree whose leaves have time as their first axis, (t, ...).
        inputs: Pytree of known inputs, time first, or `None`.
        mask: Booleans (t,), `False` for frames without an observation.
        correlation: Correlation of the random numbers before and after a step, in [0, 1): 0 is the independent
            pseudo-marginal method. The less time and the more particles, the further from 1 it may be.
        sort_by: `x -> number` by which particles are sorted; the state itself if it is one number. Particles that are
            near in this order should be near in the state: for a state of several numbers, one that matters most, or
            the position along a space-filling curve.

    Returns:
        A likelihood for `pmmh`.

    Raises:
        TypeError: If `filter_of` or `sort_by` is not callable.
        ValueError: If `correlation` is not in [0, 1), or the lengths of the sequences differ; and when it is traced, if
            a filter was not made as above, or `sort_by` is missing for a state of several numbers.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior = jf.priors.gaussian_prior(jf.Gaussian(jnp.zeros(1), jnp.eye(1)))
        >>> def filter_of(noise):
        ...     return jf.bootstrap(
        ...         prior, lambda e, x: 0.9 * x + noise * e, lambda x, y: jax.scipy.stats.norm.logpdf(y, x[0]),
        ...         num_particles=20, noise=jf.StandardNormal(1))
        >>> likelihood = jf.mcmc.correlated(filter_of, jnp.array([0.3, 0.5, 0.1]))
        >>> sampler = jf.mcmc.pmmh(
        ...     likelihood, jax.scipy.stats.expon.logpdf, proposal=jf.mcmc.random_walk(jf.fit.positive))
    """
    particle_checks.check_callables(filter_of=filter_of, sort_by=sort_by)
    particle_checks.check_scalar("correlation", correlation, "in [0, 1)", lambda rho: 0 <= rho < 1)
    checks.shared_length(observations=observations, inputs=inputs, mask=mask)
    order = as_pytree(_only_number if sort_by is None else sort_by)
    return CorrelatedLikelihood(as_pytree(filter_of), observations, inputs, mask, correlation, order)


def _frame(model: Bootstrap, sort_by: Callable[[PyTree], Array]) -> Callable:
    move = jax.vmap(particle_checks.checked_transition(model.sample_transition), in_axes=(-1, -1, None), out_axes=-1)
    likelihoods = jax.vmap(particle_checks.checked_log_likelihood(model.log_likelihood), in_axes=(-1, None, None))
    order_of = jax.vmap(sort_by, in_axes=-1)

    def frame(carry: tuple, given: tuple) -> tuple[tuple, Array]:
        particles, log_weights = carry
        noise, offset, observation, inputs, is_observed = given
        order = jnp.argsort(order_of(particles))
        chosen = order[systematic_at(jax.scipy.stats.norm.cdf(offset), log_weights[order])]
        moved = move(noise, jax.tree.map(lambda leaf: leaf[..., chosen], particles), inputs)
        if is_observed is not None:
            observation = jax.tree.map(lambda y: jnp.where(is_observed, y, jnp.zeros_like(y)), observation)
        log_factor = likelihoods(moved, observation, inputs)
        log_factor = log_factor if is_observed is None else jnp.where(is_observed, log_factor, 0.0)
        after, log_sum = weights.normalize(log_factor)
        # A NaN is the caller's to report, not to average.
        log_evidence = jnp.where(jnp.any(jnp.isnan(log_factor)), jnp.nan, log_sum - math.log(log_factor.size))
        return (moved, after), log_evidence

    return frame


def _model_of(filter: Filter) -> Bootstrap:
    checks.check_bootstrap(filter, "the result of filter_of")
    _checked_noise(filter.params)
    return filter.params


def _checked_noise(model: Bootstrap) -> StandardNormal:
    if not isinstance(model.noise, StandardNormal):
        raise ValueError(f"noise of the filter must be StandardNormal(...); got {model.noise!r}.")
    return model.noise


def _shape_of(noise: StandardNormal) -> tuple[int, ...]:
    return (noise.shape,) if isinstance(noise.shape, int) else noise.shape


def _prior_of_noise(model: Bootstrap) -> tuple[tuple[int, ...], Callable[[Array], PyTree]]:
    """The shape of the numbers of one particle of the prior, and the ensemble as a function of all of them."""
    prior = model.sample_prior
    if isinstance(prior, GaussianPrior):
        mean, covariance = prior.belief.mean, prior.belief.covariance
        root = linalg.cholesky(covariance)
        return mean.shape, lambda noise: mean[:, None] + jnp.matmul(root, noise, precision="highest")
    if isinstance(prior, FromNoise) and isinstance(prior.noise, StandardNormal):
        return _shape_of(prior.noise), jax.vmap(prior.transform, in_axes=-1, out_axes=-1)
    raise ValueError(
        "sample_prior of the filter must be priors.gaussian_prior(...), or priors.from_noise(...) of a StandardNormal; "
        f"got {prior!r}."
    )


def _only_number(x: PyTree) -> Array:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(x)])[0]


def _check_order(sort_by: Callable[[PyTree], Array], particles: PyTree) -> None:
    numbers = sum(math.prod(jnp.shape(leaf)[:-1]) for leaf in jax.tree.leaves(particles))
    if getattr(sort_by, "func", None) is _only_number and numbers != 1:
        raise ValueError(f"sort_by must be given for a state of several numbers; got none for {numbers} numbers.")
