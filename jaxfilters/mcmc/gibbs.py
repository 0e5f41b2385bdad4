"""Particle Gibbs: trajectories by conditional sequential Monte Carlo, and parameters given trajectories."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.mcmc import checks
from jaxfilters.mcmc.chains import Fault, Sampler
from jaxfilters.mcmc.conditional import ConditionalSMC, PathInfo, initial_path, update_path
from jaxfilters.particle.checks import check_callables, like
from jaxfilters.typing import AnyKey, as_pytree


class GibbsState(NamedTuple):
    """A chain of `particle_gibbs`."""

    theta: PyTree
    """Parameters."""
    path: PyTree
    """Trajectory, leaves `(t + 1, ...)`; the first row is the state before the first observation."""


@pytree_dataclass
class ParticleGibbs:
    """Parameters of `particle_gibbs`."""

    kernel_of: Callable[[PyTree], ConditionalSMC]
    update_parameters: Callable[[AnyKey, PyTree, PyTree], PyTree]
    observations: PyTree
    inputs: PyTree
    mask: PyTree


def particle_gibbs(
    kernel_of: Callable[[PyTree], ConditionalSMC],
    update_parameters: Callable[[AnyKey, PyTree, PyTree], PyTree],
    observations: PyTree,
    inputs: PyTree = None,
    *,
    mask: Bool[Array, " t"] | None = None,
) -> Sampler:
    """Build a particle Gibbs sampler of parameters and trajectories.

    A step draws a trajectory by one sweep of conditional sequential Monte Carlo at the present parameters, and then
    parameters given the trajectory. Both keep the joint posterior invariant (Andrieu, Doucet and Holenstein 2010,
    section 2.4.3; Lindsten, Jordan and Schon 2014).

    Args:
        kernel_of: `theta -> conditional_smc(...)`.
        update_parameters: `(key, theta, path) -> theta`: a draw from p(theta | path, observations), or a Markov kernel
            that keeps it invariant, such as `metropolis_update`. `path` has leaves `(t + 1, ...)`, the first row of
            which is the state before the first observation.
        observations: Pytree whose leaves have time as their first axis, (t, ...).
        inputs: Pytree of known inputs, time first, or `None`.
        mask: Booleans (t,), `False` for frames without an observation.

    Returns:
        A sampler for `init` and `sample`, whose state is a `GibbsState` and whose info is a `PathInfo`. Its warm-up
        adapts nothing.

    Raises:
        TypeError: If `kernel_of` or `update_parameters` is not callable, or `kernel_of` returns something else than a
            `ConditionalSMC`.
        ValueError: If the leaves of `observations`, `inputs` and `mask` do not share one length.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> ys, normal = jnp.array([0.2, -0.3, 0.4]), jax.scipy.stats.norm.logpdf
        >>> def kernel_of(q):
        ...     pf = jf.bootstrap(lambda key: jax.random.normal(key), lambda e, x: 0.9 * x + q * e,
        ...         lambda x, y: normal(y, x), num_particles=10, noise=jf.StandardNormal(()))
        ...     return jf.mcmc.conditional_smc(pf, jf.mcmc.ancestor_sampling(lambda z, x: normal(z, 0.9 * x, q)))
        >>> update = jf.mcmc.metropolis_update(
        ...     lambda q, path: jax.scipy.stats.expon.logpdf(q) + normal(path[1:], 0.9 * path[:-1], q).sum(),
        ...     proposal=jf.mcmc.random_walk(jf.fit.positive))
        >>> sampler = jf.mcmc.particle_gibbs(kernel_of, update, ys)
        >>> state = jf.mcmc.init(jax.random.key(0), sampler, jnp.ones(2))
        >>> state, draws = jf.mcmc.sample(jax.random.key(1), sampler, state, 20)
        >>> draws.theta.shape, state.path.shape
        ((20, 2), (4, 2))
    """
    check_callables(kernel_of=kernel_of, update_parameters=update_parameters)
    checks.shared_length(observations=observations, inputs=inputs, mask=mask)
    params = ParticleGibbs(as_pytree(kernel_of), as_pytree(update_parameters), observations, inputs, mask)
    return Sampler(params, _init, _step, _step)


def _init(model: ParticleGibbs, key: AnyKey, theta: PyTree) -> tuple[GibbsState, Array]:
    theta = jax.tree.map(jnp.asarray, theta)
    path, info = initial_path(key, _kernel_at(model, theta), model.observations, model.inputs, mask=model.mask)
    fault = jnp.where(info.num_impossible > 0, Fault.LOG_LIKELIHOOD, Fault.NONE)
    return GibbsState(theta, path), fault.astype(jnp.int32)


def _step(model: ParticleGibbs, key: AnyKey, state: GibbsState) -> tuple[GibbsState, PathInfo]:
    path_key, theta_key = jax.random.split(key)
    kernel = _kernel_at(model, state.theta)
    path, info = update_path(path_key, kernel, state.path, model.observations, model.inputs, mask=model.mask)
    theta = model.update_parameters(theta_key, state.theta, path)
    return GibbsState(like("the result of update_parameters", theta, state.theta, "theta"), path), info


def _kernel_at(model: ParticleGibbs, theta: PyTree) -> ConditionalSMC:
    kernel = model.kernel_of(theta)
    if not isinstance(kernel, ConditionalSMC):
        raise TypeError(f"kernel_of must return what conditional_smc returns; got {type(kernel).__name__}.")
    return kernel
