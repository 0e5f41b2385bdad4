r"""Types of the functions that a user passes to the builders of filters, with their mathematics.

All of them are *unbatched*: their arguments are one particle, one hypothesis, one state. The filters map them over the
ensemble, whose axis is the last one. A callback is a plain function, a method of a frozen pytree dataclass (its
arrays then become parameters of the filter, traced and differentiable) or any other callable pytree such as
`jax.tree_util.Partial`.

**Inputs.** What is known of a step beside its observation (the time since the last step, a command to a motor, the
place of a moving observer) are its *inputs*: one pytree for the transition to the step and for its observation, `None`
by default. `jf.run` takes the inputs of all steps, time first. Every callback may ask for them, by one more argument
at the end:

| callback | without inputs | with inputs |
|---|---|---|
| `transition`, `observe`, `dynamics` | `(x)` | `(x, inputs)` |
| `sample_transition` | `(randomness, x)` | `(randomness, x, inputs)` |
| `log_likelihood` | `(x, y)` | `(x, y, inputs)` |
| `log_transition` | `(x_next, x)` | `(x_next, x, inputs)` |
| `log_first_stage` | `(x, y)` | `(x, y, inputs)` |
| `sample`, `log_density` of a proposal | `(randomness, x, y)`, `(x_next, x, y)` | `(..., inputs)` |
| `process_noise`, `observation_noise` | an array | `(inputs)`, or `(x, inputs)` where the noise depends on the state |

Its signature decides, once, when the filter is built. The argument may have any name if it has no default value, and
must be called `inputs` if it has one: `observe(x, scale=2.0)` raises a `TypeError`, because it is ambiguous whether
`scale` receives the inputs.

One letter means one thing in the whole package:

| letter | meaning | letter | meaning |
|---|---|---|---|
| `x` | state, or its nonlinear part | `y` | observation |
| `m, P` | mean and covariance | `F, Q` | transition matrix and process noise covariance |
| `H, R` | observation matrix and noise covariance | `S, K` | innovation covariance and Kalman gain |
| `A_n, A_l` | how the linear state drives `x`, and itself | `C` | observation matrix of the linear state |
"""

import inspect
from collections.abc import Callable
from types import MethodType
from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree, UInt32

from jaxfilters._struct import pytree_dataclass

AnyKey = PRNGKeyArray | Key[Array, ""] | UInt32[Array, " 2"]
"""A JAX random key, new style (`jax.random.key`) or old (`jax.random.PRNGKey`)."""


@runtime_checkable
class SamplePrior(Protocol):
    r"""Draw $x_0 \sim p(x_0)$, the belief before the first observation."""

    def __call__(self, key: AnyKey, /) -> PyTree: ...


@runtime_checkable
class SampleTransition(Protocol):
    r"""Draw $x_t \sim p(x_t \mid x_{t-1}, u_t)$ from `randomness`.

    Called as `(randomness, x)` or `(randomness, x, inputs)`; `randomness` is what the `noise` argument of the filter
    draws for one particle: by default a random key.
    """

    def __call__(self, *arguments: Any, **options: Any) -> PyTree: ...


@runtime_checkable
class LogLikelihood(Protocol):
    r"""Evaluate $\log p(y_t \mid x_t, u_t)$, called as `(x, y)` or `(x, y, inputs)`; `-inf` means impossible."""

    def __call__(self, *arguments: Any, **options: Any) -> Float[Array, ""]: ...


@runtime_checkable
class DrawNoise(Protocol):
    """Draw the random inputs of one transition for a whole ensemble: leaves with the ensemble axis last."""

    def __call__(self, key: AnyKey, num_particles: int, /) -> PyTree: ...


@runtime_checkable
class ResamplingScheme(Protocol):
    """Draw n ancestor indices, so that index `i` appears `n w_i` times on average, with normalised weights `w`."""

    def __call__(self, key: AnyKey, log_weights: Float[Array, " n"], /) -> Array: ...


@runtime_checkable
class Temper(Protocol):
    """Flatten the log-likelihoods of an update, given the log weights before it."""

    def __call__(
        self, log_likelihood: Float[Array, " n"], log_weights: Float[Array, " n"], /
    ) -> Float[Array, " n"]: ...


Init = Callable[[PyTree, AnyKey], PyTree]
Predict = Callable[[PyTree, AnyKey, PyTree, PyTree], PyTree]
Update = Callable[[PyTree, AnyKey, PyTree, PyTree, PyTree], tuple[PyTree, PyTree]]
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

    Examples:
        >>> import jaxfilters as jf
        >>> jf.typing.as_pytree(lambda x: 2 * x)(3)
        6
    """
    if isinstance(callback, MethodType) and not jax.tree_util.all_leaves([callback.__self__]):
        return jax.tree_util.Partial(callback.__func__, callback.__self__)
    if jax.tree_util.all_leaves([callback]):
        return jax.tree_util.Partial(callback)
    return callback


@pytree_dataclass
class WithoutInputs:
    """A callback that asks for no inputs, as a function that takes them last and drops them."""

    callback: Callable

    def __call__(self, *arguments: Any) -> Any:
        return self.callback(*arguments[:-1])


def asks_for_inputs(name: str, callback: Callable, *arguments: str) -> bool:
    """Whether a callback takes the inputs of a step after its other arguments, by its signature.

    Args:
        name: Name of the callback, for the error.
        callback: The function.
        arguments: Names of the other arguments, for the error.

    Raises:
        TypeError: If the callback is no function of these arguments, with or without inputs; or if its signature
            leaves that open.

    Examples:
        >>> import jaxfilters as jf
        >>> asks = jf.typing.asks_for_inputs
        >>> asks("observe", lambda x, u: x + u, "x"), asks("observe", lambda x: x, "x")
        (True, False)
    """
    return not isinstance(callback, WithoutInputs) and _longer_form(name, callback, arguments, (*arguments, "inputs"))


def depends_on_state(name: str, callback: Callable) -> bool:
    """Whether a function that gives a noise takes `(x, inputs)`, by its signature, and not only `(inputs)`.

    Args:
        name: Name of the function, for the error.
        callback: The function.

    Raises:
        TypeError: If the function has another form, or if its signature leaves that open.

    Examples:
        >>> import jaxfilters as jf
        >>> depends = jf.typing.depends_on_state
        >>> depends("process_noise", lambda x, dt: x * dt), depends("process_noise", lambda dt: dt)
        (True, False)
    """
    return _longer_form(name, callback, ("inputs",), ("x", "inputs"))


def taking_inputs(name: str, callback: Callable, *arguments: str) -> Callable:
    """A callback as a pytree that takes the inputs of the step last, whether it asks for them or not.

    Args:
        name: Name of the callback, for the error.
        callback: Function of the arguments, with or without inputs after them.
        arguments: Names of the other arguments, for the error.

    Returns:
        A callable pytree.

    Raises:
        TypeError: If the callback is no such function.

    Examples:
        >>> import jaxfilters as jf
        >>> jf.typing.taking_inputs("observe", lambda x: 2 * x, "x")(3, None)
        6
    """
    if isinstance(callback, WithoutInputs) or asks_for_inputs(name, callback, *arguments):
        return as_pytree(callback)
    return WithoutInputs(as_pytree(callback))


def only_inputs(name: str, callback: Callable) -> Callable:
    """A function `(inputs)` as a pytree.

    Args:
        name: Name of the function, for the error.
        callback: The function.

    Raises:
        TypeError: If the function has another form.

    Examples:
        >>> import jaxfilters as jf
        >>> jf.typing.only_inputs("process_noise", lambda dt: 2 * dt)(3)
        6
    """
    _longer_form(name, callback, ("inputs",))
    return as_pytree(callback)


def _longer_form(name: str, callback: Callable, shorter: tuple[str, ...], longer: tuple[str, ...] = ()) -> bool:
    """Whether the signature of a function has the longer list of arguments, one more than the shorter one, if any."""
    expected = f"{name} must take " + " or ".join(f"({', '.join(form)})" for form in (shorter, longer) if form)
    try:
        signature = inspect.signature(callback)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{expected}; Python knows no signature of {callback!r}: wrap it in a function.") from error
    parameters = list(signature.parameters.values())
    if any(one.kind is one.VAR_POSITIONAL for one in parameters):
        raise TypeError(
            f"{expected}; got {signature}, which does not say which: name the arguments, or use functools.wraps."
        )
    if any(one.kind is one.KEYWORD_ONLY and one.default is one.empty for one in parameters):
        raise TypeError(f"{expected}; got {signature}: arguments are passed by position.")
    places = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
    required = sum(one.default is one.empty for one in places)
    if len(places) < len(shorter) or required > max(len(shorter), len(longer)):
        raise TypeError(f"{expected}; got {signature}.")
    if len(places) == len(shorter) or not longer:
        return False
    last = places[len(shorter)]
    if last.default is last.empty or last.name == "inputs":
        return True
    raise TypeError(
        f"{expected}; got {signature}, where {last.name!r} has a default value: call it 'inputs', or give it no "
        "default, if it receives the inputs; make it keyword-only if it does not."
    )
