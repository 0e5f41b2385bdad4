r"""The mixture Kalman filter: modes are sampled, and the state given their sequence is a Gaussian.

$$s_t \sim \Pi_{s_{t-1}, \cdot},\qquad x_t, y_t \sim \text{model } s_t \text{ given } x_{t-1}.$$

A particle is a sequence of modes with its Gaussian. One that stands before an observation has as many successors as
there are modes. All of them are predicted and updated, so that the state after an update holds every successor of
every particle with its weight, and the choice among them begins the next prediction. The ensemble axis is the last
axis of every leaf; the successors in mode 0 of all particles come first, then those in mode 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int32, Num, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.gaussian import bank as banks
from jaxfilters.gaussian.bank import Bank
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.particle import checks
from jaxfilters.particle.resampling import Survivors, optimal
from jaxfilters.particle.tempering import no_tempering
from jaxfilters.particle.weighting import ParticleInfo, reweight
from jaxfilters.typing import AnyKey, ResamplingScheme


class SwitchingParticle(NamedTuple):
    """The current mode of a sequence of modes, and the belief about the state given the sequence."""

    mode: Int32[Array, " n"]
    belief: Belief
    """A Gaussian of means (d, n) and covariances (d, d, n), or of roots."""


class SwitchingState(NamedTuple):
    """The successors of all particles, n = number of particles times number of modes."""

    particles: SwitchingParticle
    log_weights: Float[Array, " n"]
    """Normalised after an update; `-inf` where there is no sequence."""
    ancestors: Int32[Array, " n"]
    """Index of the parent in the state before the last prediction."""
    log_probabilities: Float[Array, " k"]
    """Log probabilities of the modes."""

    @property
    def probabilities(self) -> Float[Array, "*t k"]:
        """Probabilities of the modes."""
        return jnp.exp(self.log_probabilities)


@pytree_dataclass
class Switching:
    """Parameters of a filter made by `switching`; its arguments describe them."""

    bank: Bank
    transition: Array | Callable
    initial: Float[Array, " k"]
    num_particles: int = field(metadata={"static": True})
    scheme: ResamplingScheme | Callable[..., Survivors] = field(metadata={"static": True})


def switching(
    filters: Sequence[Filter],
    transition_matrix: Num[ArrayLike, "..."] | Sequence[Sequence[float]] | Callable[[PyTree], Array],
    initial_probabilities: Num[ArrayLike, "..."] | Sequence[float],
    *,
    num_particles: int,
    scheme: ResamplingScheme | Callable[..., Survivors] = optimal,
) -> Filter:
    """Mixture Kalman filter: particles are sequences of k modes, each with the Gaussian of a bank of filters.

    The state of a switching linear Gaussian system is integrated out exactly, so that only the discrete modes have a
    Monte Carlo error (R. Chen and J. S. Liu, "Mixture Kalman filters", Journal of the Royal Statistical Society B
    62(3), 2000; A. Doucet, N. Gordon and V. Krishnamurthy, "Particle filters for state estimation of jump Markov linear
    systems", IEEE Transactions on Signal Processing 49(3), 2001). All k successors of a particle are weighed by the
    next observation before a choice is made, so no proposal is needed. The estimate of the evidence is unbiased where
    the filters are exact; extended and unscented filters bring their approximation. While there are at most
    `num_particles` sequences of modes, `resampling.optimal` keeps all of them and the filter is exact.

    The state is a `SwitchingState`: `state.probabilities` are those of the modes, and
    `mixture_moments(state.particles.belief, state.log_weights)` is the mean and covariance of the state. The info is a
    `ParticleInfo`. `smoothing.keep_history` and `smoothing.trajectories` give the sequences of modes.

    Args:
        filters: One filter for each mode, as for `imm`, with states of one size.
        transition_matrix: (k, k), with rows that sum to one: [i, j] is the probability that mode j follows mode i. Or a
            function `inputs -> (k, k)` of the inputs of the step.
        initial_probabilities: (k,), of the modes before the first observation; the first prediction applies the
            transition matrix to them.
        num_particles: Number n of sequences of modes that are continued; every step costs n k filters.
        scheme: How n of n k weighted sequences are chosen: `resampling.optimal`, or another function of
            `jf.resampling`, which draws particles by the sum of the weights of their successors, and a successor of
            each.

    Returns:
        The filter, for `jf.run`, `jf.log_evidence` and `jf.step`.

    Raises:
        ValueError: If `filters` is empty, or holds one whose state is not Gaussian, or states of different kinds, sizes
            or manifolds; if `transition_matrix` or `initial_probabilities` have another shape than that of k modes, or
            are no probabilities that sum to one (tested where their values are known); if `num_particles < 1`.
        TypeError: If `filters` is no list of filters, or `scheme` no function.

    Examples:
        A point that rests or moves at random.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> rests, moves = (jf.kalman(prior, one, variance * one, one, 0.1 * one) for variance in (1e-6, 4.0))
        >>> transition = jnp.array([[0.95, 0.05], [0.1, 0.9]])
        >>> filter = jf.switching([rests, moves], transition, jnp.array([0.5, 0.5]), num_particles=50)
        >>> ys = jnp.concatenate([jnp.zeros((10, 1)), jnp.array([[2.0], [-1.0], [3.0], [1.0]])])
        >>> last, infos = jf.run(filter, jax.random.key(0), ys, collect=jf.keep_info)
        >>> bool(last.probabilities[1] > 0.9)
        True
        >>> jf.mixture_moments(last.particles.belief, last.log_weights).covariance.shape
        (1, 1)
    """
    banks.check_filters(filters, one_size="; components that a mode does not use can have the process noise zero")
    checks.check_num_particles(num_particles)
    checks.check_callables(scheme=scheme)
    count = len(filters)
    params = Switching(
        banks.bank_of(filters),
        banks.transition_of(transition_matrix, count),
        banks.initial_probabilities("initial_probabilities", initial_probabilities, count),
        num_particles,
        scheme,
    )
    return Filter(params, _init, _predict, _update)


def _init(model: Switching, key: AnyKey) -> SwitchingState:
    count, num = model.bank.count, model.num_particles

    beliefs = model.bank.apply(lambda filter: filter.init(filter.params, key))
    belief = jax.tree.map(lambda *leaves: jnp.repeat(jnp.stack(leaves, axis=-1), num, axis=-1), *beliefs)
    possible = model.initial > 0
    log_initial = jnp.where(possible, jnp.log(jnp.where(possible, model.initial, 1.0)), -jnp.inf)
    log_initial = log_initial.astype(belief.mean.dtype)
    # One sequence for each mode; the other places are empty.
    log_weights = jnp.full((count, num), -jnp.inf, log_initial.dtype).at[:, 0].set(log_initial).reshape(-1)
    particles = SwitchingParticle(_modes(count, num), belief)
    return SwitchingState(particles, log_weights, jnp.arange(count * num, dtype=jnp.int32), log_initial)


def _predict(model: Switching, key: AnyKey, state: SwitchingState, inputs: PyTree) -> SwitchingState:
    count, num = model.bank.count, model.num_particles
    transition = banks.transition_at(model.transition, inputs, count).astype(state.log_weights.dtype)
    chosen, log_weights = _chosen(model, key, state.log_weights)
    places = jnp.tile(chosen, count)
    parents = jax.tree.map(lambda leaf: jnp.take(leaf, places, axis=-1, mode="clip"), state.particles.belief)
    ahead = lambda filter, belief: filter.predict(filter.params, key, belief, inputs)
    possible = transition > 0
    log_transition = jnp.where(possible, jnp.log(jnp.where(possible, transition, 1.0)), -jnp.inf)
    # Rows are the modes that follow, columns the parents.
    successors = log_transition.T[:, chosen // num] + log_weights
    return SwitchingState(
        SwitchingParticle(_modes(count, num), model.bank.apply_to_ensemble(ahead, parents)),
        successors.reshape(-1),
        places,
        _of_modes(successors),
    )


def _update(
    model: Switching, key: AnyKey, state: SwitchingState, observation: PyTree, inputs: PyTree
) -> tuple[SwitchingState, ParticleInfo]:
    def after(filter: Filter, belief: Belief) -> tuple[Belief, Array]:
        updated, info = filter.update(filter.params, key, belief, observation, inputs)
        return updated, info.log_evidence

    belief, log_likelihoods = model.bank.apply_to_ensemble(after, state.particles.belief)
    log_weights, info = reweight(state.log_weights, log_likelihoods, state.ancestors, no_tempering)
    # Where no sequence explains the observation, the prediction is all that is known.
    dead = info.log_evidence == -jnp.inf
    belief = jax.tree.map(lambda new, old: jnp.where(dead, old, new), belief, state.particles.belief)
    log_weights = jnp.where(dead, state.log_weights, log_weights)
    log_probabilities = _of_modes(log_weights.reshape(model.bank.count, -1))
    particles = state.particles._replace(belief=belief)
    return state._replace(particles=particles, log_weights=log_weights, log_probabilities=log_probabilities), info


def _of_modes(log_weights: Float[Array, "k n"]) -> Float[Array, " k"]:
    totals = jnp.sum(weights.linear(log_weights.reshape(-1)).reshape(log_weights.shape), axis=1)
    return jnp.where(totals > 0, jnp.log(jnp.where(totals > 0, totals, 1.0)), -jnp.inf)


def _modes(count: int, num: int) -> Int32[Array, " n"]:
    return jnp.repeat(jnp.arange(count, dtype=jnp.int32), num)


def _chosen(model: Switching, key: AnyKey, log_weights: Float[Array, " n"]) -> tuple[Array, Array]:
    """Indices of the sequences that are continued, and their log weights."""
    num = model.num_particles
    if model.scheme is optimal:
        survivors = optimal(key, log_weights, num)
        return survivors.indices, survivors.log_weights
    scheme_key, mode_key = jax.random.split(key)
    normalized, log_sum = weights.normalize(log_weights)
    table = jax.lax.stop_gradient(normalized).reshape(model.bank.count, num)
    ancestors = jnp.asarray(model.scheme(scheme_key, jax.nn.logsumexp(table, axis=0)))
    checks.check_ancestors(ancestors, num)
    mode = jax.random.categorical(mode_key, table[:, ancestors], axis=0)
    chosen = (mode * num + ancestors).astype(jnp.int32)
    # The weights are equal, with the derivatives of the old ones.
    kept = normalized[chosen]
    kept = jnp.where(jnp.isfinite(kept), kept, 0.0)
    return chosen, log_sum + weights.uniform(num, kept.dtype) + kept - jax.lax.stop_gradient(kept)
