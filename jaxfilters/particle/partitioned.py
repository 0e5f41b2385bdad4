r"""Partitioned sampling in two stages: one observation weights the particles after a large and after a small move.

In many dimensions few particles that move in all of them at once come close to the target. In the first stage each
particle moves in one group of coordinates only, for example one half of the particles in the pose and the other half in
the deformation. Those that are close in either are resampled, moved a little in all coordinates without drift, and
weighted again (Y. Sugano, "User-independent techniques for real-time estimation of non-rigid 3D head motion", 2007,
section 3.3.2; after J. MacCormick and M. Isard, "Partitioned sampling, articulated objects, and interface-quality hand
tracking", European Conference on Computer Vision, 2000). It costs two evaluations of the likelihood a particle.
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.particle import checks
from jaxfilters.particle.differentiable_resampling import EnsembleScheme, Transport
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, resample, reweight
from jaxfilters.typing import AnyKey, LogLikelihood, ResamplingScheme, taking_inputs


@runtime_checkable
class EnsembleLogLikelihood(Protocol):
    r"""Evaluate $\log p(y_t \mid x_t)$ of all particles at once: `(d, n)` and an observation to `(n,)`."""

    def __call__(self, *arguments: Any, **options: Any) -> Float[Array, " n"]: ...


def batch_log_likelihood(log_likelihood: LogLikelihood) -> EnsembleLogLikelihood:
    """Map the log-likelihood of one particle over all particles.

    Args:
        log_likelihood: `(x, y) -> log p(y | x)`, a scalar; or with the inputs of the step after them, see `jf.typing`.

    Returns:
        `(particles (d, n), y, inputs) -> (n,)`, where the inputs are `None` by default. Two results for the same
        function are equal, so that a filter built again is not compiled again.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> jf.batch_log_likelihood(lambda x, y: -jnp.sum((x - y) ** 2))(jnp.zeros((2, 5)), jnp.ones(2)).shape
        (5,)
    """
    checks.check_callables(log_likelihood=log_likelihood)
    return jax.tree_util.Partial(_map_over_particles, taking_inputs("log_likelihood", log_likelihood, "x", "y"))


def _map_over_particles(log_likelihood, particles, y, inputs=None):
    mapped = jax.vmap(checks.checked_log_likelihood(log_likelihood), in_axes=(-1, None, None))
    return mapped(particles, y, inputs)


@runtime_checkable
class StageWeights(Protocol):
    """Compute log weights of the second stage from the log-likelihoods of child (second stage) and parent (first)."""

    def __call__(self, child: Float[Array, " n"], parent: Float[Array, " n"], /) -> Float[Array, " n"]: ...


def uncorrected(child: Float[Array, " n"], parent: Float[Array, " n"]) -> Float[Array, " n"]:
    """Weight by `L(child)`, as published: the observation counts in both stages, and the posterior is too narrow.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.particle.partitioned import uncorrected
        >>> uncorrected(jnp.array([-1.0, -2.0]), jnp.array([-3.0, -3.0])).tolist()
        [-1.0, -2.0]
    """
    del parent
    return child


def corrected(child: Float[Array, " n"], parent: Float[Array, " n"]) -> Float[Array, " n"]:
    """Weight by `L(child) / L(parent)`: the observation counts once.

    The particles then approximate the posterior for the prior that the two moves make up. That prior is narrower than
    the transition of the model, because each particle makes the large move in one group only.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.particle.partitioned import corrected
        >>> corrected(jnp.array([-1.0, -2.0]), jnp.array([-3.0, -3.0])).tolist()
        [2.0, 1.0]
    """
    return child - jnp.where(jnp.isfinite(parent), parent, 0.0)


@pytree_dataclass
class Partitions:
    """How partitioned sampling splits the move of a prediction into two stages.

    Examples:
        >>> import jaxfilters as jf
        >>> from jaxfilters.particle.partitioned import consecutive, corrected
        >>> jf.Partitions(consecutive(6, 5), stage_weights=corrected).groups.shape
        (2, 11)
    """

    groups: Bool[Array, "g d"]
    """Coordinates that move together in the first stage, one group a row; `consecutive(6, 5)` makes two groups of the
    first six coordinates and the next five."""
    jitter: float | Float[Array, ""] = 0.25
    """Standard deviation of the small move of the second stage, as a fraction of that of the first."""
    stage_weights: StageWeights = field(default=uncorrected, metadata={"static": True})
    """`uncorrected` as published; `corrected` where the spread of the particles is of interest."""


def consecutive(*sizes: int) -> Bool[Array, "g d"]:
    """Make groups of consecutive coordinates with the given sizes, a row each.

    Raises:
        ValueError: If there is no size, or one that is not an integer of at least 1.

    Examples:
        >>> from jaxfilters.particle.partitioned import consecutive
        >>> consecutive(2, 1).astype(int).tolist()
        [[1, 1, 0], [0, 0, 1]]
    """
    if not sizes:
        raise ValueError("sizes of consecutive must be one or more; got none.")
    for size in sizes:
        checks.check_num_particles(size, name="sizes of consecutive")
    group = np.repeat(np.arange(len(sizes)), sizes)
    return jnp.asarray(group == np.arange(len(sizes))[:, None])


def move_one_group(displacement: Float[Array, "d n"], groups: Bool[Array, "g d"]) -> Float[Array, "d n"]:
    """Keep the displacement of each particle in one group of coordinates, and set it to zero in the others.

    The groups alternate along the ensemble. Resampled particles with the same parent are neighbours, so that the
    children of every parent move in different groups.

    Examples:
        >>> import jax.numpy as jnp
        >>> from jaxfilters.particle.partitioned import consecutive, move_one_group
        >>> move_one_group(jnp.ones((2, 4)), consecutive(1, 1)).tolist()
        [[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 1.0]]
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
    stage_weights: StageWeights = uncorrected,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
) -> tuple[Float[Array, "d n"], Float[Array, " n"], Int32[Array, " n"], ParticleInfo]:
    """Weight predicted particles, resample them, move them a little and weight them again.

    The log evidence is that of the first stage, whose particles do not depend on the observation; it is `-inf` if in
    either stage no particle explains the observation. The effective sample size is that after the second stage, and
    invalid likelihoods of both stages are counted.

    Args:
        key: Random key.
        particles: Predicted particles `(d, n)`.
        log_weights: Log weights `(n,)` of the predicted particles.
        ancestors: Index of each particle's parent before the prediction.
        log_likelihood: `particles -> (n,)`, log p(y | x) of the current observation.
        jitter: Standard deviations `(d,)` of the small move.
        stage_weights: Weights of the second stage: `uncorrected` or `corrected`.
        scheme: Resampling scheme between the stages.

    Returns:
        Particles, log weights, ancestors before the prediction, and the diagnostics.

    Raises:
        ValueError: If `scheme` is transport: it makes averages of particles, whose likelihoods were not evaluated.
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
