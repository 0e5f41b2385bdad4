r"""Draws from the backward kernel of a particle filter, by rejection: constant expected cost for each draw.

Given the next state x', an index is drawn with probability proportional to $w_j\, p(x' \mid x_j)$. A candidate drawn
with probability $w_j$ alone is accepted with probability $p(x' \mid x_j) / \sup p$ (R. Douc, A. Garivier, E. Moulines
and J. Olsson, "Sequential Monte Carlo smoothing for general state space hidden Markov models", Annals of Applied
Probability 21(6), 2011, section 4). What is not accepted after some candidates is drawn from all weights: the number of
candidates changes the time, not the distribution.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32, PyTree

from jaxfilters import weights
from jaxfilters.particle import checks
from jaxfilters.typing import AnyKey

_CHUNK = 64
"""Draws from all weights that are made together."""


def draw_index(log_weights: Float[Array, " n"], point: Float[Array, ""]) -> Int32[Array, ""]:
    """The index at which the cumulative sum of the weights exceeds the fraction `point` of the total."""
    totals = jnp.cumsum(weights.relative(log_weights))
    index = jnp.sum(totals <= point * totals[-1], dtype=jnp.int32)
    # Rounding may make the point equal to the total, which belongs to the last particle with any weight.
    return jnp.minimum(index, jnp.argmax(totals == totals[-1]).astype(jnp.int32))


def draw_backward(
    log_density: Callable[[PyTree, PyTree], Array],
    following: PyTree,
    particles: PyTree,
    log_weights: Float[Array, " n"],
    points: Float[Array, " m"],
) -> Int32[Array, " m"]:
    """Indices drawn from all weights, one for each of the next states, by uniform numbers `points`.

    Args:
        log_density: `(x_next, x) -> log p(x_next | x)`.
        following: The next states, leaves (..., m).
        particles: Particles, leaves (..., n).
        log_weights: Their log weights.
        points: Uniform numbers.
    """

    def one(x_next: PyTree, point: Array) -> Array:
        def of_particle(x: PyTree) -> Array:
            return checks.scalar_log_density("log_transition", log_density(x_next, x))

        return draw_index(log_weights + jax.vmap(of_particle, in_axes=-1)(particles), point)

    return jax.vmap(one, in_axes=(-1, 0))(following, points)


def draw_backward_by_rejection(
    key: AnyKey,
    log_density: Callable[[PyTree, PyTree], Array],
    log_bound: Array | float,
    following: PyTree,
    particles: PyTree,
    log_weights: Float[Array, " n"],
    max_candidates: int,
) -> tuple[Int32[Array, " m"], Array]:
    """As `draw_backward`, by rejection, and whether each density was below its bound.

    Args:
        key: Random key.
        log_density: `(x_next, x) -> log p(x_next | x)`.
        log_bound: An upper bound of it.
        following: The next states, leaves (..., m).
        particles: Particles, leaves (..., n).
        log_weights: Their log weights.
        max_candidates: Candidates before a draw from all weights.
    """
    # Indices have no derivatives, and a loop without an end that is known has none in reverse mode.
    following, particles, log_weights = jax.lax.stop_gradient((following, particles, log_weights))
    totals = jnp.cumsum(weights.relative(log_weights))
    highest = jnp.argmax(totals == totals[-1]).astype(jnp.int32)
    count = jax.tree.leaves(following)[0].shape[-1]
    loop_key, rest_key = jax.random.split(key)
    density = jax.vmap(
        lambda x_next, x: checks.scalar_log_density("log_transition", log_density(x_next, x)), in_axes=(-1, -1)
    )

    def unfinished(state: tuple) -> Array:
        return (state[0] < max_candidates) & ~jnp.all(state[2])

    def propose(state: tuple) -> tuple:
        i, chosen, done, below = state
        points = jax.random.uniform(jax.random.fold_in(loop_key, i), (2, count), log_weights.dtype)
        candidates = jnp.searchsorted(totals, points[0] * totals[-1], side="right", method="scan_unrolled")
        candidates = jnp.minimum(candidates.astype(jnp.int32), highest)
        log_ratio = jax.lax.stop_gradient(density(following, take(particles, candidates)) - log_bound)
        accepted = ~done & (jnp.log(points[1]) < log_ratio)
        # A little above the bound is rounding.
        below = below & (done | ~(log_ratio > 1e-3))
        return i + 1, jnp.where(accepted, candidates, chosen), done | accepted, below

    zeros, nothing = jnp.zeros(count, jnp.int32), jnp.zeros(count, bool)
    _, chosen, done, below = jax.lax.while_loop(unfinished, propose, (jnp.int32(0), zeros, nothing, ~nothing))
    points = jax.random.uniform(rest_key, (count,), log_weights.dtype)
    return _completed(log_density, following, particles, log_weights, points, chosen, done), below


def _completed(log_density, following, particles, log_weights, points, chosen, done):
    """The indices, those not drawn yet drawn from all weights, some at a time."""
    size = min(_CHUNK, done.size)

    def complete(state: tuple) -> tuple:
        chosen, done = state
        # Those not drawn come first; where fewer are left than fit, others are drawn again, and not used.
        where = jax.lax.top_k((~done).astype(jnp.int32), size)[1]
        found = draw_backward(log_density, take(following, where), particles, log_weights, points[where])
        return chosen.at[where].set(jnp.where(done[where], chosen[where], found)), done.at[where].set(True)

    return jax.lax.while_loop(lambda state: ~jnp.all(state[1]), complete, (chosen, done))[0]


def take(particles: PyTree, chosen: Int32[Array, " m"]) -> PyTree:
    """The chosen particles."""
    return jax.tree.map(lambda leaf: jnp.take(leaf, chosen, axis=-1, mode="clip"), particles)
