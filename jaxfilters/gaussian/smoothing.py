"""Smoothing of any filter made by `extended_kalman` or `kalman`: beliefs, covariances and samples of all states.

The states of a sequence given all of its observations are a Markov chain backwards in time: given the next state and
the observations until now, a state is Gaussian, with a mean that is linear in the next state.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from jaxfilters._renamed import takes_inputs
from jaxfilters.filter import Filter, keep_all, run
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.linearize import lower_root
from jaxfilters.gaussian.manifold import Belief, dimension, increments, retract_belief, to_tangent
from jaxfilters.gaussian.model import GaussianModel, model_of
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, Mask


@takes_inputs
def filter_and_smooth(
    filter: Filter, key: AnyKey, observations: PyTree, inputs: PyTree = None, *, mask: Mask | None = None
) -> tuple[Belief, PyTree]:
    """Smoothed beliefs given the whole sequence, time first, and the infos of the filter.

    `infos.log_evidence.sum()` is the log evidence of the sequence.

    Args:
        filter: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman`.
        key: Random key; the filter ignores it.
        observations: Observations, time first, as for `jf.run`.
        inputs: Known inputs, time first, or `None`.
        mask: False for frames without an observation, (t,).

    Returns:
        The smoothed beliefs, with leaves (t, n) and (t, d, d), and the infos of the filter.

    Raises:
        ValueError: If `filter` is another kind of filter, or lengths differ.
        TypeError: If `filter` is no filter.

    Examples:
        A constant with the prior N(0, 1), observed as 4 three times with noise of variance 1: its mean is 12 / 4.

        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> filter = jf.kalman(prior, one, 0.0 * one, one, one)
        >>> smoothed, infos = jf.smoothing.filter_and_smooth(filter, jax.random.key(0), jnp.full((3, 1), 4.0))
        >>> [round(float(mean), 3) for mean in smoothed.mean[:, 0]]
        [3.0, 3.0, 3.0]
    """
    checks.is_filter("filter", filter)
    model_of(filter, "filter")
    _, (beliefs, infos) = run(filter, key, observations, inputs, mask=mask, collect=keep_all)
    return rts(filter, beliefs, inputs), infos


@takes_inputs
def rts(filter: Filter, beliefs: Belief, inputs: PyTree = None) -> Belief:
    """Rauch-Tung-Striebel smoother: beliefs given the whole sequence, from those of the filter.

    Each belief is conditioned on the smoothed one of the next frame (S. Särkkä, "Bayesian Filtering and Smoothing",
    2013, theorem 8.2; linearised as `filter` does, section 9.2). A frame without an observation is no different: its
    belief is the prediction.

    Args:
        filter: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman`.
        beliefs: The states that `jf.run` collects, time first, with leaves (t, n) and (t, d, d); or those of a wrapper
            of the filter, such as `constrained`.
        inputs: The inputs of that run, time first.

    Returns:
        The smoothed beliefs, time first; the last is that of the filter.

    Raises:
        ValueError: If `filter` is another kind of filter, `beliefs` have other shapes than its states, or `inputs`
            another length than `beliefs`.
        TypeError: If `filter` is no filter, or `beliefs` are of another kind than its prior.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> filter = jf.extended_kalman(prior, lambda x: x, 0.1 * jnp.eye(1), lambda x: x, jnp.eye(1))
        >>> _, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)))
        >>> smoothed = jf.smoothing.rts(filter, beliefs)
        >>> bool((smoothed.covariance[:-1] < beliefs.covariance[:-1]).all())
        True
    """
    model, _ = _checked(filter, beliefs, inputs)
    return _backward(model, beliefs, inputs)


def lag_one_covariances(filter: Filter, beliefs: Belief, smoothed: Belief, inputs: PyTree = None) -> Array:
    r"""Covariances of neighbouring states given the whole sequence, Cov(x_t, x_t+1 | y_1:T).

    They are $G_t P_{t+1}$ with the smoother's gain $G_t$ and the smoothed covariance $P_{t+1}$ (S. Särkkä and
    L. Svensson, "Bayesian Filtering and Smoothing", 2nd edition, 2023, section 16.3.3), for each pair of frames.
    Expectation-maximisation needs them.

    Args:
        filter: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman`.
        beliefs: The states that `jf.run` collects, time first.
        smoothed: What `rts` made of them.
        inputs: The inputs of that run, time first.

    Returns:
        Covariances (t - 1, d, d), the earlier state along the rows, the later along the columns; on a manifold, of
        increments from the smoothed means.

    Raises:
        ValueError: As for `rts`; or if `smoothed` has other shapes than `beliefs`.
        TypeError: As for `rts`.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> filter = jf.kalman(prior, jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.eye(1))
        >>> _, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)))
        >>> jf.smoothing.lag_one_covariances(filter, beliefs, jf.smoothing.rts(filter, beliefs)).shape
        (4, 1, 1)
    """
    model, length = _checked(filter, beliefs, inputs)
    if checks.beliefs("smoothed", smoothed, model.prior) != length:
        raise ValueError(f"smoothed must be as long as beliefs, {length}; got {smoothed.mean.shape[0]}.")
    return _lag_one(model, beliefs, smoothed, inputs)


def posterior_samples(
    filter: Filter, key: AnyKey, beliefs: Belief, inputs: PyTree = None, *, num_samples: int
) -> Array:
    """Joint samples of all states given the whole sequence, by backward sampling.

    From the last frame to the first, a state is drawn given the next one and the observations until then (S.
    Frühwirth-Schnatter, "Data augmentation and dynamic linear models", Journal of Time Series Analysis 15(2), 1994;
    C. K. Carter and R. Kohn, "On Gibbs sampling for state space models", Biometrika 81(3), 1994). Of a linear model
    the samples are exact; of another one they are those of its linearisation about the filter's beliefs, as `rts` has
    it. Every sample is a differentiable function of the beliefs and of the filter.

    Args:
        filter: Filter made by `extended_kalman`, `unscented_kalman`, `cubature_kalman` or `kalman`.
        key: Random key.
        beliefs: The states that `jf.run` collects, time first.
        inputs: The inputs of that run, time first.
        num_samples: Number of sampled sequences of states.

    Returns:
        Samples (t, n, num_samples), independent along the last axis.

    Raises:
        ValueError: As for `rts`; or if `num_samples < 1`.
        TypeError: As for `rts`.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> filter = jf.kalman(prior, jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.eye(1))
        >>> _, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)))
        >>> jf.smoothing.posterior_samples(filter, jax.random.key(1), beliefs, num_samples=100).shape
        (5, 1, 100)
    """
    model, _ = _checked(filter, beliefs, inputs)
    checks.count("num_samples", num_samples)
    return _sampled(model, key, beliefs, inputs, num_samples)


def _checked(filter: Filter, beliefs: Belief, inputs: PyTree) -> tuple[GaussianModel, int]:
    """The model of a filter, and the number of frames."""
    checks.is_filter("filter", filter)
    model = model_of(filter, "filter")
    length = checks.beliefs("beliefs", beliefs, model.prior)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(inputs)}
    if not lengths <= {(length,)}:
        raise ValueError(f"inputs must be as long as beliefs, {length}; got {sorted(lengths)}.")
    return model, length


def _pairs(beliefs: Belief, inputs: PyTree) -> tuple[Belief, PyTree]:
    """Every belief but the last, with the inputs of the step that follows it."""
    return jax.tree.map(lambda leaf: leaf[:-1], beliefs), jax.tree.map(lambda leaf: leaf[1:], inputs)


def reverse_transition(model: GaussianModel, belief: Belief, inputs: PyTree) -> tuple[Array, Array, Belief]:
    """A state given the next one: as increments, it is a gain times that from the origin, plus an independent belief.

    Returns:
        The origin of the next state's increments; the gain; and the belief.
    """
    origin, ahead = model.linear_transition(belief, inputs)
    noise = model.process_noise_of(belief, inputs)
    return origin, *model.arithmetic.backward(increments(belief), ahead.F, noise, ahead.value, ahead.residual_root)


@jax.jit
def smoothed_pairs(filter: Filter, beliefs: Belief, inputs: PyTree) -> tuple[Array, Array, Array]:
    """Moments of all states, the one before the first observation among them, given the whole sequence.

    The states are vectors. Returns the means (t + 1, n), the covariances (t + 1, n, n), and the covariances of
    neighbours (t, n, n), whatever the arithmetic.
    """
    model = model_of(filter, "filter")
    prior = model.prior
    if isinstance(prior, GaussianRoot):
        prior = GaussianRoot(prior.mean, linalg.tria(prior.root))
    earlier = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:-1]]), prior, beliefs)

    def step(following: tuple[Array, Array], frame: tuple) -> tuple[tuple, tuple]:
        (mean, P), (belief, inputs) = following, frame
        origin, gain, rest = reverse_transition(model, belief, inputs)
        cross = linalg.matmul(gain, P)
        smoothed = belief.mean + rest.mean + factor.apply(gain, mean - origin)
        covariance = factor.outer(cross, gain) + _covariance(rest)
        return (smoothed, covariance), (smoothed, covariance, cross)

    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    end = last.mean, _covariance(last)
    _, (means, covariances, cross) = jax.lax.scan(step, end, (earlier, inputs), reverse=True)
    return jnp.concatenate([means, end[0][None]]), jnp.concatenate([covariances, end[1][None]]), cross


def _covariance(belief: Belief) -> Array:
    return belief.covariance if isinstance(belief, Gaussian) else factor.outer(belief.root, belief.root)


@jax.jit
def _lag_one(model: GaussianModel, beliefs: Belief, smoothed: Belief, inputs: PyTree) -> Array:
    def one(belief: Belief, inputs: PyTree, here: Belief, following: Belief) -> Array:
        origin, gain, _ = reverse_transition(model, belief, inputs)
        P = _covariance(following)
        if model.manifold.flat:
            return linalg.matmul(gain, P)
        manifold, zero = model.manifold, jnp.zeros(dimension(following), P.dtype)
        at = manifold.local(belief.mean, here.mean)
        onto = jax.jacfwd(lambda delta: manifold.local(here.mean, manifold.retract(belief.mean, delta)))(at)
        off = jax.jacfwd(lambda delta: manifold.local(origin, manifold.retract(following.mean, delta)))(zero)
        return linalg.matmul(linalg.matmul(onto, linalg.matmul(gain, off)), P)

    earlier, following = _pairs(beliefs, inputs)
    here, ahead = (jax.tree.map(lambda leaf, cut=cut: leaf[cut], smoothed) for cut in (slice(-1), slice(1, None)))
    return jax.lax.map(lambda each: one(*each), (earlier, following, here, ahead))


@partial(jax.jit, static_argnames="num_samples")
def _sampled(model: GaussianModel, key: AnyKey, beliefs: Belief, inputs: PyTree, num_samples: int) -> Array:
    manifold, length = model.manifold, beliefs.mean.shape[0]
    local, retract = (jax.vmap(f, in_axes=(None, -1), out_axes=-1) for f in (manifold.local, manifold.retract))
    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    width = lower_root(last).shape[0]
    noise = jax.random.normal(key, (length, width, num_samples), beliefs.mean.dtype)

    def step(following: Array, frame: tuple) -> tuple[Array, Array]:
        (belief, inputs), noise = frame
        origin, gain, rest = reverse_transition(model, belief, inputs)
        deltas = rest.mean[:, None] + _times(gain, local(origin, following)) + _times(lower_root(rest), noise)
        samples = retract(belief.mean, deltas)
        return samples, samples

    end = retract(last.mean, _times(lower_root(last), noise[-1]))
    _, earlier = jax.lax.scan(step, end, (_pairs(beliefs, inputs), noise[:-1]), reverse=True)
    return jnp.concatenate([earlier, end[None]])


def _times(A: Array, columns: Array) -> Array:
    return jnp.matmul(A, columns, precision="highest")


@jax.jit
def _backward(model: GaussianModel, beliefs: Belief, inputs: PyTree) -> Belief:
    def step(following: Belief, frame: tuple) -> tuple[Belief, Belief]:
        belief, inputs = frame
        origin, ahead = model.linear_transition(belief, inputs)
        next_belief = to_tangent(model.manifold, origin, following)
        noise = model.process_noise_of(belief, inputs)
        delta = model.arithmetic.rts(increments(belief), next_belief, ahead.F, noise, ahead.value, ahead.residual_root)
        smoothed = retract_belief(model.manifold, belief.mean, delta)
        return smoothed, smoothed

    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], beliefs)
    _, smoothed = jax.lax.scan(step, last, (earlier, jax.tree.map(lambda leaf: leaf[1:], inputs)), reverse=True)
    return jax.tree.map(lambda most, end: jnp.concatenate([most, end[None]]), smoothed, last)
