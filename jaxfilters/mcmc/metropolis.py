"""Metropolis-Hastings with an estimated likelihood: particle marginal Metropolis-Hastings, with its special cases."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.mcmc import checks
from jaxfilters.mcmc.chains import Fault, Sampler
from jaxfilters.mcmc.proposals import Proposal, random_walk
from jaxfilters.particle.checks import check_callables
from jaxfilters.typing import AnyKey, as_pytree


class Point(NamedTuple):
    """Parameters with their densities, and what the estimate of the likelihood leaves behind."""

    theta: PyTree
    log_prior: Float[Array, ""]
    log_likelihood: Float[Array, ""]
    auxiliary: PyTree = ()
    """Random numbers or states that belong to the estimate of the likelihood, and are accepted with it."""


class MetropolisInfo(NamedTuple):
    """Diagnostics of one step."""

    accepted: Bool[Array, ""]
    acceptance_probability: Float[Array, ""]
    invalid: Bool[Array, ""]
    """Whether a log density was NaN or `+inf` where the prior has density, or the proposal drew parameters to which it
    gives none; the step was rejected."""


class MetropolisState(NamedTuple):
    """A chain of `pmmh`."""

    point: Point
    adaptation: PyTree
    """State of the proposal."""

    @property
    def theta(self) -> PyTree:
        """The parameters."""
        return self.point.theta


@runtime_checkable
class RandomLikelihood(Protocol):
    """An unbiased estimate of a likelihood as a function of its random numbers, which are part of the chain."""

    def draw(self, key: AnyKey, theta: PyTree, /) -> PyTree:
        """Random numbers from their own distribution."""
        ...

    def perturb(self, key: AnyKey, numbers: PyTree, /) -> PyTree:
        """Random numbers from a kernel that is reversible with respect to their distribution."""
        ...

    def evaluate(self, numbers: PyTree, theta: PyTree, /) -> Array:
        """Logarithm of the estimate."""
        ...


@pytree_dataclass
class FreshKeys:
    """An estimate with a new random key in every step."""

    log_likelihood: Callable[[AnyKey, PyTree], Array]

    def draw(self, key: AnyKey, theta: PyTree) -> AnyKey:
        """The key."""
        del theta
        return key

    def perturb(self, key: AnyKey, numbers: AnyKey) -> AnyKey:
        """A new key."""
        del numbers
        return key

    def evaluate(self, numbers: AnyKey, theta: PyTree) -> Array:
        """The estimate with this key."""
        return self.log_likelihood(numbers, theta)


@pytree_dataclass
class MarginalMetropolis:
    """Parameters of `pmmh`."""

    likelihood: RandomLikelihood
    log_prior: Callable[[PyTree], Array]
    proposal: Proposal


def pmmh(
    log_likelihood: Callable[[AnyKey, PyTree], Array] | RandomLikelihood,
    log_prior: Callable[[PyTree], Array],
    *,
    proposal: Proposal | None = None,
) -> Sampler:
    """Build a particle marginal Metropolis-Hastings sampler.

    It targets the exact posterior, whatever the variance of the estimate, as long as the likelihood, not its logarithm,
    is estimated without bias (Andrieu, Doucet and Holenstein 2010, section 2.4.2; C. Andrieu and G. Roberts, "The
    pseudo-marginal approach", Annals of Statistics 37, 2009). Chains mix well where the standard deviation of the log
    likelihood is about 1.2 (A. Doucet, M. Pitt, G. Deligiannidis and R. Kohn, Biometrika 102, 2015). A likelihood that
    ignores its key is exact, and the sampler an ordinary Metropolis-Hastings one.

    Args:
        log_likelihood: `(key, theta) -> log of an unbiased estimate`, e.g.
            `lambda key, theta: jf.log_evidence(filter_of(theta), key, ys)`; or what `correlated` returns.
        log_prior: `theta -> log p(theta)`, a density of theta itself, up to a constant; `-inf` where there is none.
        proposal: What `random_walk` or `proposal` returns; a random walk of unconstrained numbers by default.

    Returns:
        A sampler for `init`, `warm_up` and `sample`, whose info is a `MetropolisInfo`.

    Raises:
        TypeError: If an argument is not callable or no proposal.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> def filter_of(noise):
        ...     return jf.bootstrap(
        ...         lambda key: jax.random.normal(key), lambda e, x: x + noise * e[0],
        ...         lambda x, y: jax.scipy.stats.norm.logpdf(y, x, 0.5), num_particles=50, noise=jf.StandardNormal(1))
        >>> ys = jnp.array([0.1, 0.8, 1.4, 0.9, 1.8])
        >>> sampler = jf.mcmc.pmmh(
        ...     lambda key, noise: jf.log_evidence(filter_of(noise), key, ys),
        ...     jax.scipy.stats.expon.logpdf, proposal=jf.mcmc.random_walk(jf.fit.positive, step=0.5))
        >>> state = jf.mcmc.init(jax.random.key(0), sampler, jnp.ones(2))
        >>> state, draws = jf.mcmc.sample(jax.random.key(1), sampler, state, 50)
        >>> draws.theta.shape
        (50, 2)
    """
    proposal = random_walk() if proposal is None else proposal
    check_callables(log_prior=log_prior)
    if not all(callable(getattr(proposal, name, None)) for name in ("init", "propose", "adapt")):
        raise TypeError(f"proposal must be what random_walk or proposal returns; got {proposal!r}.")
    if not isinstance(log_likelihood, RandomLikelihood):
        check_callables(log_likelihood=log_likelihood)
        log_likelihood = FreshKeys(as_pytree(log_likelihood))
    return Sampler(MarginalMetropolis(log_likelihood, as_pytree(log_prior), proposal), _init, _warm_up, _step)


def metropolis_update(
    log_density: Callable[[PyTree, PyTree], Array], *, proposal: Proposal | None = None, num_steps: int = 1
) -> Callable[[AnyKey, PyTree, PyTree], PyTree]:
    """Build an update of parameters given a trajectory by Metropolis-Hastings steps, for `particle_gibbs`.

    Args:
        log_density: `(theta, path) -> log p(theta) + log p(path, observations | theta)`, up to a constant.
        proposal: What `random_walk` or `proposal` returns; it does not adapt here. A random walk by default.
        num_steps: Number of steps.

    Returns:
        `(key, theta, path) -> theta`.

    Raises:
        TypeError: If `log_density` is not callable.
        ValueError: If `num_steps` is not an integer of at least 1.

    Examples:
        The mean of 100 numbers, all of them 3: its posterior has the standard deviation 0.1.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> update = jf.mcmc.metropolis_update(lambda theta, path: -0.5 * jnp.sum((path - theta) ** 2), num_steps=300)
        >>> theta = jax.jit(update)(jax.random.key(0), jnp.array(0.0), jnp.full(100, 3.0))
        >>> bool(abs(theta - 3.0) < 0.6)
        True
    """
    check_callables(log_density=log_density)
    checks.check_count("num_steps", num_steps)
    walk = random_walk() if proposal is None else proposal

    def update(key: AnyKey, theta: PyTree, path: PyTree) -> PyTree:
        state, _ = walk.init(theta)

        def evaluate(theta: PyTree) -> Point:
            return Point(theta, jnp.zeros(()), checks.scalar("log_density", log_density(theta, path)))

        def step(point: Point, step_key: AnyKey) -> tuple[Point, None]:
            propose_key, accept_key = jax.random.split(step_key)
            new, log_correction = walk.propose(propose_key, state, point.theta)
            return accept(accept_key, point, evaluate(new), log_correction)[0], None

        return jax.lax.scan(step, evaluate(theta), jax.random.split(key, num_steps))[0].theta

    return update


def accept(
    key: AnyKey, old: Point, new: Point, log_correction: Array, temperature: Array | float = 1.0
) -> tuple[Point, MetropolisInfo]:
    """Choose between two points by the Metropolis-Hastings rule for the prior times a power of the likelihood.

    Args:
        key: Random key.
        old: The point where the chain is.
        new: The proposed one.
        log_correction: log q(old | new) - log q(new | old).
        temperature: Power of the likelihood, positive.

    Returns:
        The chosen point, and the diagnostics.
    """
    # From a point without density, where a chain under `jit` may have started, every point with density is accepted.
    before = _density_or_none(old.log_prior) + temperature * _density_or_none(old.log_likelihood)
    log_ratio = new.log_prior + temperature * new.log_likelihood - before + log_correction
    outside = new.log_prior == -jnp.inf
    invalid = _is_no_density(new.log_prior) | (~outside & _is_no_density(new.log_likelihood))
    invalid = invalid | (~outside & _is_no_density(log_correction))
    never = invalid | outside | (new.log_likelihood == -jnp.inf) | jnp.isnan(log_ratio)
    probability = jnp.where(never, 0.0, jnp.exp(jnp.minimum(log_ratio, 0.0)))
    accepted = jax.random.uniform(key, (), probability.dtype) < probability
    chosen = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, old)
    return chosen, MetropolisInfo(accepted, probability, invalid)


def _is_no_density(log_density: Array) -> Array:
    return jnp.isnan(log_density) | jnp.isposinf(log_density)


def _density_or_none(log_density: Array) -> Array:
    return jnp.where(_is_no_density(log_density), -jnp.inf, log_density)


def fault_of(point: Point, is_admissible: Array) -> Int32[Array, ""]:
    """Why a chain cannot start at a point, as a number of `Fault`."""
    fault = jnp.where(jnp.isfinite(point.log_likelihood), Fault.NONE, Fault.LOG_LIKELIHOOD)
    fault = jnp.where(jnp.isfinite(point.log_prior), fault, Fault.LOG_PRIOR)
    return jnp.where(is_admissible, fault, Fault.CONSTRAINT).astype(jnp.int32)


def _evaluated(model: MarginalMetropolis, numbers: PyTree, theta: PyTree) -> Point:
    log_prior = checks.scalar("log_prior", model.log_prior(theta))
    return Point(theta, log_prior, checks.scalar("log_likelihood", model.likelihood.evaluate(numbers, theta)), numbers)


def _init(model: MarginalMetropolis, key: AnyKey, theta: PyTree) -> tuple[MetropolisState, Array]:
    theta = jax.tree.map(jnp.asarray, theta)
    adaptation, is_admissible = model.proposal.init(theta)
    point = _evaluated(model, model.likelihood.draw(key, theta), theta)
    return MetropolisState(point, adaptation), fault_of(point, is_admissible)


def _step(model: MarginalMetropolis, key: AnyKey, state: MetropolisState) -> tuple[MetropolisState, MetropolisInfo]:
    propose_key, perturb_key, accept_key = jax.random.split(key, 3)
    theta, log_correction = model.proposal.propose(propose_key, state.adaptation, state.theta)
    new = _evaluated(model, model.likelihood.perturb(perturb_key, state.point.auxiliary), theta)
    point, info = accept(accept_key, state.point, new, log_correction)
    return MetropolisState(point, state.adaptation), info


def _warm_up(model: MarginalMetropolis, key: AnyKey, state: MetropolisState) -> tuple[MetropolisState, MetropolisInfo]:
    state, info = _step(model, key, state)
    adapted = model.proposal.adapt(state.adaptation, state.theta, info.acceptance_probability)
    return state._replace(adaptation=adapted), info
