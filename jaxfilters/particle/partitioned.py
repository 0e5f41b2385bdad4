r"""Layered sampling: one observation weighs the particles twice, first after rough moves, then after fine ones.

In many dimensions few particles that move in all of them at once land well. Halfway partitioned sampling lets each
particle move in one group of coordinates only, half of them in the pose, half of them in the deformation; those that
landed well in either are drawn and moved a little in all coordinates, without drift, and weighed again
(Y. Sugano, "User-independent techniques for real-time estimation of non-rigid 3D head motion", 2007, section 3.3.2;
after J. MacCormick and M. Isard, "Partitioned sampling", 2000). It costs two likelihoods a particle.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Transport
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample, reweight
from jaxfilters.typing import AnyKey, LogLikelihood, ResamplingScheme, as_pytree


@runtime_checkable
class EnsembleLogLikelihood(Protocol):
    r"""Evaluate $\log p(y_t \mid x_t)$ of all particles at once: `(d, n)` and an observation to `(n,)`."""

    def __call__(self, particles: Float[Array, "d n"], y: PyTree, /) -> Float[Array, " n"]: ...


def over_ensemble(log_likelihood: LogLikelihood) -> EnsembleLogLikelihood:
    """The log-likelihood of all particles from that of one; built again from the same function it compiles nothing."""
    return jax.tree_util.Partial(_mapped, as_pytree(log_likelihood))


def _mapped(log_likelihood, particles, y):
    return jax.vmap(log_likelihood, in_axes=(-1, None))(particles, y)


@runtime_checkable
class StageWeights(Protocol):
    """Log weights of the second stage from the log-likelihood there and that of the parent in the first."""

    def __call__(self, child: Float[Array, " n"], parent: Float[Array, " n"], /) -> Float[Array, " n"]: ...


def counted_twice(child: Float[Array, " n"], parent: Float[Array, " n"]) -> Float[Array, " n"]:
    """`L(child)`, as published: the observation counts in both stages, and the spread comes out too small."""
    del parent
    return child


def counted_once(child: Float[Array, " n"], parent: Float[Array, " n"]) -> Float[Array, " n"]:
    """`L(child) / L(parent)`: the observation counts once.

    The particles then follow the posterior of where the rough and the fine moves lead: of a prior that is still too
    narrow, because each particle has moved in one group only.
    """
    return child - jnp.where(jnp.isfinite(parent), parent, 0.0)


@pytree_dataclass
class Partitions:
    """How a layered filter splits its moves."""

    groups: Bool[Array, "g d"]
    """Which coordinates move together in the first stage; `consecutive(6, 5)` are the first six and the other five."""
    jitter: float | Float[Array, ""] = 0.25
    """Standard deviation of the fine moves as a share of that of the rough ones."""
    stage_weights: StageWeights = field(default=counted_twice, metadata={"static": True})
    """`counted_twice` as published; `counted_once` where the spread of the particles is of interest."""


def consecutive(*sizes: int) -> Bool[Array, "g d"]:
    """Groups of coordinates one behind the other, a row each.

    Raises:
        ValueError: If there is no size, or one below 1.
    """
    if not sizes or min(sizes) < 1:
        raise ValueError(f"consecutive needs sizes of at least 1; got {sizes}.")
    group = np.repeat(np.arange(len(sizes)), sizes)
    return jnp.asarray(group == np.arange(len(sizes))[:, None])


def in_one_group(displacement: Float[Array, "d n"], groups: Bool[Array, "g d"]) -> Float[Array, "d n"]:
    """The displacements of each particle in one group of coordinates, zero in the others.

    The groups take turns along the ensemble: resampled particles lie beside their siblings, so that each parent's
    children spread over all groups.
    """
    turn = jnp.arange(displacement.shape[1]) % groups.shape[0]
    return jnp.where(groups[turn].T, displacement, 0.0)


def partitioned_update(
    key: AnyKey,
    particles: Float[Array, "d n"],
    log_weights: Float[Array, " n"],
    ancestors: Int32[Array, " n"],
    log_likelihood: Callable[[Float[Array, "d n"]], Float[Array, " n"]],
    jitter: Float[Array, " d"],
    *,
    stage_weights: StageWeights = counted_twice,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
) -> tuple[Float[Array, "d n"], Float[Array, " n"], Int32[Array, " n"], ParticleInfo]:
    """Particles, log weights and ancestors after weighing, resampling, fine moves and weighing again.

    The log evidence is that of the first stage, whose particles are drawn before the observation is seen; it is `-inf`
    if in either stage no particle explains the observation. The effective sample size is that after the second stage;
    invalid likelihoods of both count.

    Args:
        key: Random key.
        particles: Predicted particles.
        log_weights: Their log weights.
        ancestors: Their parents before the prediction.
        log_likelihood: `particles -> (n,)`, log p(y | x) of the observation at hand.
        jitter: Standard deviations of the fine moves.
        stage_weights: How the second stage weighs: `counted_twice` or `counted_once`.
        scheme: Resampling scheme between the stages.

    Raises:
        ValueError: If `scheme` is transport: what it makes are averages, of which no likelihood was evaluated.
    """
    if isinstance(scheme, Transport):
        raise ValueError("scheme must choose ancestors between the stages; transport averages particles.")
    resample_key, noise_key = jax.random.split(key)
    first_likelihood = log_likelihood(particles)
    log_weights, first = reweight(log_weights, first_likelihood, ancestors, no_tempering)
    (particles, first_likelihood), log_weights, chosen = resample(
        resample_key, (particles, first_likelihood), log_weights, scheme, 1.0
    )
    noise = standard_normal(noise_key, particles.shape, particles.dtype)
    particles = particles + jitter[:, None] * noise
    second_likelihood = stage_weights(log_likelihood(particles), first_likelihood)
    log_weights, second = reweight(log_weights, second_likelihood, ancestors, no_tempering)
    unexplained = second.log_evidence == -jnp.inf
    info = second._replace(
        log_evidence=jnp.where(unexplained, -jnp.inf, first.log_evidence),
        num_invalid=first.num_invalid + second.num_invalid,
    )
    return particles, log_weights, ancestors[chosen], info
