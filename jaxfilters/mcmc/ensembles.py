"""What sequential Monte Carlo samplers of parameters share: their start, their moves, their result."""

import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.parametrization import Parametrization, parametrize
from jaxfilters.mcmc import checks
from jaxfilters.mcmc.metropolis import MetropolisInfo, Point, accept
from jaxfilters.mcmc.proposals import OPTIMAL_SCALE, check_floating, is_admissible, step_in_chart
from jaxfilters.particle.checks import concrete
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey, SamplePrior

_FLOOR = 1e-6
"""Share of the variance by which the diagonal of the proposal's covariance is raised."""


class SMCStatus(enum.IntEnum):
    """How a sampler ended; under `jit` and `vmap` the evidence is NaN unless it is `FINISHED` or `NO_WEIGHT`."""

    FINISHED = 0
    NO_WEIGHT = 1
    OUTSIDE_SUPPORT = 2
    CONSTRAINT = 3
    INVALID_DENSITY = 4
    UNFINISHED = 5
    SCHEDULE = 6

    @property
    def reason(self) -> str:
        """The condition that was violated, for messages."""
        return _REASONS[self]


_REASONS = {
    SMCStatus.FINISHED: "",
    SMCStatus.NO_WEIGHT: "log_likelihood must be finite for at least one draw of sample_prior; got -inf for all",
    SMCStatus.OUTSIDE_SUPPORT: "sample_prior must draw parameters with a finite log_prior; got -inf for some draws",
    SMCStatus.CONSTRAINT: "sample_prior must draw parameters that satisfy the constraints; some draws do not",
    SMCStatus.INVALID_DENSITY: "log_prior and log_likelihood must be neither NaN nor +inf; they are for some draws",
    SMCStatus.UNFINISHED: "max_stages of adaptive_temperatures must be larger: they ended before the temperature 1",
    SMCStatus.SCHEDULE: "temperatures must increase strictly within (0, 1] and end at 1",
}


class SMCPosterior(NamedTuple):
    """Weighted parameters, and the evidence of the model."""

    theta: PyTree
    """Leaves `(..., n)`."""
    log_weights: Float[Array, " n"]
    """They sum to one."""
    log_evidence: Float[Array, ""]
    """Log of the estimated evidence, p(observations), the likelihood averaged over the prior."""
    info: PyTree
    """Diagnostics of the stages: a `TemperingInfo` or an `SMC2Info`."""
    status: Int32[Array, ""]
    """An `SMCStatus`."""


@pytree_dataclass
class Target:
    """A posterior in two factors, and its coordinates."""

    log_prior: Callable[[PyTree], Array]
    evaluate: Callable[[AnyKey, PyTree], tuple[Array, PyTree]]
    """`(key, theta) -> (log_likelihood, auxiliary)`."""
    parametrization: Parametrization

    def point(self, key: AnyKey, theta: PyTree) -> Point:
        """Parameters with their densities."""
        log_likelihood, auxiliary = self.evaluate(key, theta)
        log_prior = checks.scalar("log_prior", self.log_prior(theta))
        return Point(theta, log_prior, checks.scalar("log_likelihood", log_likelihood), auxiliary)


def prior_draws(
    key: AnyKey, sample_prior: SamplePrior, constraints: PyTree, count: int
) -> tuple[PyTree, Parametrization]:
    """Parameters from the prior, leaves `(..., n)`, and coordinates about the first of them."""
    theta = jax.tree.map(jnp.asarray, sample_ensemble(key, sample_prior, count))
    parametrization = parametrize(jax.tree.map(lambda leaf: leaf[..., 0], theta), constraints)
    check_floating(theta, parametrization.constraints)
    return theta, parametrization


def points(key: AnyKey, target: Target, theta: PyTree) -> Point:
    """Parameters of an ensemble with their densities."""
    keys = jax.random.split(key, checks.num_chains(theta))
    return jax.vmap(target.point, in_axes=(0, -1), out_axes=-1)(keys, theta)


def status_of_start(target: Target, start: Point) -> Int32[Array, ""]:
    """Whether a sampler can start at draws from the prior."""
    chart = target.parametrization

    def admissible(theta: PyTree) -> Array:
        return is_admissible(Parametrization(theta, chart.constraints))

    def invalid(log_density: Array) -> Array:
        return jnp.any(jnp.isnan(log_density) | jnp.isposinf(log_density))

    faults = {
        SMCStatus.INVALID_DENSITY: invalid(start.log_prior) | invalid(start.log_likelihood),
        SMCStatus.OUTSIDE_SUPPORT: jnp.any(start.log_prior == -jnp.inf),
        SMCStatus.CONSTRAINT: ~jnp.all(jax.vmap(admissible, in_axes=-1)(start.theta)),
    }
    status = jnp.full((), SMCStatus.FINISHED, jnp.int32)
    for number, found in faults.items():
        status = jnp.where(found, number, status)
    return status


def root_of(target: Target, theta: PyTree, log_weights: Float[Array, " n"]) -> Float[Array, "d d"]:
    """Root of the covariance of random-walk steps: that of the weighted ensemble, scaled as for a Gaussian target."""
    z = jax.vmap(target.parametrization.unconstrain, in_axes=-1, out_axes=-1)(theta)
    covariance = weights.covariance(z, log_weights)
    spread = jnp.maximum(jnp.diagonal(covariance), jnp.finfo(z.dtype).tiny)
    root = jnp.linalg.cholesky(covariance + _FLOOR * jnp.diag(spread))
    # Rounding may leave a nearly singular covariance indefinite: then the coordinates are moved independently.
    root = jnp.where(jnp.all(jnp.isfinite(root)), root, jnp.diag(jnp.sqrt(spread)))
    return OPTIMAL_SCALE / max(z.shape[0], 1) ** 0.5 * root


def metropolis(
    key: AnyKey, target: Target, ensemble: Point, root: Float[Array, "d d"], temperature: Array | float
) -> tuple[Point, MetropolisInfo]:
    """One random-walk Metropolis step of every member of an ensemble, whose axis is the last one."""

    def one(key: AnyKey, old: Point) -> tuple[Point, MetropolisInfo]:
        propose_key, evaluate_key, accept_key = jax.random.split(key, 3)
        theta, log_correction = step_in_chart(propose_key, target.parametrization, root, old.theta)
        return accept(accept_key, old, target.point(evaluate_key, theta), log_correction, temperature)

    keys = jax.random.split(key, ensemble.log_prior.shape[-1])
    return jax.vmap(one, in_axes=(0, -1), out_axes=-1)(keys, ensemble)


def taken(tree: PyTree, indices: Int32[Array, " m"]) -> PyTree:
    """The members of an ensemble with these indices."""
    return jax.tree.map(lambda leaf: jnp.take(leaf, indices, axis=-1, mode="clip"), tree)


def announced(posterior: SMCPosterior) -> SMCPosterior:
    """The posterior, without an evidence where it is none; where its status is known, an error instead.

    Raises:
        ValueError: If the sampler did not finish.
    """
    status = concrete(posterior.status)
    if status is not None and np.ndim(status) == 0 and status != SMCStatus.FINISHED:
        raise ValueError(f"{SMCStatus(int(status)).reason}.")
    known = (posterior.status == SMCStatus.FINISHED) | (posterior.status == SMCStatus.NO_WEIGHT)
    return posterior._replace(log_evidence=jnp.where(known, posterior.log_evidence, jnp.nan))
