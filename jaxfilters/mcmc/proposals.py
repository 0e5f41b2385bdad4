"""Proposals of parameters: a random walk in unconstrained coordinates that adapts in warm-up, and the user's own."""

import math
from collections.abc import Callable
from dataclasses import field
from functools import reduce
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int32, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.fit.constraints import Constraint, Fixed, Interval, Rotation, free
from jaxfilters.fit.parametrization import Parametrization, leaf_names, parametrize
from jaxfilters.mcmc import checks
from jaxfilters.particle.checks import check_callables, check_scalar, like
from jaxfilters.typing import AnyKey, as_pytree

OPTIMAL_SCALE = 2.38
"""Standard deviations of a random walk, times the root of the dimension, relative to those of a Gaussian target
(A. Gelman, G. Roberts and W. Gilks, "Efficient Metropolis jumping rules", Bayesian Statistics 5, 1996)."""
_DECAY, _DELAY = 0.6, 8.0
"""The n-th step of adaptation has the weight (n + delay)^-decay."""
_FLOOR = 1e-6
"""Share of the initial variance that stays in the adapted covariance."""


@runtime_checkable
class Proposal(Protocol):
    """How a Metropolis-Hastings sampler proposes parameters; its state may adapt in warm-up."""

    def init(self, theta: PyTree, /) -> tuple[PyTree, Bool[Array, ""]]:
        """The state at the start of a chain, and whether `theta` is admissible."""
        ...

    def propose(self, key: AnyKey, state: PyTree, theta: PyTree, /) -> tuple[PyTree, Float[Array, ""]]:
        """Proposed parameters, and log q(theta | proposed) - log q(proposed | theta)."""
        ...

    def adapt(self, state: PyTree, theta: PyTree, acceptance: Float[Array, ""], /) -> PyTree:
        """The state after a step of warm-up that led to `theta`."""
        ...


class RandomWalkState(NamedTuple):
    """What a random walk has adapted to."""

    parametrization: Parametrization
    """The coordinates, about the start of the chain."""
    mean: Float[Array, " d"]
    covariance: Float[Array, "d d"]
    root: Float[Array, "d d"]
    """Cholesky factor of the covariance."""
    log_scale: Float[Array, ""]
    num_adapted: Int32[Array, ""]


@pytree_dataclass
class RandomWalk:
    """A Gaussian random walk in unconstrained coordinates; made by `random_walk`."""

    step: ArrayLike
    target_acceptance: ArrayLike
    constraints: tuple[Constraint, ...] = field(metadata={"static": True})
    structure: Any = field(metadata={"static": True})

    def init(self, theta: PyTree) -> tuple[RandomWalkState, Bool[Array, ""]]:
        """Independent steps of the given size in every coordinate."""
        parametrization = parametrize(theta, jax.tree.unflatten(self.structure, self.constraints))
        check_floating(theta, parametrization.constraints)
        z = parametrization.unconstrain(parametrization.origin)
        scale = OPTIMAL_SCALE / math.sqrt(max(z.size, 1))
        deviation = jnp.broadcast_to(jnp.asarray(self.step, z.dtype), z.shape) / scale
        state = RandomWalkState(
            parametrization,
            z,
            jnp.diag(jnp.square(deviation)),
            jnp.diag(deviation),
            jnp.full((), math.log(scale), z.dtype),
            jnp.zeros((), jnp.int32),
        )
        return state, is_admissible(parametrization)

    def propose(self, key: AnyKey, state: RandomWalkState, theta: PyTree) -> tuple[PyTree, Float[Array, ""]]:
        """One Gaussian step."""
        return step_in_chart(key, state.parametrization, jnp.exp(state.log_scale) * state.root, theta)

    def adapt(self, state: RandomWalkState, theta: PyTree, acceptance: Float[Array, ""]) -> RandomWalkState:
        """Robbins-Monro steps of the mean, the covariance and the scale."""
        z = state.parametrization.unconstrain(theta)
        weight = (state.num_adapted + _DELAY) ** -_DECAY
        apart = z - state.mean
        covariance = (1 - weight) * (state.covariance + weight * jnp.outer(apart, apart))
        floor = jnp.square(jnp.asarray(self.step, z.dtype)) * _FLOOR
        root = jnp.linalg.cholesky(covariance + floor * jnp.eye(z.size, dtype=z.dtype))
        return RandomWalkState(
            state.parametrization,
            state.mean + weight * apart,
            covariance,
            jnp.where(jnp.all(jnp.isfinite(root)), root, state.root),
            state.log_scale + weight * (acceptance - self.target_acceptance),
            state.num_adapted + 1,
        )


@pytree_dataclass
class UserProposal:
    """A proposal of the user's; made by `proposal`."""

    sample: Callable[[AnyKey, PyTree], PyTree]
    log_density: Callable[[PyTree, PyTree], Array]

    def init(self, theta: PyTree) -> tuple[tuple, Bool[Array, ""]]:
        """Nothing to adapt; every parameter is admissible."""
        del theta
        return (), jnp.ones((), bool)

    def propose(self, key: AnyKey, state: tuple, theta: PyTree) -> tuple[PyTree, Float[Array, ""]]:
        """A draw, and the ratio of its densities; NaN where the proposal gives its own draw no density."""
        del state
        new = like("the result of sample", self.sample(key, theta), theta, "theta")
        there = checks.scalar("log_density of the proposal", self.log_density(new, theta))
        back = checks.scalar("log_density of the proposal", self.log_density(theta, new))
        return new, jnp.where(there > -jnp.inf, back - there, jnp.nan)

    def adapt(self, state: tuple, theta: PyTree, acceptance: Float[Array, ""]) -> tuple:
        """Nothing changes."""
        del theta, acceptance
        return state


def random_walk(
    constraints: PyTree = free, *, step: ArrayLike = 0.3, target_acceptance: ArrayLike = 0.234
) -> RandomWalk:
    """Build a Gaussian random walk in the unconstrained coordinates of `jaxfilters.fit`.

    In warm-up its covariance follows that of the chain, and its scale the acceptance rate, by stochastic approximation
    with decreasing weights (H. Haario, E. Saksman and J. Tamminen, "An adaptive Metropolis algorithm", Bernoulli 7,
    2001; C. Andrieu and J. Thoms, "A tutorial on adaptive MCMC", Statistics and Computing 18, 2008, algorithm 4). After
    warm-up it is fixed, so that the chain keeps its target. The volume that the coordinates stretch is accounted for:
    priors are densities of the parameters themselves.

    Args:
        constraints: A constraint of `jaxfilters.fit`, or a tree of them like theta, or a prefix of it.
        step: Standard deviation of the first steps in each coordinate, e.g. in the logarithm of a positive number; one
            number, or one for each coordinate.
        target_acceptance: Acceptance rate at which warm-up aims, in (0, 1): .44 suits one parameter, .234 many
            (G. Roberts, A. Gelman and W. Gilks, Annals of Applied Probability 7, 1997), .1 a noisy likelihood.

    Returns:
        A proposal for `pmmh` and `metropolis_update`.

    Raises:
        ValueError: If `step` is not positive, `target_acceptance` is not in (0, 1), or `constraints` holds something
            else.

    Examples:
        >>> import jaxfilters as jf
        >>> proposal = jf.mcmc.random_walk({"noise": jf.fit.positive, "bias": jf.fit.free}, step=0.1)
    """
    leaves, structure = jax.tree.flatten(constraints, is_leaf=lambda node: isinstance(node, Constraint))
    for leaf in leaves:
        if not isinstance(leaf, Constraint):
            raise ValueError(f"constraints must hold constraints such as fit.positive; got {leaf!r}.")
    checks.check_where_concrete(step, lambda step: step > 0, "step must be positive; got {}.")
    check_scalar("target_acceptance", target_acceptance, "in (0, 1)", lambda share: 0 < share < 1)
    return RandomWalk(step, target_acceptance, tuple(leaves), structure)


def proposal(
    sample: Callable[[AnyKey, PyTree], PyTree], log_density: Callable[[PyTree, PyTree], Array]
) -> UserProposal:
    """Build a proposal from a sampler and its density.

    A draw to which `log_density` gives no density is rejected and reported as invalid: the two do not belong together.

    Args:
        sample: `(key, theta) -> proposed theta`.
        log_density: `(proposed, theta) -> log q(proposed | theta)`, a scalar, up to a constant.

    Returns:
        A proposal for `pmmh` and `metropolis_update`.

    Raises:
        TypeError: If an argument is not callable.

    Examples:
        >>> import jax, jaxfilters as jf
        >>> independent = jf.mcmc.proposal(
        ...     lambda key, theta: jax.random.normal(key), lambda proposed, theta: jax.scipy.stats.norm.logpdf(proposed)
        ... )
    """
    check_callables(sample=sample, log_density=log_density)
    return UserProposal(as_pytree(sample), as_pytree(log_density))


def check_floating(theta: PyTree, constraints: tuple[Constraint, ...]) -> None:
    """Reject parameters that a step in their coordinates would round.

    Raises:
        TypeError: If a leaf of `theta` is not floating-point and its constraint is not `fixed`.
    """
    for name, leaf, constraint in zip(leaf_names(theta), jax.tree.leaves(theta), constraints, strict=True):
        dtype = jnp.result_type(leaf)
        if not isinstance(constraint, Fixed) and not jnp.issubdtype(dtype, jnp.floating):
            raise TypeError(f"theta{name} must be floating-point, or fit.fixed; got {dtype}.")


def is_admissible(parametrization: Parametrization) -> Bool[Array, ""]:
    """Whether the origin satisfies its constraints: it is the value of its own coordinates, which are finite."""
    z = parametrization.unconstrain(parametrization.origin)
    again = parametrization.constrain(z)

    def close(constraint: Constraint, new: Array, old: Array) -> Array:
        # Finite logits are within the interval, and leave no relative precision near zero.
        if isinstance(constraint, Interval) or not jnp.issubdtype(jnp.result_type(old), jnp.inexact):
            return jnp.ones((), bool)
        tolerance = 1e-3 * (jnp.max(jnp.abs(old), initial=0.0) + jnp.finfo(old.dtype).tiny)
        return jnp.all(jnp.abs(new - old) <= tolerance)

    # A value on an open bound has the coordinate -inf or inf, and is its value, too.
    finite = jnp.all(jnp.isfinite(z))
    triples = zip(parametrization.constraints, jax.tree.leaves(again), parametrization.leaves, strict=True)
    return reduce(jnp.logical_and, (close(*triple) for triple in triples), finite)


def step_in_chart(
    key: AnyKey, parametrization: Parametrization, root: Float[Array, "d d"], theta: PyTree
) -> tuple[PyTree, Float[Array, ""]]:
    """A Gaussian step in unconstrained coordinates, and the change of the log volume that they stretch.

    The coordinates are about the origin of `parametrization`, except that fixed values are those of `theta`, and that
    rotations are turned from `theta`: such a step is as likely as the one back, over all turns that lead to the same
    rotation, so that its volume does not count.
    """
    leaves, structure = jax.tree.flatten(theta)
    triples = zip(parametrization.constraints, leaves, parametrization.leaves, strict=True)
    origin = [leaf if isinstance(constraint, Fixed | Rotation) else about for constraint, leaf, about in triples]
    chart = Parametrization(jax.tree.unflatten(structure, origin), parametrization.constraints)
    z = chart.unconstrain(theta)
    new = z + jnp.matmul(root, jax.random.normal(key, z.shape, z.dtype), precision="highest")
    proposed = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), chart.constrain(new), theta)
    return proposed, chart.log_volume(new, without=Rotation) - chart.log_volume(z, without=Rotation)
