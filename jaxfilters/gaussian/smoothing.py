"""Beliefs given the future too: the Rauch-Tung-Striebel smoother of any filter made by `extended`."""

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxfilters.filter import Filter, keep_all, run
from jaxfilters.gaussian.manifold import Belief, increments, retract_belief, to_tangent
from jaxfilters.gaussian.model import GaussianModel, model_of
from jaxfilters.typing import AnyKey, Mask


def filter_and_smooth(
    filter: Filter, key: AnyKey, observations: PyTree, controls: PyTree = None, *, mask: Mask | None = None
) -> tuple[Belief, PyTree]:
    """Beliefs given the whole sequence, time first, and the infos of the filter that found them.

    `infos.log_evidence.sum()` is the log evidence of the sequence. Arguments as for `jaxfilters.run`.
    """
    _, (beliefs, infos) = run(filter, key, observations, controls, mask=mask, collect=keep_all)
    return rts(filter, beliefs, controls), infos


def rts(filter: Filter, beliefs: Belief, controls: PyTree = None) -> Belief:
    """Beliefs given the whole sequence, time first, from those of the filter, each given the past.

    Each is conditioned on what the next one, which already knows the future, says of the step between them (S. Särkkä,
    "Bayesian Filtering and Smoothing", 2013, theorem 8.2; made linear as `filter` does, section 9.2). A frame without
    an observation is no different: its belief is the prediction.

    Args:
        filter: Made by `extended`.
        beliefs: The states that `run` collects, time first; or what a wrapper of the filter made of them.
        controls: As `run` had them, time first.

    Raises:
        ValueError: If `filter` is another kind of filter, or `controls` has another length than `beliefs`.
    """
    model = model_of(filter, "filter")
    length = beliefs.mean.shape[0]
    lengths = {leaf.shape[0] for leaf in jax.tree.leaves(controls)}
    if not lengths <= {length}:
        raise ValueError(f"controls must be as long as beliefs, {length}; got {sorted(lengths)}.")
    return _backward(model, beliefs, controls)


@jax.jit
def _backward(model: GaussianModel, beliefs: Belief, controls: PyTree) -> Belief:
    def step(following: Belief, inputs: tuple) -> tuple[Belief, Belief]:
        belief, control = inputs
        origin, ahead = model.linear_transition(belief, control)
        known = to_tangent(model.manifold, origin, following)
        noise = model.process_noise_of(control)
        delta = model.arithmetic.rts(increments(belief), known, ahead.F, noise, ahead.value, ahead.lost_root)
        smoothed = retract_belief(model.manifold, belief.mean, delta)
        return smoothed, smoothed

    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], beliefs)
    _, smoothed = jax.lax.scan(step, last, (earlier, jax.tree.map(lambda leaf: leaf[1:], controls)), reverse=True)
    return jax.tree.map(lambda most, end: jnp.concatenate([most, end[None]]), smoothed, last)
