"""The Rauch-Tung-Striebel smoother of any filter made by `extended_kalman`: beliefs given a whole sequence."""

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxfilters._renamed import takes_inputs
from jaxfilters.filter import Filter, keep_all, run
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.manifold import Belief, increments, retract_belief, to_tangent
from jaxfilters.gaussian.model import GaussianModel, model_of
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

    Example:
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
    checks.is_filter("filter", filter)
    model = model_of(filter, "filter")
    length = checks.beliefs("beliefs", beliefs, model.prior)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(inputs)}
    if not lengths <= {(length,)}:
        raise ValueError(f"inputs must be as long as beliefs, {length}; got {sorted(lengths)}.")
    return _backward(model, beliefs, inputs)


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
