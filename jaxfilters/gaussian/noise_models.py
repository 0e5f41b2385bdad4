r"""Noise of Gaussian filters: constant, a function of the inputs, a function of the state, or not additive.

A noise that depends on the state enters a Gaussian filter by its expected covariance, $E[R(x)]$ over the belief: with
the mean of a linearisation that is the covariance of the noise in $\operatorname{Cov}[y] = \operatorname{Cov}[h(x)] +
E[R(x)]$. Noise that is not additive, $x' = f(x, q)$, is a part of the argument of the linearised function, whose
belief is $N(m, P) \times N(0, Q)$ (S. Särkkä and L. Svensson, "Bayesian Filtering and Smoothing", 2nd edition, 2023,
sections 7.2 and 8.8).
"""

from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.emissions import Emission
from jaxfilters.gaussian.linearize import Linearization, Linearize, lower_root, taylor
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.math import linalg
from jaxfilters.typing import as_pytree, depends_on_state, taking_inputs


@pytree_dataclass
class NonAdditiveNoise:
    """A transition or an observation function into which the noise enters as an argument.

    Passed as `transition` or `observe` to `extended_kalman`, `unscented_kalman` or `cubature_kalman`; the argument
    `process_noise` or `observation_noise` of the same builder is then the covariance of what the function receives,
    of any size.

    Examples:
        A wheel that slips: the noise multiplies the distance driven, and turns the heading.

        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> def drive(x, noise, distance):
        ...     heading = x[2] + noise[1]
        ...     step = distance * (1.0 + noise[0])
        ...     return jnp.array([x[0] + step * jnp.cos(heading), x[1] + step * jnp.sin(heading), heading])
        >>> prior = jf.Gaussian(jnp.zeros(3), 0.01 * jnp.eye(3))
        >>> slip = jnp.diag(jnp.array([0.01, 0.001]))
        >>> filter = jf.unscented_kalman(prior, jf.NonAdditiveNoise(drive), slip, lambda x: x[:2], 0.1 * jnp.eye(2))
        >>> last, _ = jf.run(filter, jax.random.key(0), jnp.ones((5, 2)), 0.2 * jnp.ones(5))
        >>> last.mean.shape
        (3,)
    """

    function: Callable
    """`(x, noise)` or `(x, noise, inputs)` to the next state, or to the observation."""

    def at(self, inputs: PyTree, size: int, dtype: Any) -> Callable:
        """`x -> result` without noise, and `(x, noise) -> result`, for one step."""
        none = jnp.zeros(size, dtype)
        return lambda x, noise=none: self.function(x, noise, inputs)


@pytree_dataclass
class StateNoise:
    """A covariance, or a root of one, as a function `(x, inputs)` of the state."""

    function: Callable


def bound_function(name: str, function: Any) -> Any:
    """A transition or an observation function as a pytree that takes the inputs last.

    Raises:
        TypeError: If it is no such function.
    """
    if isinstance(function, NonAdditiveNoise):
        return NonAdditiveNoise(taking_inputs(f"the function of {name}", function.function, "x", "noise"))
    if isinstance(function, Emission):
        return function
    checks.function(name, function)
    return taking_inputs(name, function, "x")


def bound_noise(name: str, noise: Any, size: int | None, *, is_root: bool, function: Any) -> Any:
    """An array, a function of the inputs, or a `StateNoise`.

    Args:
        name: Name of the argument, for errors.
        noise: The array or the function.
        size: Number of rows, None where any will do.
        is_root: Whether it is a root of a covariance.
        function: The function that the noise is added to, or received by.

    Raises:
        ValueError: If an array is no covariance of this size, or a noise that is not additive depends on the state.
        TypeError: If it is neither an array nor a function of the inputs, or of the state and the inputs.
    """
    if not callable(noise):
        checks.noise(name, noise, None if isinstance(function, NonAdditiveNoise) else size, is_root=is_root)
        return noise
    if not depends_on_state(name, noise):
        return as_pytree(noise)
    if isinstance(function, NonAdditiveNoise):
        raise ValueError(
            f"{name} must be an array or a function of the inputs beside a NonAdditiveNoise, whose own function can "
            "scale its noise by the state; got a function of the state."
        )
    return StateNoise(as_pytree(noise))


def noise_of_step(
    name: str,
    noise: Any,
    inputs: PyTree,
    size: int | None,
    belief: Belief,
    point: Callable[[Array], Array],
    linearize: Linearize,
) -> Float[Array, "m _"]:
    """Covariance of the noise of one step, or a root of it, expected over the belief where it depends on the state.

    Args:
        name: Name of the argument, for errors.
        noise: What `bound_noise` returned.
        inputs: Inputs of the step.
        size: Number of rows, None where any will do.
        belief: Belief about the coordinates of the state.
        point: `coordinates -> x`.
        linearize: Strategy whose mean is the expected value; `taylor` takes the covariance at the mean.

    Raises:
        ValueError: If a function returns an array of another shape.
    """
    is_root = isinstance(belief, GaussianRoot)
    result = f"the result of {name}"
    if isinstance(noise, StateNoise):

        def given(coordinates: Array) -> Array:
            found = noise.function(point(coordinates), inputs)
            checks.noise(result, found, size, is_root=is_root)
            return found

        if linearize is taylor:
            return given(belief.mean)
        covariance = lambda coordinates: factor.outer(given(coordinates), given(coordinates))
        square = covariance if is_root else given
        rows = size or square(belief.mean).shape[0]
        expected = linearize(lambda coordinates: square(coordinates).ravel(), belief).value.reshape(rows, rows)
        return factor.root(expected) if is_root else expected
    if not callable(noise):
        return noise
    found = noise(inputs)
    checks.noise(result, found, size, is_root=is_root)
    return found


def no_noise(belief: Belief, size: int) -> Float[Array, "m _"]:
    """A covariance of zeros, or a root of it, for a belief of the same kind."""
    dtype = belief.mean.dtype
    return jnp.zeros((size, 0), dtype) if isinstance(belief, GaussianRoot) else jnp.zeros((size, size), dtype)


@pytree_dataclass
class Augmented:
    """Linearisation of `(x, noise) -> result`: the part of the noise joins the linearisation error."""

    noise: Float[Array, "q _"]
    """Covariance of the noise, or a root of it, as beliefs have it."""
    linearize: Linearize = field(metadata={"static": True})

    def __call__(self, function: Callable, belief: Belief) -> Linearization:
        n, q = belief.mean.size, self.noise.shape[0]
        mean = jnp.concatenate([belief.mean, jnp.zeros(q, belief.mean.dtype)])
        if isinstance(belief, GaussianRoot):
            joint: Belief = GaussianRoot(mean, block_diag(belief.root, self.noise))
        else:
            joint = Gaussian(mean, block_diag(belief.covariance, self.noise))
        found = self.linearize(lambda both: function(both[:n], both[n:]), joint)
        noise = self.noise if isinstance(belief, GaussianRoot) else lower_root(Gaussian(mean[n:], self.noise))
        by_noise = linalg.matmul(found.F[:, n:], noise)
        return Linearization(found.value, found.F[:, :n], jnp.hstack([found.residual_root, by_noise]))
