"""The particle filter of a model with additive Gaussian noises, given by the arguments of `extended_kalman`.

Every particle proposes by a step of a Kalman filter of its own, and resampling takes the coming observation into
account. Densities, proposal and first stage follow from the model, so that they cannot contradict one another.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian, logpdf
from jaxfilters.gaussian.linearize import Linearize, taylor
from jaxfilters.math.linalg import cholesky
from jaxfilters.noise import StandardNormal
from jaxfilters.particle import checks
from jaxfilters.particle.auxiliary import auxiliary
from jaxfilters.particle.differentiable_resampling import EnsembleScheme
from jaxfilters.particle.gaussian_proposals import LinearizedProposal, linearized, prediction
from jaxfilters.particle.resampling import systematic
from jaxfilters.priors import gaussian_prior
from jaxfilters.typing import ResamplingScheme


def locally_optimal(
    prior: Gaussian,
    transition: Callable[..., Array],
    process_noise: Array | Callable[[PyTree], Array],
    observe: Callable[..., Float[Array, " m"]],
    observation_noise: Float[Array, "m m"],
    *,
    num_particles: int,
    linearize: Linearize = taylor,
    iterations: int = 1,
    prior_share: float = 0.0,
    scheme: ResamplingScheme | EnsembleScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
) -> Filter:
    """Build the auxiliary particle filter with the locally optimal proposal, for additive Gaussian noises.

    It takes the model as `extended_kalman` does, `x' = f(x) + q` and `y = h(x') + r`, and corrects the approximation of
    that filter by samples: the extended or unscented particle filter (R. van der Merwe et al., NIPS 13, 2000) with the
    first stage of M. Pitt and N. Shephard, 1999. Where h is linear it is fully adapted: weights are equal after every
    resampling. Components of observations that are NaN are left out.

    Args:
        prior: Belief before the first observation, with a mean (n,) and a covariance (n, n).
        transition: `(x[, inputs]) -> x`, f, without noise.
        process_noise: Covariance of q, (n, n), or a function `inputs -> covariance`.
        observe: `(x[, inputs]) -> y`, h, without noise; (n,) to (m,).
        observation_noise: Covariance of r, (m, m), positive definite.
        num_particles: Number of particles.
        linearize: How each particle linearises h, as for `jf.proposals.linearized`.
        iterations: How often it does so.
        prior_share: Fraction of draws from the transition, in [0, 1).
        scheme: As for `auxiliary`.
        ess_threshold: As for `auxiliary`.

    Returns:
        A filter whose state is an `AuxiliaryState` and whose info is a `ParticleInfo`.

    Raises:
        TypeError: If an argument is of another kind.
        ValueError: If shapes do not fit one another, a covariance is not one, or a number is out of range.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> wave = lambda x: x + jnp.sin(x)
        >>> pf = jf.locally_optimal(prior, wave, 0.1 * jnp.eye(1), lambda x: x**2, jnp.eye(1), num_particles=500)
        >>> state, infos = jf.run(pf, jax.random.key(0), jnp.ones((5, 1)), collect=jf.keep_info)
        >>> infos.log_evidence.shape
        (5,)
    """
    checks.check_gaussian("prior", prior)
    size = prior.mean.shape[0]
    if not callable(process_noise):
        checks.check_covariance("process_noise", process_noise, size)
    proposal = linearized(
        transition,
        process_noise,
        observe,
        observation_noise,
        linearize=linearize,
        iterations=iterations,
        prior_share=prior_share,
    )
    model = AdditiveGaussian(proposal)
    return auxiliary(
        gaussian_prior(prior),
        model.sample_transition,
        model.log_likelihood,
        log_first_stage=proposal.log_predictive,
        log_transition=model.log_transition,
        proposal=proposal,
        num_particles=num_particles,
        noise=StandardNormal(size),
        scheme=scheme,
        ess_threshold=ess_threshold,
    )


@pytree_dataclass
class AdditiveGaussian:
    """The densities of the model for which a proposal was built."""

    proposal: LinearizedProposal

    def sample_transition(self, noise: Float[Array, " n"], x: Float[Array, " n"], inputs: PyTree) -> Float[Array, " n"]:
        """One step of the model."""
        ahead, root = prediction(self.proposal, x, inputs)
        return ahead + dot(root, noise)

    def log_transition(self, x_next: Float[Array, " n"], x: Float[Array, " n"], inputs: PyTree) -> Float[Array, ""]:
        """Log density of a step, over the directions in which it has noise."""
        ahead, root = prediction(self.proposal, x, inputs)
        return logpdf(x_next - ahead, root)

    def log_likelihood(self, x: Float[Array, " n"], y: Float[Array, " m"], inputs: PyTree) -> Float[Array, ""]:
        """Log density of the components of an observation that are finite."""
        read = jnp.isfinite(y)
        R = jnp.where(read[:, None] & read, self.proposal.observation_noise, 0.0)
        error = jnp.where(read, jnp.where(read, y, 0.0) - self.proposal.observe(x, inputs), 0.0)
        return logpdf(error, cholesky(R))
