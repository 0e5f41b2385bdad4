r"""Gaussian proposals for transitions with additive Gaussian noise: by linearisation, and by Laplace's approximation.

With $x_t = f(x_{t-1}, u_t) + L z$, $z \sim N(0, I)$ and $Q = L L^T$, the proposal draws $z$ from a Gaussian
approximation $N(\mu, C)$ of its posterior given the observation. It is computed in these whitened coordinates, where
$C = (I + G)^{-1}$ with $G$ positive semidefinite: float32 suffices whatever the units of the state are, and Q may be
singular. The optimal proposal, exact where the observation is linear, is that of A. Doucet, S. Godsill and C. Andrieu,
"On sequential Monte Carlo sampling methods for Bayesian filtering", Statistics and Computing 10, 2000, section II-D;
with sigma points the filter is the unscented particle filter (R. van der Merwe, A. Doucet, N. de Freitas and E. Wan,
NIPS 13, 2000).
"""

import math
from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.linearize import Linearize, taylor
from jaxfilters.math.linalg import cholesky, log_det_triangular, matmul, safe_norm, solve_triangular
from jaxfilters.particle import checks
from jaxfilters.typing import AnyKey, LogLikelihood, only_inputs, taking_inputs

Covariance = Array | Callable[[PyTree], Array]
_LONGEST_STEP = 2.0
"""Of Newton's method, in standard deviations of the transition."""
_HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)


class Whitened(NamedTuple):
    """The Gaussian approximation of the posterior of the noise z of one particle."""

    ahead: Float[Array, " n"]
    """Where the particle goes without noise, f(x)."""
    root: Float[Array, "n n"]
    """L, with `L L^T = Q`."""
    center: Float[Array, " n"]
    """Mean mu of z."""
    precision_root: Float[Array, "n n"]
    """Lower root of the inverse of its covariance, I + G."""


@pytree_dataclass
class LinearizedProposal:
    """A proposal made by `linearized`."""

    transition: Callable
    process_noise: Covariance
    observe: Callable
    observation_noise: Array
    prior_share: float = field(metadata={"static": True})
    linearize: Linearize = field(metadata={"static": True})
    iterations: int = field(metadata={"static": True})

    def noise(self, key: AnyKey, particles: Float[Array, "n count"]) -> Float[Array, "m count"]:
        """Standard normal numbers."""
        return _noise(key, particles, self.prior_share)

    def draw(self, randomness: Array, x: Array, y: Array, inputs: PyTree) -> tuple[Array, Float[Array, ""]]:
        """A sample, and the logarithm of its density."""
        return draw_whitened(self.posterior(x, y, inputs)[0], randomness, self.prior_share)

    def log_predictive(self, x: Array, y: Array, inputs: PyTree) -> Float[Array, ""]:
        """Approximation of log p(y | x of the step before), exact for linear observations: a first stage."""
        return self.posterior(x, y, inputs)[1]

    def posterior(self, x: Array, y: Array, inputs: PyTree) -> tuple[Whitened, Float[Array, ""]]:
        """The approximate posterior of one particle, and its evidence."""
        ahead, root = predicted = prediction(self, x, inputs)
        checks.check_shape("observation", y, jnp.shape(self.observation_noise)[:1], "that of observation_noise")
        found = self._linearized(predicted, y, inputs, jnp.zeros_like(ahead), root)
        for _ in range(self.iterations - 1):
            posterior, _ = found
            inverse = solve_triangular(posterior.precision_root, jnp.eye(ahead.size, dtype=ahead.dtype))
            found = self._linearized(predicted, y, inputs, posterior.center, matmul(root, inverse.T))
        return found

    def _linearized(self, predicted, y, inputs, center, spread):
        """The posterior with the observation linearised about `ahead + root @ center`, for that spread about it."""
        ahead, root = predicted
        about = Gaussian(ahead + dot(root, center), matmul(spread, spread.T))
        linear = self.linearize(lambda state: self.observe(state, inputs), about)
        checks.check_shape("the result of observe", linear.value, y.shape, "that of the observation")
        R = self.observation_noise + matmul(linear.residual_root, linear.residual_root.T)
        # Components without a reading say nothing.
        read = jnp.isfinite(y)
        R = jnp.where(read[:, None] & read, R, jnp.eye(y.size, dtype=R.dtype))
        noise_root = cholesky(R)
        slope = solve_triangular(noise_root, jnp.where(read[:, None], matmul(linear.F, root), 0.0))
        error = solve_triangular(noise_root, jnp.where(read, jnp.where(read, y, 0.0) - linear.value, 0.0))
        error = error + dot(slope, center)
        precision_root = cholesky(jnp.eye(ahead.size, dtype=ahead.dtype) + matmul(slope.T, slope))
        half = solve_triangular(precision_root, dot(slope.T, error))
        mean = solve_triangular(precision_root, half, transpose=True)
        # The same as error^T (I + W W^T)^-1 error, without the difference of two large numbers.
        misfit = jnp.sum((error - dot(slope, mean)) ** 2) + jnp.sum(mean**2)
        log_scale = jnp.sum(jnp.where(read, jnp.log(jnp.diagonal(noise_root)) + _HALF_LOG_2_PI, 0.0))
        log_evidence = -0.5 * misfit - log_scale - jnp.sum(jnp.log(jnp.diagonal(precision_root)))
        return Whitened(ahead, root, mean, precision_root), log_evidence


@pytree_dataclass
class LaplaceProposal:
    """A proposal made by `laplace`."""

    transition: Callable
    process_noise: Covariance
    log_likelihood: LogLikelihood
    prior_share: float = field(metadata={"static": True})
    iterations: int = field(metadata={"static": True})

    def noise(self, key: AnyKey, particles: Float[Array, "n count"]) -> Float[Array, "m count"]:
        """Standard normal numbers."""
        return _noise(key, particles, self.prior_share)

    def draw(self, randomness: Array, x: Array, y: PyTree, inputs: PyTree) -> tuple[Array, Float[Array, ""]]:
        """A sample, and the logarithm of its density."""
        return draw_whitened(self.posterior(x, y, inputs)[0], randomness, self.prior_share)

    def log_predictive(self, x: Array, y: PyTree, inputs: PyTree) -> Float[Array, ""]:
        """Laplace's approximation of log p(y | x of the step before): a first stage."""
        return self.posterior(x, y, inputs)[1]

    def posterior(self, x: Array, y: PyTree, inputs: PyTree) -> tuple[Whitened, Float[Array, ""]]:
        """The Gaussian at the mode of the posterior of one particle, and Laplace's approximation of its evidence."""
        ahead, root = prediction(self, x, inputs)
        log_likelihood = checks.checked_log_likelihood(self.log_likelihood)
        fit = lambda z: log_likelihood(ahead + dot(root, z), y, inputs)

        def newton(_, z: Array) -> Array:
            precision_root = _precision_root(fit, z)
            step = solve_triangular(precision_root, jax.grad(fit)(z) - z)
            step = solve_triangular(precision_root, step, transpose=True)
            return z + step * jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(safe_norm(step), _LONGEST_STEP))

        # The mode maximises, so that its derivative does not change the evidence to first order; a proposal needs none.
        mode = jax.lax.fori_loop(0, self.iterations, newton, jnp.zeros_like(ahead))
        precision_root = _precision_root(fit, mode)
        log_evidence = fit(mode) - 0.5 * jnp.sum(mode**2) - jnp.sum(jnp.log(jnp.diagonal(precision_root)))
        return Whitened(ahead, root, mode, precision_root), log_evidence


def linearized(
    transition: Callable[..., Array],
    process_noise: Covariance,
    observe: Callable[..., Array],
    observation_noise: Float[Array, "m m"],
    *,
    linearize: Linearize = taylor,
    iterations: int = 1,
    prior_share: float = 0.0,
) -> LinearizedProposal:
    """Build a proposal by one step of an extended or unscented Kalman filter for each particle.

    For `x' = f(x) + q`, `y = h(x') + r` with Gaussian q and r. Where h is linear it is the optimal proposal, which
    minimises the variance of the weights given the particles, and its `log_predictive` makes an auxiliary filter fully
    adapted. Components of y that are NaN are left out.

    Args:
        transition: `(x[, inputs]) -> x`, f, without noise; (n,) to (n,).
        process_noise: Covariance of q, (n, n), maybe singular; or a function `inputs -> covariance`.
        observe: `(x[, inputs]) -> y`, h, without noise; (n,) to (m,).
        observation_noise: Covariance of r, (m, m), positive definite.
        linearize: `jf.linearize.taylor`, `second_order`, `cubature` or `unscented(...)`.
        iterations: How often h is linearised: 1 at the prediction; more, each about the posterior of the one before, as
            in posterior linearisation (A. Garcia-Fernandez et al., IEEE Transactions on Signal Processing 63, 2015).
        prior_share: Fraction of draws from the transition, in [0, 1). Above 0 no importance ratio exceeds
            `1 / prior_share`, which protects from proposals with too light tails (T. Hesterberg, Technometrics 37,
            1995).

    Returns:
        A value for the argument `proposal` of `jf.guided` and `jf.auxiliary`. Its method `log_predictive` is a first
        stage.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If a covariance is not one, or a number is out of range.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> optimal = jf.proposals.linearized(lambda x: 0.9 * x, one, lambda x: x, one)
        >>> log_predictive = optimal.log_predictive(jnp.ones(1), jnp.zeros(1), None)
        >>> bool(jnp.isclose(log_predictive, jf.Gaussian(0.9 * jnp.ones(1), 2 * one).logpdf(jnp.zeros(1))))
        True
    """
    _check(transition, process_noise, iterations, prior_share)
    checks.check_callables(observe=observe, linearize=linearize)
    checks.check_covariance("observation_noise", observation_noise)
    return LinearizedProposal(
        taking_inputs("transition", transition, "x"),
        only_inputs("process_noise", process_noise) if callable(process_noise) else process_noise,
        taking_inputs("observe", observe, "x"),
        observation_noise,
        float(prior_share),
        linearize,
        iterations,
    )


def laplace(
    transition: Callable[..., Array],
    process_noise: Covariance,
    log_likelihood: LogLikelihood,
    *,
    iterations: int = 5,
    prior_share: float = 0.0,
) -> LaplaceProposal:
    """Build a proposal by Laplace's approximation of the posterior of each particle, for likelihoods of any kind.

    For `x' = f(x) + q` with Gaussian q. The mode is found by Newton's method, whose steps are at most two standard
    deviations of q long; directions in which the log-likelihood is convex keep the spread of the transition.

    Args:
        transition: `(x[, inputs]) -> x`, f, without noise; (n,) to (n,).
        process_noise: Covariance of q, (n, n), maybe singular; or a function `inputs -> covariance`.
        log_likelihood: `(x, y[, inputs]) -> log p(y | x)`, a scalar, twice differentiable in x.
        iterations: Steps of Newton's method, at least 1.
        prior_share: As for `linearized`.

    Returns:
        A value for the argument `proposal` of `jf.guided` and `jf.auxiliary`, with the method `log_predictive`.

    Raises:
        TypeError: If a callback is not callable.
        ValueError: If the covariance is not one, or a number is out of range.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> poisson = lambda x, y: jax.scipy.stats.poisson.logpmf(y, jnp.exp(x[0]))
        >>> proposal = jf.proposals.laplace(lambda x: 0.9 * x, 0.1 * jnp.eye(1), poisson)
        >>> proposal.posterior(jnp.zeros(1), jnp.array(3), None)[0].center.shape
        (1,)
    """
    _check(transition, process_noise, iterations, prior_share)
    checks.check_callables(log_likelihood=log_likelihood)
    return LaplaceProposal(
        taking_inputs("transition", transition, "x"),
        only_inputs("process_noise", process_noise) if callable(process_noise) else process_noise,
        taking_inputs("log_likelihood", log_likelihood, "x", "y"),
        float(prior_share),
        iterations,
    )


def _check(transition, process_noise, iterations, prior_share):
    checks.check_callables(transition=transition)
    if not callable(process_noise):
        checks.check_covariance("process_noise", process_noise)
    checks.check_num_particles(iterations, name="iterations")
    checks.check_scalar("prior_share", prior_share, "in [0, 1)", lambda value: 0 <= value < 1)


def prediction(
    model: LinearizedProposal | LaplaceProposal, x: Array, inputs: PyTree
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Where a particle goes without noise, and the lower root of the covariance of that noise."""
    ahead = checks.like("the result of transition", model.transition(x, inputs), x, "x")
    if not callable(model.process_noise):
        checks.check_shape("process_noise", model.process_noise, x.shape * 2, "the size of x")
        return ahead, factor.exact_root(model.process_noise)
    Q = model.process_noise(inputs)
    checks.check_covariance("the result of process_noise", Q, x.size)
    return ahead, factor.exact_root(Q)


def _precision_root(fit: Callable, z: Array) -> Array:
    """Lower root of the identity plus the part of minus the Hessian that is positive semidefinite."""
    curvature = -jax.hessian(fit)(z)
    if z.size == 1:
        return jnp.sqrt(1 + jnp.maximum(curvature, 0.0))
    values, vectors = jnp.linalg.eigh(0.5 * (curvature + curvature.T))
    return cholesky(jnp.eye(z.size, dtype=z.dtype) + matmul(vectors * jnp.maximum(values, 0.0), vectors.T))


def _noise(key: AnyKey, particles: Array, prior_share: float) -> Array:
    checks.check_vectors("sample_prior", particles)
    size, count = particles.shape
    # One more number chooses the component of the mixture.
    return standard_normal(key, (size + (prior_share > 0), count), particles.dtype)


def draw_whitened(
    posterior: Whitened, randomness: Float[Array, " m"], prior_share: float | Float[Array, ""]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """A sample of a posterior mixed with the transition, and its log density.

    Args:
        posterior: The approximate posterior of one particle.
        randomness: Standard normal numbers, (n,), and one more that chooses the component where there is a mixture.
        prior_share: Fraction of the transition, below 1; no mixture without the additional number.
    """
    ahead, root, center, precision_root = posterior
    noise = randomness[: center.size]
    z = center + solve_triangular(precision_root, noise, transpose=True)
    log_determinant = log_det_triangular(precision_root)
    log_density = log_determinant - 0.5 * jnp.sum(noise**2)
    if randomness.size > center.size:
        plain = jax.scipy.stats.norm.cdf(randomness[-1]) < prior_share
        z = jnp.where(plain, noise, z)
        log_guided = log_determinant - 0.5 * jnp.sum(dot(precision_root.T, z - center) ** 2)
        log_prior = -0.5 * jnp.sum(z**2)
        log_density = jnp.logaddexp(jnp.log(prior_share) + log_prior, jnp.log1p(-prior_share) + log_guided)
    # From a density of z to that of x, over the directions with noise: those without have the same in the transition.
    diagonal = jnp.diagonal(root)
    fixed = diagonal == 0
    unscaled = jnp.sum(jnp.where(fixed, -0.5 * z**2 - _HALF_LOG_2_PI, 0.0))
    log_scale = jnp.sum(jnp.where(fixed, 0.0, jnp.log(jnp.where(fixed, 1.0, diagonal))))
    return ahead + dot(root, z), log_density - center.size * _HALF_LOG_2_PI - log_scale - unscaled
