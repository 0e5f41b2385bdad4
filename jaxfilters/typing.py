r"""Types of the functions that a user passes to the builders of filters, with their mathematics.

All of them are *unbatched*: their arguments are one particle, one hypothesis, one state. The filters map them over the
ensemble, whose axis is the last one. A callback is a plain function, a method of a frozen pytree dataclass (its
arrays then become parameters of the filter, traced and differentiable) or any other callable pytree such as
`jax.tree_util.Partial`.

One letter means one thing in the whole package:

| letter | meaning | letter | meaning |
|---|---|---|---|
| `x` | state, or its nonlinear part | `y` | observation |
| `m, P` | mean and covariance | `F, Q` | transition matrix and process noise covariance |
| `H, R` | observation matrix and noise covariance | `S, K` | innovation covariance and Kalman gain |
| `A_n, A_l` | how the linear state drives `x`, and itself | `C` | observation matrix of the linear state |
"""

from collections.abc import Callable
from types import MethodType
from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree, UInt32

AnyKey = PRNGKeyArray | Key[Array, ""] | UInt32[Array, " 2"]
"""A JAX random key, new style (`jax.random.key`) or old (`jax.random.PRNGKey`)."""


@runtime_checkable
class SamplePrior(Protocol):
    r"""Draw $x_0 \sim p(x_0)$, the belief before the first observation."""

    def __call__(self, key: AnyKey, /) -> PyTree: ...


@runtime_checkable
class SampleTransition(Protocol):
    r"""Draw $x_t \sim p(x_t \mid x_{t-1}, u_t)$ from `randomness`.

    `randomness` is what the filter's `noise` argument draws for one particle: by default a random key. `control`
    carries the known inputs of the step, the time since the last one among them.
    """

    def __call__(self, randomness: Any, x: PyTree, control: PyTree, /) -> PyTree: ...


@runtime_checkable
class LogLikelihood(Protocol):
    r"""Evaluate $\log p(y_t \mid x_t)$; `-inf` means impossible."""

    def __call__(self, x: PyTree, y: PyTree, /) -> Float[Array, ""]: ...


@runtime_checkable
class DrawNoise(Protocol):
    """Draw the random inputs of one transition for a whole ensemble: leaves with the ensemble axis last."""

    def __call__(self, key: AnyKey, num_particles: int, /) -> PyTree: ...


@runtime_checkable
class ResamplingScheme(Protocol):
    """Draw sorted ancestor indices, so that index `i` appears `N w_i` times on average."""

    def __call__(self, key: AnyKey, log_weights: Float[Array, " n"], /) -> Array: ...


@runtime_checkable
class Temper(Protocol):
    """Flatten the log-likelihoods of an update, given the log weights before it."""

    def __call__(
        self, log_likelihood: Float[Array, " n"], log_weights: Float[Array, " n"], /
    ) -> Float[Array, " n"]: ...


Init = Callable[[PyTree, AnyKey], PyTree]
Predict = Callable[[PyTree, AnyKey, PyTree, PyTree], PyTree]
Update = Callable[[PyTree, AnyKey, PyTree, PyTree], tuple[PyTree, PyTree]]
Collect = Callable[[PyTree, PyTree], PyTree]
Mask = Bool[Array, " t"]


def as_pytree(callback: Callable) -> Callable:
    """Turn a callback into a pytree whose leaves are its parameters.

    A method of a pytree dataclass becomes a `Partial` of the function over the instance: its arrays are traced, and
    two filters built from the same class compile once. A plain function has no leaves and is compared by identity, so
    a function that is created anew for every call compiles anew.

    Args:
        callback: Function, method of a pytree, or callable pytree.

    Returns:
        A callable pytree.
    """
    if isinstance(callback, MethodType) and not jax.tree_util.all_leaves([callback.__self__]):
        return jax.tree_util.Partial(callback.__func__, callback.__self__)
    if jax.tree_util.all_leaves([callback]):
        return jax.tree_util.Partial(callback)
    return callback
