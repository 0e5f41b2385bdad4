"""Markov chains: the type of all samplers of chains, and the functions that run many chains side by side."""

from collections.abc import Callable
from dataclasses import field
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.mcmc import checks
from jaxfilters.particle.checks import concrete
from jaxfilters.typing import AnyKey


@pytree_dataclass
class Sampler:
    """A Markov chain on parameters: static pure functions of one chain, and traced parameters.

    It is a pytree, like a `Filter`. `pmmh` and `particle_gibbs` return samplers.
    """

    params: PyTree
    """Arrays that the functions need: observations, the user's own model."""
    init: Callable = field(metadata={"static": True})
    """`(params, key, theta) -> (state, fault)`; `fault` is a `Fault`. A state has an attribute `theta`."""
    warm_up: Callable = field(metadata={"static": True})
    """`(params, key, state) -> (state, info)`: a step that adapts the sampler."""
    step: Callable = field(metadata={"static": True})
    """`(params, key, state) -> (state, info)`: a step that keeps the target."""


class Fault:
    """Why a chain cannot start at its parameters; the number 0 stands for a chain that can."""

    NONE, CONSTRAINT, LOG_PRIOR, LOG_LIKELIHOOD = range(4)
    MESSAGES = (
        "",
        "satisfy the constraints of the proposal",
        "have a finite log_prior",
        "have a finite log_likelihood, neither NaN nor infinite",
    )


class Draw(NamedTuple):
    """What `sample` keeps of each step by default."""

    theta: PyTree
    """Leaves `(steps, ..., chains)`."""
    info: PyTree
    """Diagnostics of the sampler, leaves `(steps, ..., chains)`."""


def keep_theta(state: PyTree, info: PyTree) -> PyTree:
    """Collect the parameters of every step.

    Examples:
        `sample(key, sampler, state, 100, collect=keep_theta)` calls it with each state of a chain.

        >>> import jaxfilters as jf
        >>> jf.mcmc.keep_theta(jf.mcmc.GibbsState(theta=2.0, path=0.0), None)
        2.0
    """
    del info
    return state.theta


def keep_draw(state: PyTree, info: PyTree) -> Draw:
    """Collect the parameters and the diagnostics of every step.

    Examples:
        `sample(key, sampler, state, 100)` calls it with each state of a chain.

        >>> import jaxfilters as jf
        >>> jf.mcmc.keep_draw(jf.mcmc.GibbsState(theta=2.0, path=0.0), None)
        Draw(theta=2.0, info=None)
    """
    return Draw(state.theta, info)


def init(key: AnyKey, sampler: Sampler, theta: PyTree) -> PyTree:
    """State of many chains at their first parameters.

    Args:
        key: Random key.
        sampler: What `pmmh` or `particle_gibbs` returns.
        theta: Parameters of each chain, leaves `(..., chains)`, e.g. `jax.vmap(sample_prior, out_axes=-1)(keys)`.

    Returns:
        The state, whose leaves have the chains as their last axis.

    Raises:
        ValueError: If the leaves of `theta` do not share their last axis; or, where its values are known, if a chain
            violates the constraints of the proposal or starts where the posterior has no density. Under `jit` and
            `vmap` such a chain has NaN or `-inf` as its log density and accepts whatever has any.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> sampler = jf.mcmc.pmmh(lambda key, theta: -0.5 * (theta - 1.0) ** 2, lambda theta: -0.5 * theta**2)
        >>> state = jf.mcmc.init(jax.random.key(0), sampler, jnp.array([2.0, 3.0]))
        >>> state.theta.tolist(), state.point.log_likelihood.tolist()
        ([2.0, 3.0], [-0.5, -2.0])
    """
    count = checks.num_chains(theta)
    state, fault = _init(key, sampler, theta)
    faults = concrete(fault)
    if faults is not None and np.any(faults):
        number = int(np.max(faults))
        where = np.flatnonzero(faults == number).tolist()
        raise ValueError(f"theta must {Fault.MESSAGES[number]}; it does not in the chains {where} of {count}.")
    return state


def warm_up(key: AnyKey, sampler: Sampler, state: PyTree, num_steps: int) -> tuple[PyTree, PyTree]:
    """Run chains while their sampler adapts; what they visit is not distributed as the target.

    Args:
        key: Random key.
        sampler: The sampler.
        state: What `init`, `warm_up` or `sample` returned.
        num_steps: Number of steps.

    Returns:
        The state, and the diagnostics of every step, leaves `(num_steps, ..., chains)`.

    Raises:
        ValueError: If `num_steps` is not an integer of at least 1.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> sampler = jf.mcmc.pmmh(lambda key, theta: -0.5 * (theta - 1.0) ** 2, lambda theta: -0.5 * theta**2)
        >>> state = jf.mcmc.init(jax.random.key(0), sampler, jnp.zeros(2))
        >>> state, info = jf.mcmc.warm_up(jax.random.key(1), sampler, state, 50)
        >>> state.theta.shape, info.accepted.shape
        ((2,), (50, 2))
    """
    checks.check_count("num_steps", num_steps)
    return _run(key, sampler, state, num_steps, 1, sampler.warm_up, _keep_info)


def sample(
    key: AnyKey,
    sampler: Sampler,
    state: PyTree,
    num_samples: int,
    *,
    thin: int = 1,
    collect: Callable[[PyTree, PyTree], PyTree] = keep_draw,
) -> tuple[PyTree, PyTree]:
    """Run chains by one compiled scan, every step of which advances all chains.

    A later call continues from the returned state: chains in pieces, a saved state, more samples where too few.

    Args:
        key: Random key.
        sampler: The sampler.
        state: What `init`, `warm_up` or `sample` returned.
        num_samples: Number of steps to keep.
        thin: Number of steps for each that is kept.
        collect: `(state, info) -> pytree` of one chain to keep. It is compared by identity: pass a module-level
            function, or each call compiles anew.

    Returns:
        The last state, and what `collect` gave, leaves `(num_samples, ..., chains)`: by default a `Draw`.

    Raises:
        ValueError: If `num_samples` or `thin` is not an integer of at least 1.

    Examples:
        >>> import jax, jax.numpy as jnp, jaxfilters as jf
        >>> normal = jax.scipy.stats.norm.logpdf
        >>> sampler = jf.mcmc.pmmh(lambda key, theta: normal(1.0, theta, 0.5), normal)
        >>> state = jf.mcmc.init(jax.random.key(0), sampler, jnp.zeros(4))
        >>> state, _ = jf.mcmc.warm_up(jax.random.key(1), sampler, state, 200)
        >>> state, draws = jf.mcmc.sample(jax.random.key(2), sampler, state, 500)
        >>> draws.theta.shape, bool(abs(draws.theta.mean() - 0.8) < 0.1)
        ((500, 4), True)
    """
    checks.check_count("num_samples", num_samples)
    checks.check_count("thin", thin)
    return _run(key, sampler, state, num_samples, thin, sampler.step, collect)


@jax.jit
def _init(key: AnyKey, sampler: Sampler, theta: PyTree) -> tuple[PyTree, PyTree]:
    keys = jax.random.split(key, checks.num_chains(theta))
    start = jax.vmap(partial(sampler.init, sampler.params), in_axes=(0, -1), out_axes=-1)
    state, fault = start(keys, theta)
    # Weakly typed leaves would change type in the first step and compile it twice.
    return jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), state), fault


@partial(jax.jit, static_argnames=("num_steps", "thin", "advance", "collect"))
def _run(
    key: AnyKey, sampler: Sampler, state: PyTree, num_steps: int, thin: int, advance: Callable, collect: Callable
) -> tuple[PyTree, PyTree]:
    count = checks.num_chains(state.theta)
    one = jax.vmap(partial(advance, sampler.params), in_axes=(0, -1), out_axes=-1)

    def step(state: PyTree, step_key: AnyKey) -> tuple[PyTree, PyTree]:
        return one(jax.random.split(step_key, count), state)

    def kept(state: PyTree, kept_key: AnyKey) -> tuple[PyTree, PyTree]:
        keys = jax.random.split(kept_key, thin)
        if thin > 1:
            state, _ = jax.lax.scan(lambda state, step_key: (step(state, step_key)[0], None), state, keys[:-1])
        state, info = step(state, keys[-1])
        return state, jax.vmap(collect, in_axes=-1, out_axes=-1)(state, info)

    return jax.lax.scan(kept, state, jax.random.split(key, num_steps))


def _keep_info(state: PyTree, info: PyTree) -> PyTree:
    del state
    return info
