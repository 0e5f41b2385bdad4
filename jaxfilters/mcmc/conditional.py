r"""Conditional sequential Monte Carlo: a Markov kernel on whole trajectories of a state-space model.

One sweep runs a bootstrap filter among whose particles one, at index 0, follows a given trajectory, and draws a new
trajectory from the result. It leaves the smoothing distribution $p(x_{0:T} \mid y_{1:T})$ invariant for any number of
particles of at least 2 (C. Andrieu, A. Doucet and R. Holenstein, "Particle Markov chain Monte Carlo methods", Journal
of the Royal Statistical Society B 72, 2010, section 4.3). A trajectory has the state before the first observation as
its first row, and then one row a frame.
"""

from collections.abc import Callable
from dataclasses import field
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int32, PyTree

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.filter import Filter
from jaxfilters.mcmc import checks
from jaxfilters.mcmc.conditional_resampling import ConditionalScheme, conditional_systematic, systematic_at
from jaxfilters.mcmc.redraw import Redraw, ancestry
from jaxfilters.particle import checks as particle_checks
from jaxfilters.particle.bootstrap import Bootstrap
from jaxfilters.particle.smoothing import History
from jaxfilters.priors import sample_ensemble
from jaxfilters.typing import AnyKey


class PathInfo(NamedTuple):
    """Diagnostics of one sweep of conditional sequential Monte Carlo."""

    changed: Bool[Array, " t_plus_1"]
    """Whether the state of each row differs from that of the trajectory before; its mean over sweeps is the update
    rate, which falls towards early rows where trajectories are ancestral."""
    num_invalid: Int32[Array, ""]
    """Number of particles whose log-likelihood was NaN or `+inf`, all frames together; they were given weight zero."""
    num_impossible: Int32[Array, ""]
    """Number of frames that no particle explains, or into whose given state `log_transition` lets none of them move,
    not even its own predecessor, or where that density is NaN or `+inf` for a particle with weight. Where it is not 0
    the trajectory is no draw from the posterior."""


@pytree_dataclass
class ConditionalSMC:
    """A kernel on trajectories; made by `conditional_smc`."""

    model: Bootstrap
    redraw: Redraw
    scheme: ConditionalScheme = field(metadata={"static": True})


def conditional_smc(
    filter: Filter, redraw: Redraw, *, scheme: ConditionalScheme = conditional_systematic
) -> ConditionalSMC:
    """Build the kernel on trajectories that belongs to a bootstrap filter.

    It resamples before every frame with its own scheme, whatever the scheme and the `ess_threshold` of the filter are.

    Args:
        filter: What `bootstrap` returns, of at least 2 particles and without tempering.
        redraw: `ancestral()`, `ancestor_sampling(log_transition)` or `backward_sampling(log_transition)`.
        scheme: `conditional_systematic` or `conditional_multinomial`, or another one of the same kind.

    Returns:
        The kernel, for `initial_path`, `update_path` and `particle_gibbs`.

    Raises:
        TypeError: If `filter` was not made by `bootstrap`, or `redraw` or `scheme` is of another kind.
        ValueError: If it has one particle only, or tempers its likelihoods, which would change the target.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(lambda key: 0.0, lambda e, x: x + e, lambda x, y: -((x - y) ** 2),
        ...     num_particles=20, noise=jf.StandardNormal(()))
        >>> redraw = jf.mcmc.ancestor_sampling(lambda x_next, x: -0.5 * (x_next - x) ** 2)
        >>> kernel, ys = jf.mcmc.conditional_smc(pf, redraw), jnp.ones(5)
        >>> path, info = jf.mcmc.initial_path(jax.random.key(0), kernel, ys)
        >>> path, info = jf.mcmc.update_path(jax.random.key(1), kernel, path, ys)
        >>> path.shape, int(info.num_invalid)
        ((6,), 0)
    """
    checks.check_bootstrap(filter)
    if not (callable(getattr(redraw, "parent", None)) and callable(getattr(redraw, "trace", None))):
        raise TypeError(
            f"redraw must be ancestral(), ancestor_sampling(...) or backward_sampling(...); got {redraw!r}."
        )
    particle_checks.check_callables(scheme=scheme)
    return ConditionalSMC(filter.params, redraw, scheme)


def initial_path(
    key: AnyKey,
    kernel: ConditionalSMC,
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
) -> tuple[PyTree, PathInfo]:
    """A trajectory to start from: one of those that the filter finds without a given one.

    Args:
        key: Random key.
        kernel: What `conditional_smc` returns.
        observations: Pytree whose leaves have time as their first axis, (t, ...).
        inputs: Pytree of known inputs, time first, or `None`.
        mask: Booleans (t,), `False` for frames without an observation.

    Returns:
        States, leaves `(t + 1, ...)`, of which the first is the one before the first observation; and the diagnostics.

    Raises:
        ValueError: If the leaves of `observations`, `inputs` and `mask` do not share one length; or, where that is
            known, if no particle explains a frame.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(lambda key: 0.0, lambda e, x: x + e, lambda x, y: -((x - y) ** 2),
        ...     num_particles=20, noise=jf.StandardNormal(()))
        >>> kernel = jf.mcmc.conditional_smc(pf, jf.mcmc.ancestral())
        >>> path, info = jf.mcmc.initial_path(jax.random.key(0), kernel, jnp.array([0.2, -0.3, 0.4]))
        >>> path.shape, int(info.num_impossible)
        ((4,), 0)
    """
    path, info = _initial(key, kernel, observations, inputs, mask)
    checks.check_where_concrete(
        info.num_impossible,
        lambda number: number == 0,
        "observations must have a finite log_likelihood for some particle in every frame; got {} frames without.",
    )
    return path, info


@jax.jit
def _initial(
    key: AnyKey, kernel: ConditionalSMC, observations: PyTree, inputs: PyTree, mask: Array | None
) -> tuple[PyTree, PathInfo]:
    sweep_key, trace_key = jax.random.split(key)
    history, *counts = _sweep(sweep_key, kernel, None, observations, inputs, mask)
    path = ancestry(trace_key, history)
    return path, PathInfo(jnp.ones(history.log_weights.shape[0], bool), *counts)


@jax.jit
def update_path(
    key: AnyKey,
    kernel: ConditionalSMC,
    path: PyTree,
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
) -> tuple[PyTree, PathInfo]:
    """One sweep: a trajectory from the kernel that leaves the smoothing distribution invariant.

    Args:
        key: Random key.
        kernel: What `conditional_smc` returns.
        path: The trajectory before, leaves `(t + 1, ...)`.
        observations: Pytree whose leaves have time as their first axis, (t, ...).
        inputs: Pytree of known inputs, time first, or `None`.
        mask: Booleans (t,), `False` for frames without an observation.

    Returns:
        The next trajectory, leaves `(t + 1, ...)`, and the diagnostics of the sweep.

    Raises:
        ValueError: If the leaves of `observations`, `inputs` and `mask` do not share one length, or `path` is not of
            the shape that the model and this length give.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> pf = jf.bootstrap(lambda key: 0.0, lambda e, x: x + e, lambda x, y: -((x - y) ** 2),
        ...     num_particles=20, noise=jf.StandardNormal(()))
        >>> kernel, ys = jf.mcmc.conditional_smc(pf, jf.mcmc.ancestral()), jnp.array([0.2, -0.3, 0.4])
        >>> path, _ = jf.mcmc.initial_path(jax.random.key(0), kernel, ys)
        >>> path, info = jf.mcmc.update_path(jax.random.key(1), kernel, path, ys)
        >>> path.shape, info.changed.shape
        ((4,), (4,))
    """
    sweep_key, trace_key = jax.random.split(key)
    history, *counts = _sweep(sweep_key, kernel, path, observations, inputs, mask)
    after = kernel.redraw.trace(trace_key, history, inputs)
    return after, PathInfo(_rows_that_differ(path, after), *counts)


def _sweep(
    key: AnyKey, kernel: ConditionalSMC, path: PyTree, observations: PyTree, inputs: PyTree, mask: Array | None
) -> tuple[History, Int32[Array, ""], Int32[Array, ""]]:
    """Ensembles of all frames, row 0 before the first, and the counts of `PathInfo`.

    Particle 0 follows `path` where it is not `None`.
    """
    length, model = checks.shared_length(observations=observations, inputs=inputs, mask=mask), kernel.model
    count = model.num_particles
    prior_key, noise_key, resample_key, point_key = jax.random.split(key, 4)
    particles = sample_ensemble(prior_key, model.sample_prior, count)
    checks.check_path(path, particles, length)
    particles = _with_first(particles, jax.tree.map(lambda leaf: leaf[0], path))
    start = particles, weights.uniform(count)
    frames = (
        jax.random.split(resample_key, length),
        # Drawn ahead: XLA would fuse the generator into the transition and evaluate it without vector instructions.
        jax.vmap(lambda key: model.noise(key, count))(jax.random.split(noise_key, length)),
        jax.random.uniform(point_key, (length,)),
        jax.tree.map(lambda leaf: leaf[1:], path),
        observations,
        inputs,
        mask,
    )
    _, (history, invalid, impossible) = jax.lax.scan(_frame(kernel, conditional=path is not None), start, frames)
    first = History(*start, jnp.arange(count, dtype=jnp.int32))
    joined = jax.tree.map(lambda row, rows: jnp.concatenate([row[None], rows]), first, history)
    return joined, jnp.sum(invalid), jnp.sum(impossible, dtype=jnp.int32)


def _frame(kernel: ConditionalSMC, *, conditional: bool) -> Callable:
    model = kernel.model
    move = jax.vmap(particle_checks.checked_transition(model.sample_transition), in_axes=(-1, -1, None), out_axes=-1)
    likelihoods = jax.vmap(particle_checks.checked_log_likelihood(model.log_likelihood), in_axes=(-1, None, None))

    def frame(carry: tuple, given: tuple) -> tuple[tuple, tuple]:
        particles, log_weights = carry
        key, noise, point, x_next, observation, inputs, is_observed = given
        if conditional:
            parent, impossible = kernel.redraw.parent(point, log_weights, particles, x_next, inputs)
            ancestors = kernel.scheme(key, log_weights, parent)
        else:
            ancestors, impossible = systematic_at(point, log_weights), jnp.zeros((), bool)
        chosen = jax.tree.map(lambda leaf: jnp.take(leaf, ancestors, axis=-1, mode="clip"), particles)
        moved = _with_first(move(noise, chosen, inputs), x_next)
        log_likelihoods = likelihoods(moved, _without_nan(observation, is_observed), inputs)
        log_factor, num_invalid = _usable(log_likelihoods, is_observed)
        after, _ = weights.normalize(log_factor)
        impossible = impossible | ~jnp.any(log_factor > -jnp.inf)
        return (moved, after), (History(moved, after, ancestors), num_invalid, impossible)

    return frame


def _without_nan(observation: PyTree, is_observed: Array | None) -> PyTree:
    """A frame without an observation often holds NaN, which would count as invalid."""
    if is_observed is None:
        return observation
    return jax.tree.map(lambda y: jnp.where(is_observed, y, jnp.zeros_like(y)), observation)


def _usable(log_likelihoods: Array, is_observed: Array | None) -> tuple[Array, Array]:
    if is_observed is not None:
        log_likelihoods = jnp.where(is_observed, log_likelihoods, 0.0)
    invalid = jnp.isnan(log_likelihoods) | jnp.isposinf(log_likelihoods)
    return jnp.where(invalid, -jnp.inf, log_likelihoods), jnp.sum(invalid, dtype=jnp.int32)


def _with_first(particles: PyTree, x: PyTree) -> PyTree:
    """The ensemble with `x` at index 0; unchanged where `x` is `None`."""
    if x is None:
        return particles
    return jax.tree.map(lambda leaf, value: leaf.at[..., 0].set(value), particles, x)


def _rows_that_differ(before: PyTree, after: PyTree) -> Bool[Array, " t"]:
    def rows(a: Array, b: Array) -> Array:
        return jnp.any((a != b).reshape(a.shape[0], -1), axis=1)

    return jax.tree.reduce(jnp.logical_or, jax.tree.map(rows, before, after))
