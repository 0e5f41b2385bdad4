r"""Iterated auxiliary particle filter: proposals and first stages that know all observations to come.

With twisting functions $\psi_t$, particles move by $p(x_t \mid x_{t-1})\, \psi_t(x_t)$, normalised, and are resampled
by the normalising constants, $\eta_t(x_{t-1}) = \int p(x_t \mid x_{t-1})\, \psi_t(x_t)\, dx_t$. Where $\psi_t(x)$ is
$p(y_{t:T} \mid x_t = x)$ the estimate of the evidence has no variance. It obeys
$\psi_t(x) = p(y_t \mid x)\, \eta_{t+1}(x)$, which is fitted backwards in time to the particles of a run; a few runs
suffice (P. Guarniero, A. Johansen and A. Lee, "The iterated auxiliary particle filter", Journal of the American
Statistical Association 112, 2017, algorithm 4). The fit is a regression of $\log \psi_t$ on all quadratic functions (J.
Heng, A. Bishop, G. Deligiannidis and A. Doucet, "Controlled sequential Monte Carlo", Annals of Statistics 48, 2020,
section 4.2), which is exact for linear Gaussian models.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxfilters import weights
from jaxfilters._full_precision import dot
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.noise import standard_normal
from jaxfilters.filter import Filter, run
from jaxfilters.gaussian.belief import Gaussian, logpdf
from jaxfilters.math.linalg import cholesky, matmul, solve_triangular
from jaxfilters.noise import StandardNormal
from jaxfilters.particle import checks
from jaxfilters.particle.auxiliary import AuxiliaryState, auxiliary
from jaxfilters.particle.gaussian_proposals import Covariance, Whitened, draw_whitened
from jaxfilters.particle.resampling import systematic
from jaxfilters.particle.smoothing import History
from jaxfilters.particle.weighting import ParticleInfo
from jaxfilters.typing import AnyKey, LogLikelihood, ResamplingScheme, only_inputs, taking_inputs

_SHARE_FITTED = 0.25
"""Effective sample size of a regression as a fraction of the particles: those with the highest values."""
_HIGHEST_PEAK = 5.0
"""Largest logarithm by which the peak of a fitted function may exceed the highest value to which it is fitted."""


class Twisting(NamedTuple):
    r"""Twisting functions $\psi(x) = \exp(-\frac12 (x - r)^T A (x - r) + b^T (x - r) + c) + \delta$, one a step."""

    center: Float[Array, "... n"]
    """r."""
    curvature: Float[Array, "... n n"]
    """A, positive semidefinite."""
    slope: Float[Array, "... n"]
    """b."""
    constant: Float[Array, "..."]
    """c."""
    log_floor: Float[Array, "..."]
    """Logarithm of delta."""


class IteratedAuxiliary(NamedTuple):
    """What `iterated_auxiliary` finds."""

    log_evidence: Float[Array, ""]
    """Logarithm of an unbiased estimate of the evidence, from the last run."""
    estimates: Float[Array, " k"]
    """Those of all runs, the last one included; the first is that of a bootstrap filter."""
    history: History
    """Ensembles of the last run, for `jf.smoothing.trajectories`; weights are those of twisted targets before the last
    frame, and of the filtering distribution in it."""


class _StepInputs(NamedTuple):
    """The inputs of a step of the twisted filter."""

    inputs: PyTree
    twisting: Twisting
    is_first: Array
    """Whether the step draws from the prior, without an observation."""


@pytree_dataclass
class _Twisted:
    """The model, as the callbacks of an auxiliary filter whose inputs are `_StepInputs`."""

    prior: Gaussian
    transition: Callable
    process_noise: Covariance
    likelihood: Callable

    def noise(self, key: AnyKey, particles: Float[Array, "n count"]) -> Float[Array, "n count"]:
        """Standard normal numbers, one more than there are coordinates."""
        size, count = particles.shape
        return standard_normal(key, (size + 1, count), particles.dtype)

    def prediction(self, x: Array, step: _StepInputs) -> tuple[Array, Array]:
        """Where the particle goes without noise, and the root of the covariance of the noise."""
        ahead = checks.like("the result of transition", self.transition(x, step.inputs), x, "x")
        Q = self.process_noise(step.inputs) if callable(self.process_noise) else self.process_noise
        checks.check_covariance("process_noise", Q, x.size)
        Q = jnp.where(step.is_first, self.prior.covariance, Q)
        return jnp.where(step.is_first, self.prior.mean, ahead), cholesky(Q)

    def draw(self, randomness: Array, x: Array, y: PyTree, step: _StepInputs) -> tuple[Array, Float[Array, ""]]:
        """A sample of the twisted transition, and its log density."""
        del y
        posterior, log_constant = self.posterior(x, step)
        # The sum of a Gaussian and a constant is a mixture of the two transitions.
        return draw_whitened(posterior, randomness, jax.nn.sigmoid(step.twisting.log_floor - log_constant))

    def log_first_stage(self, x: Array, y: PyTree, step: _StepInputs) -> Float[Array, ""]:
        """Log normalising constant of the twisted transition."""
        del y
        return jnp.logaddexp(self.posterior(x, step)[1], step.twisting.log_floor)

    def posterior(self, x: Array, step: _StepInputs) -> tuple[Whitened, Float[Array, ""]]:
        """The transition twisted by the Gaussian part alone, and its log normalising constant."""
        ahead, root = self.prediction(x, step)
        r, A, b, c, _ = step.twisting
        offset = ahead - r
        precision = jnp.eye(x.size, dtype=x.dtype) + matmul(root.T, matmul(A, root))
        precision_root = cholesky(0.5 * (precision + precision.T))
        half = solve_triangular(precision_root, dot(root.T, b - dot(A, offset)))
        center = solve_triangular(precision_root, half, transpose=True)
        log_constant = c + dot(b, offset) - dot(0.5 * offset, dot(A, offset)) + 0.5 * jnp.sum(half**2)
        log_constant = log_constant - jnp.sum(jnp.log(jnp.diagonal(precision_root)))
        return Whitened(ahead, root, center, precision_root), log_constant

    def sample_transition(self, noise: Array, x: Array, step: _StepInputs) -> Array:
        """One step of the model."""
        ahead, root = self.prediction(x, step)
        return ahead + dot(root, noise)

    def log_transition(self, x_next: Array, x: Array, step: _StepInputs) -> Float[Array, ""]:
        """Its log density, over the directions with noise."""
        ahead, root = self.prediction(x, step)
        return logpdf(x_next - ahead, root)

    def log_likelihood(self, x: Array, y: PyTree, step: _StepInputs) -> Float[Array, ""]:
        """Log density of an observation; 0 in the first step, which has none."""
        found = checks.scalar_log_density("log_likelihood", self.likelihood(x, y, step.inputs))
        return jnp.where(step.is_first, 0.0, found)


def iterated_auxiliary(
    key: AnyKey,
    prior: Gaussian,
    transition: Callable[..., Array],
    process_noise: Covariance,
    log_likelihood: LogLikelihood,
    observations: PyTree,
    inputs: PyTree = None,
    *,
    num_particles: int,
    iterations: int = 3,
    prior_share: ArrayLike = 0.01,
    scheme: ResamplingScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
) -> IteratedAuxiliary:
    """Estimate the evidence of a whole sequence by the iterated auxiliary particle filter.

    For `x' = f(x) + q` with Gaussian q and any likelihood. Each run twists the model by what the run before found of
    the observations to come; on linear Gaussian models one iteration leaves hardly any variance. The estimate of every
    run is unbiased, because its twisting functions come from independent particles. Results are differentiable with
    respect to parameters; the twisting functions count as constants.

    Args:
        key: Random key.
        prior: Belief before the first observation, with a mean (n,) and a covariance (n, n).
        transition: `(x[, inputs]) -> x`, f, without noise; (n,) to (n,).
        process_noise: Covariance of q, (n, n), or a function `inputs -> covariance`.
        log_likelihood: `(x, y[, inputs]) -> log p(y | x)`, a scalar.
        observations: Pytree whose leaves have time as their first axis.
        inputs: Pytree of known inputs, time first, or `None`.
        num_particles: Number of particles of every run, more than the (n + 1) (n + 2) / 2 numbers of a quadratic
            function.
        iterations: How often the twisting functions are fitted, at least 1; there is one run more.
        prior_share: Constant that is added to each twisting function, as a fraction of its mean over the particles, in
            (0, 1): so many of them move by the plain transition, wherever the quadratic function is a bad fit. It
            bounds the weights.
        scheme: Function of `jaxfilters.resampling`.
        ess_threshold: As for `auxiliary`.

    Returns:
        The log evidence, those of all runs, and the ensembles of the last run.

    Raises:
        TypeError: If an argument is of another kind.
        ValueError: If shapes or lengths do not fit one another, a covariance is not one, or a number is out of range.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> prior, log_likelihood = jf.Gaussian(jnp.zeros(1), one), lambda x, y: jf.Gaussian(x, one).logpdf(y)
        >>> ys = jnp.array([[0.5], [2.0], [1.0]])
        >>> found = jf.iterated_auxiliary(
        ...     jax.random.key(0), prior, lambda x: 0.9 * x, one, log_likelihood, ys, num_particles=50
        ... )
        >>> exact = jf.log_evidence(jf.kalman(prior, 0.9 * one, one, one, one), jax.random.key(0), ys)
        >>> bool(abs(found.log_evidence - exact) < 0.05)
        True
    """
    checks.check_gaussian("prior", prior)
    size = prior.mean.shape[0]
    if not callable(process_noise):
        checks.check_covariance("process_noise", process_noise, size)
    checks.check_num_particles(num_particles, (size + 1) * (size + 2) // 2 + 1)
    checks.check_num_particles(iterations, name="iterations")
    checks.check_scalar("prior_share", prior_share, "in (0, 1)", lambda value: 0 < value < 1)
    length = _length(observations, inputs)
    model = _Twisted(
        prior,
        taking_inputs("transition", transition, "x"),
        only_inputs("process_noise", process_noise) if callable(process_noise) else process_noise,
        taking_inputs("log_likelihood", log_likelihood, "x", "y"),
    )
    filter = auxiliary(
        lambda _: prior.mean,
        model.sample_transition,
        model.log_likelihood,
        log_first_stage=model.log_first_stage,
        log_transition=model.log_transition,
        proposal=model,
        num_particles=num_particles,
        noise=StandardNormal(size),
        scheme=scheme,
        ess_threshold=ess_threshold,
    )
    # The step before the first draws from the prior; its observation and inputs are not used.
    observations, inputs = jax.tree.map(
        lambda leaf: jnp.concatenate([jnp.asarray(leaf)[:1], jnp.asarray(leaf)]), (observations, inputs)
    )
    is_first = jnp.arange(length + 1) == 0
    zeros = jnp.zeros((length + 1, size), prior.mean.dtype)
    plain = Twisting(zeros, jnp.zeros((length + 1, size, size), zeros.dtype), zeros, zeros[:, 0], zeros[:, 0])

    def refined_by(twisting: Twisting, run_key: AnyKey) -> tuple[Twisting, Array]:
        steps = _StepInputs(inputs, twisting, is_first)
        found = _run(run_key, filter, observations, steps)
        refined = _fitted(model, found.history.particles, observations, steps, prior_share)
        return jax.lax.stop_gradient(refined), found.log_evidence

    *keys, last_key = jax.random.split(key, iterations + 1)
    twisting, estimates = jax.lax.scan(refined_by, plain, jnp.stack(keys))
    found = _run(last_key, filter, observations, _StepInputs(inputs, twisting, is_first))
    history = jax.tree.map(lambda leaf: leaf[1:], found.history)
    return IteratedAuxiliary(found.log_evidence, jnp.append(estimates, found.log_evidence), history)


class _Found(NamedTuple):
    log_evidence: Float[Array, ""]
    history: History


def _run(key: AnyKey, filter: Filter, observations: PyTree, steps: _StepInputs) -> _Found:
    _, (history, log_evidence) = run(filter, key, observations, steps, collect=_keep)
    return _Found(log_evidence.sum(), history)


def _keep(state: AuxiliaryState, info: ParticleInfo) -> tuple[History, Array]:
    return History(state.particles, state.log_weights, state.ancestors), info.log_evidence


def _fitted(
    model: _Twisted, particles: Array, observations: PyTree, steps: _StepInputs, prior_share: ArrayLike
) -> Twisting:
    """Twisting functions fitted to the particles of a run, from the last step to the first."""

    def back(following: tuple[_StepInputs, Array], step: tuple) -> tuple[tuple[_StepInputs, Array], Twisting]:
        next_step, has_next = following
        particles, y, here = step
        score = jax.vmap(model.log_likelihood, in_axes=(-1, None, None))(particles, y, here)
        ahead = jax.vmap(model.log_first_stage, in_axes=(-1, None, None))(particles, y, next_step)
        twisting = _regression(particles, score + jnp.where(has_next, ahead, 0.0), prior_share)
        return (here._replace(twisting=twisting), jnp.array(True)), twisting

    last = jax.tree.map(lambda leaf: leaf[-1], steps)
    each = (particles, observations, steps)
    _, twisting = jax.lax.scan(back, (last, jnp.array(False)), each, reverse=True)
    return twisting


def _regression(x: Float[Array, "n count"], values: Float[Array, " count"], prior_share: ArrayLike) -> Twisting:
    """The quadratic function next to values at particles, with the part of its curvature that is concave."""
    size, count = x.shape
    usable = jnp.isfinite(values)
    # Values differ by thousands where readings are precise: the highest ones matter.
    scores = jnp.where(usable, values, -jnp.inf)
    power = weights.temper_exponent(scores, jnp.zeros_like(scores), _SHARE_FITTED * count)
    share = weights.linear(power * scores)
    center = dot(x, share)
    spread = jnp.sqrt(dot((x - center[:, None]) ** 2, share))
    spread = jnp.where(spread > 0, spread, 1.0)
    s = (x - center[:, None]) / spread[:, None]
    level = jnp.sum(jnp.where(usable, values, 0.0) * share)
    rows, columns = jnp.triu_indices(size)
    features = jnp.concatenate([jnp.ones((1, count), x.dtype), s, s[rows] * s[columns]])
    root = jnp.sqrt(share)
    found = jnp.linalg.lstsq((features * root).T, jnp.where(usable, values - level, 0.0) * root)[0]
    upper = jnp.zeros((size, size), x.dtype).at[rows, columns].set(found[1 + size :])
    eigenvalues, vectors = jnp.linalg.eigh(-(upper + upper.T))
    slope = dot(vectors.T, found[1 : 1 + size])
    # Along a direction in which it is not concave the function would grow without bound: there it is constant.
    concave = eigenvalues > 0
    eigenvalues, slope = jnp.where(concave, eigenvalues, 0.0), jnp.where(concave, slope, 0.0)
    # Nor may its peak be far above all values: where it lies outside the particles, it is an extrapolation.
    peak = found[0] + 0.5 * jnp.sum(jnp.where(concave, slope**2 / jnp.where(concave, eigenvalues, 1.0), 0.0))
    highest = jnp.max(jnp.where(usable, values, -jnp.inf)) - level + _HIGHEST_PEAK
    eigenvalues = eigenvalues * jnp.maximum(1.0, (peak - found[0]) / jnp.maximum(highest - found[0], 1.0))
    scaled = vectors / spread[:, None]
    curvature = matmul(scaled * eigenvalues, scaled.T)
    log_mean = jax.nn.logsumexp(scores) - math.log(count)
    log_floor = jnp.log(prior_share) + jnp.where(jnp.isfinite(log_mean), log_mean, 0.0)
    return Twisting(center, curvature, dot(scaled, slope), found[0] + level, log_floor)


def _length(observations: Any, inputs: Any) -> int:
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves((observations, inputs))}
    if len(lengths) != 1 or lengths & {(), (0,)} or not jax.tree.leaves(observations):
        shown = ", ".join(str(length[0]) if length else "a scalar" for length in sorted(lengths)) or "none"
        raise ValueError(f"observations and inputs must share one length along their first axis; got {shown}.")
    return lengths.pop()[0]
