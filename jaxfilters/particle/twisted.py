r"""Iterated auxiliary particle filter: proposals and first stages that know all observations to come.

With twisting functions $\psi_t$, particles move by $p(x_t \mid x_{t-1})\, \psi_t(x_t)$, normalised, and are resampled by
the normalising constants, $\eta_t(x_{t-1}) = \int p(x_t \mid x_{t-1})\, \psi_t(x_t)\, dx_t$. Where $\psi_t(x)$ is
$p(y_{t:T} \mid x_t = x)$ the estimate of the evidence has no variance. It obeys
$\psi_t(x) = p(y_t \mid x)\, \eta_{t+1}(x)$, which is fitted backwards in time to the particles of a run; a few runs
suffice (P. Guarniero, A. Johansen and A. Lee, "The iterated auxiliary particle filter", Journal of the American
Statistical Association 112, 2017, algorithm 4). The fit is a regression of $\log \psi_t$ on all quadratic functions (J.
Heng, A. Bishop, G. Deligiannidis and A. Doucet, "Controlled sequential Monte Carlo", Annals of Statistics 48, 2020,
section 4.2), which is exact for linear Gaussian models.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from jaxfilters import weights
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

_SHARE_OF_WEIGHTS = 0.5
"""How much the weights of the particles count in a regression; the rest is equal for all."""


class Twisting(NamedTuple):
    r"""Twisting functions $\log \psi(x) = -\frac12 (x - r)^T A (x - r) + b^T (x - r) + c$, one for each step."""

    center: Float[Array, "... n"]
    """r."""
    curvature: Float[Array, "... n n"]
    """A, positive semidefinite."""
    slope: Float[Array, "... n"]
    """b."""
    constant: Float[Array, "..."]
    """c."""


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
        """Standard normal numbers."""
        return standard_normal(key, particles.shape, particles.dtype)

    def prediction(self, x: Array, step: _StepInputs) -> tuple[Array, Array]:
        """Where the particle goes without noise, and the root of the covariance of the noise."""
        ahead = checks.like("the result of transition", self.transition(x, step.inputs), x, "x")
        Q = self.process_noise(step.inputs) if callable(self.process_noise) else self.process_noise
        checks.check_covariance("process_noise", Q, x.size)
        Q = jnp.where(step.is_first, self.prior.covariance, Q)
        return jnp.where(step.is_first, self.prior.mean, ahead), cholesky(Q)

    def draw(self, randomness: Array, x: Array, y: PyTree, step: _StepInputs) -> tuple[Array, Float[Array, ""]]:
        """A sample of the twisted transition, and its log density."""
        return draw_whitened(self.posterior(x, step)[0], randomness, 0.0)

    def log_first_stage(self, x: Array, y: PyTree, step: _StepInputs) -> Float[Array, ""]:
        """Log normalising constant of the twisted transition."""
        return self.posterior(x, step)[1]

    def posterior(self, x: Array, step: _StepInputs) -> tuple[Whitened, Float[Array, ""]]:
        """The twisted transition of one particle, and its log normalising constant."""
        ahead, root = self.prediction(x, step)
        r, A, b, c = step.twisting
        offset = ahead - r
        precision = jnp.eye(x.size, dtype=x.dtype) + matmul(root.T, matmul(A, root))
        precision_root = cholesky(0.5 * (precision + precision.T))
        half = solve_triangular(precision_root, root.T @ (b - A @ offset))
        center = solve_triangular(precision_root, half, transpose=True)
        log_constant = c + b @ offset - 0.5 * offset @ (A @ offset) + 0.5 * jnp.sum(half**2)
        log_constant = log_constant - jnp.sum(jnp.log(jnp.diagonal(precision_root)))
        return Whitened(ahead, root, center, precision_root), log_constant

    def sample_transition(self, noise: Array, x: Array, step: _StepInputs) -> Array:
        """One step of the model."""
        ahead, root = self.prediction(x, step)
        return ahead + root @ noise

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
    scheme: ResamplingScheme = systematic,
    ess_threshold: ArrayLike = 0.5,
) -> IteratedAuxiliary:
    """Estimate the evidence of a whole sequence by the iterated auxiliary particle filter.

    For `x' = f(x) + q` with Gaussian q and any likelihood. Each run twists the model by what the run before found of
    the observations to come; on linear Gaussian models one iteration is exact but for rounding. The estimate of every
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
        scheme: Function of `jaxfilters.resampling`.
        ess_threshold: As for `auxiliary`.

    Returns:
        The log evidence, those of all runs, and the ensembles of the last run.

    Raises:
        TypeError: If an argument is of another kind.
        ValueError: If shapes or lengths do not fit one another, a covariance is not one, or a number is out of range.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> prior, log_likelihood = jf.Gaussian(jnp.zeros(1), one), lambda x, y: jf.Gaussian(x, one).logpdf(y)
        >>> ys = jnp.array([[0.5], [2.0], [1.0]])
        >>> found = jf.iterated_auxiliary(
        ...     jax.random.key(0), prior, lambda x: 0.9 * x, one, log_likelihood, ys, num_particles=50
        ... )
        >>> exact = jf.log_evidence(jf.kalman(prior, 0.9 * one, one, one, one), jax.random.key(0), ys)
        >>> bool(jnp.isclose(found.log_evidence, exact, atol=1e-4))
        True
    """
    checks.check_gaussian("prior", prior)
    size = prior.mean.shape[0]
    if not callable(process_noise):
        checks.check_covariance("process_noise", process_noise, size)
    checks.check_num_particles(num_particles, (size + 1) * (size + 2) // 2 + 1)
    checks.check_num_particles(iterations, name="iterations")
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
    plain = Twisting(zeros, jnp.zeros((length + 1, size, size), zeros.dtype), zeros, zeros[:, 0])

    def refine(twisting: Twisting, key: AnyKey) -> tuple[Twisting, Array]:
        found = _run(filter, key, observations, _StepInputs(inputs, twisting, is_first))
        refined = _fitted(model, found.history, observations, _StepInputs(inputs, twisting, is_first))
        return jax.lax.stop_gradient(refined), found.log_evidence

    *keys, last_key = jax.random.split(key, iterations + 1)
    twisting, estimates = jax.lax.scan(refine, plain, jnp.stack(keys))
    found = _run(filter, last_key, observations, _StepInputs(inputs, twisting, is_first))
    history = jax.tree.map(lambda leaf: leaf[1:], found.history)
    return IteratedAuxiliary(found.log_evidence, jnp.append(estimates, found.log_evidence), history)


class _Found(NamedTuple):
    log_evidence: Float[Array, ""]
    history: History


def _run(filter: Filter, key: AnyKey, observations: PyTree, steps: _StepInputs) -> _Found:
    _, (history, log_evidence) = run(filter, key, observations, steps, collect=_keep)
    return _Found(log_evidence.sum(), history)


def _keep(state: AuxiliaryState, info: ParticleInfo) -> tuple[History, Array]:
    return History(state.particles, state.log_weights, state.ancestors), info.log_evidence


def _fitted(model: _Twisted, history: History, observations: PyTree, steps: _StepInputs) -> Twisting:
    """Twisting functions fitted to the particles of a run, from the last step to the first."""
    size = model.prior.mean.size

    def back(following: tuple[_StepInputs, Array], step: tuple) -> tuple[tuple[_StepInputs, Array], Twisting]:
        next_step, has_next = following
        particles, log_weights, y, here = step
        score = jax.vmap(model.log_likelihood, in_axes=(-1, None, None))(particles, y, here)
        ahead = jax.vmap(lambda x: model.posterior(x, next_step)[1], in_axes=-1)(particles)
        twisting = _regression(particles, log_weights, score + jnp.where(has_next, ahead, 0.0))
        return (here._replace(twisting=twisting), jnp.array(True)), twisting

    last = jax.tree.map(lambda leaf: leaf[-1], steps)
    each = (history.particles, history.log_weights, observations, steps)
    _, twisting = jax.lax.scan(back, (last, jnp.array(False)), each, reverse=True)
    return twisting


def _regression(x: Float[Array, "n count"], log_weights: Float[Array, " count"], values: Array) -> Twisting:
    """The quadratic function next to values at weighted particles, with the part of its curvature that is concave."""
    size, count = x.shape
    usable = jnp.isfinite(values)
    share = _SHARE_OF_WEIGHTS * weights.linear(log_weights) + (1 - _SHARE_OF_WEIGHTS) / count
    share = jnp.where(usable, share, 0.0)
    total = jnp.maximum(jnp.sum(share), jnp.finfo(x.dtype).tiny)
    center = x @ share / total
    spread = jnp.sqrt(((x - center[:, None]) ** 2) @ share / total)
    spread = jnp.where(spread > 0, spread, 1.0)
    s = (x - center[:, None]) / spread[:, None]
    level = jnp.sum(jnp.where(usable, values, 0.0) * share) / total
    rows, columns = jnp.triu_indices(size)
    features = jnp.concatenate([jnp.ones((1, count), x.dtype), s, s[rows] * s[columns]])
    root = jnp.sqrt(share)
    found = jnp.linalg.lstsq((features * root).T, jnp.where(usable, values - level, 0.0) * root)[0]
    upper = jnp.zeros((size, size), x.dtype).at[rows, columns].set(found[1 + size :])
    scale = 1 / spread
    curvature = -(upper + upper.T) * scale[:, None] * scale
    eigenvalues, vectors = jnp.linalg.eigh(curvature)
    concave = matmul(vectors * jnp.maximum(eigenvalues, 0.0), vectors.T)
    return Twisting(center, concave, found[1 : 1 + size] * scale, found[0] + level)


def _length(observations: Any, inputs: Any) -> int:
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves((observations, inputs))}
    if len(lengths) != 1 or lengths & {(), (0,)} or not jax.tree.leaves(observations):
        shown = ", ".join(str(length[0]) if length else "a scalar" for length in sorted(lengths)) or "none"
        raise ValueError(f"observations and inputs must share one length along their first axis; got {shown}.")
    return lengths.pop()[0]
