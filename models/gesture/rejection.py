"""How well a stroke is explained by the states of all symbols in any order: what a symbol has to beat.

The threshold model of `hmm.threshold_model` for symbols in parallel, whose transitions are a diagonal and a product of
two vectors: a frame costs as much as there are states, not the square of that.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxfilters.hmm import HiddenMarkovModel

LEAVING = 0.1
"""Probability of leaving a symbol in its last state, as in `hmm.parallel_composition`."""


def threshold_log_likelihood(
    models: HiddenMarkovModel, log_likelihoods: Float[Array, "m t q n"], lengths: Int[Array, " n"]
) -> Float[Array, " n"]:
    """Log p(y_1:T) of each of n strokes: `hmm.log_evidence` of `hmm.threshold_model` of the models side by side.

    Args:
        models: Leaves with the m models first; each may end in its last state.
        log_likelihoods: Of the states of every model in every frame.
        lengths: Frames of each stroke.
    """
    num_models, num_frames, num_states, num_strokes = log_likelihoods.shape
    stays = jnp.exp(jnp.diagonal(models.log_transition, axis1=1, axis2=2))
    stays = stays.at[:, -1].multiply(1 - LEAVING).reshape(-1, 1)
    leaves = (1 - stays) / max(num_models * num_states - 1, 1)
    frames = jnp.moveaxis(log_likelihoods, 0, 1).reshape(num_frames, -1, num_strokes)

    def step(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
        shares, total = carry
        observed, frame = inputs
        left = leaves * shares
        predicted = jnp.where(frame == 0, shares, stays * shares + (jnp.sum(left, axis=0) - left))
        peak = jnp.max(observed, axis=0)
        usable = peak > -jnp.inf
        after = predicted * jnp.exp(observed - jnp.where(usable, peak, 0.0))
        mass = jnp.sum(after, axis=0)
        usable = usable & (mass > 0)
        growth = jnp.where(usable, peak + jnp.log(jnp.where(usable, mass, 1.0)), -jnp.inf)
        after = after / jnp.where(usable, mass, 1.0)
        inside = frame < lengths
        return (jnp.where(inside, after, shares), jnp.where(inside, total + growth, total)), None

    even = jnp.full((num_models * num_states, num_strokes), 1 / (num_models * num_states), frames.dtype)
    start = (even, jnp.zeros(num_strokes, frames.dtype))
    usable = jnp.where(jnp.isnan(frames), -jnp.inf, frames)
    (_, total), _ = jax.lax.scan(step, start, (usable, jnp.arange(num_frames)))
    return total
