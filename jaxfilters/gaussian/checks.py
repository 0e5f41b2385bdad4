"""Checks of the input of the Gaussian filters.

Kinds and shapes are compared when a filter is built or traced, which costs nothing when it runs. Values are examined
where a builder receives them as concrete arrays; under `jit`, `vmap` and `grad` they are unknown, and are accepted.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot

_TOLERANCE = 1e-4
"""Asymmetry and negative eigenvalues that pass, as correlations: far above rounding in float32, far below a mistake."""
_LARGEST = 512
"""Rows of the largest matrix whose definiteness is tested: a factorisation of a larger one would be noticed."""


def concrete(value: Any) -> np.ndarray | None:
    """The values of an array, or None where they are not known or lie on other hosts."""
    if isinstance(value, jax.core.Tracer) or not getattr(value, "is_fully_addressable", True):
        return None
    return np.asarray(value)


def floating(name: str, value: Any) -> None:
    """Raise a `TypeError` unless `value` is an array of floating-point numbers."""
    if not hasattr(value, "shape") or not hasattr(value, "dtype"):
        raise TypeError(f"{name} must be an array of floating-point numbers; got a {type(value).__name__}.")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise TypeError(f"{name} must be an array of floating-point numbers; got the type {value.dtype}.")


def shaped(name: str, value: Any, shape: tuple[int, ...], why: str = "") -> None:
    """Raise an error unless `value` is a floating-point array of this shape."""
    floating(name, value)
    if value.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}{why}; got {value.shape}.")


def boolean(name: str, value: Any, shape: tuple[int, ...], why: str = "") -> None:
    """Raise an error unless `value` is a boolean array of this shape."""
    if not jnp.issubdtype(getattr(value, "dtype", float), jnp.bool_):
        raise TypeError(f"{name} must be a boolean array; got {getattr(value, 'dtype', type(value).__name__)}.")
    if value.shape != shape:
        raise ValueError(f"{name} must have the shape {shape}{why}; got {value.shape}.")


def is_filter(name: str, value: Any) -> None:
    """Raise a `TypeError` unless `value` is a `Filter`."""
    if not isinstance(value, Filter):
        raise TypeError(f"{name} must be a Filter, as the builders return; got a {type(value).__name__}.")


def function(name: str, value: Any) -> None:
    """Raise a `TypeError` unless `value` can be called."""
    if not callable(value):
        raise TypeError(f"{name} must be a function; got a {type(value).__name__}.")


def noise(name: str, value: Any, size: int | None, *, is_root: bool) -> None:
    """Raise an error unless `value` is a covariance, or a root of one, of `size` rows (None: of any number)."""
    noise_shape(name, value, size, is_root=is_root)
    known = concrete(value)
    if known is not None:
        _finite(name, known)
        if not is_root:
            _positive_semidefinite(name, known)


def noise_shape(name: str, value: Any, size: int | None, *, is_root: bool) -> None:
    """Raise an error unless `value` has the kind and the shape of a covariance, or of a root of one."""
    floating(name, value)
    shape = value.shape
    if len(shape) != 2 or (not is_root and shape[0] != shape[1]) or (size is not None and shape[0] != size):
        rows = "m" if size is None else size
        form = f"a root, ({rows}, any width)" if is_root else f"a covariance, ({rows}, {rows})"
        raise ValueError(f"{name} must be {form}; got the shape {shape}.")


def _finite(name: str, value: np.ndarray) -> None:
    if not np.all(np.isfinite(value)):
        raise ValueError(f"{name} must be finite; got {value[~np.isfinite(value)][0]} among its elements.")


def _positive_semidefinite(name: str, P: np.ndarray) -> None:
    variances = np.diagonal(P).astype(float)
    if np.any(variances < 0):
        raise ValueError(f"{name} must have no negative variance; got {variances.min():.6g} on its diagonal.")
    scale = np.sqrt(variances)
    # Rounding leaves a little beside a variance of zero.
    scale = np.where(scale == 0, _TOLERANCE * scale.max(initial=0.0), scale)
    scale = np.where(scale == 0, 1.0, scale)
    correlations = P / scale[:, None] / scale
    asymmetry = np.abs(correlations - correlations.T)
    if np.any(asymmetry > _TOLERANCE):
        i, j = np.unravel_index(np.argmax(asymmetry), P.shape)
        raise ValueError(f"{name} must be symmetric; got {P[i, j]:.6g} at ({i}, {j}) and {P[j, i]:.6g} at ({j}, {i}).")
    if len(P) <= _LARGEST:
        least = np.linalg.eigvalsh(correlations)[:1]
        if np.any(least < -_TOLERANCE * len(P)):
            raise ValueError(
                f"{name} must be positive semidefinite; the least eigenvalue of its correlations is {least[0]:.6g}."
            )


def belief(name: str, value: Any, kind: Any) -> None:
    """Raise an error unless `value` is one belief of this kind, and a possible one."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be a {kind.__name__}; got a {type(value).__name__}.")
    spread, part = _spread(value)
    floating(f"{name}.mean", value.mean)
    floating(f"{name}.{part}", spread)
    is_root = isinstance(value, GaussianRoot)
    if value.mean.ndim != 1 or spread.ndim != 2:
        raise ValueError(
            f"{name} must be one belief, with a mean of shape (n,) and a {part} of two axes; "
            f"its mean has the shape {value.mean.shape}, its {part} {spread.shape}."
        )
    noise(f"{name}.{part}", spread, None, is_root=is_root)
    mean = concrete(value.mean)
    if mean is not None:
        _finite(f"{name}.mean", mean)


def arithmetic_of(prior: Any, arithmetic: Any) -> None:
    """Raise an error unless `prior` is one possible belief, of the kind that an arithmetic takes."""
    if not isinstance(prior, arithmetic.Belief):
        kind = ValueError if isinstance(prior, Gaussian | GaussianRoot) else TypeError
        raise kind(
            f"prior must be a {arithmetic.Belief.__name__} for {arithmetic.__name__}; got a {type(prior).__name__}."
        )
    belief("prior", prior, arithmetic.Belief)


def on_manifold(name: str, value: Gaussian | GaussianRoot, manifold: Any) -> None:
    """Raise an error unless the covariance of a belief has the dimensions of the tangent space at its mean."""
    spread, part = _spread(value)
    if manifold.flat:
        if spread.shape[0] != value.mean.shape[0]:
            raise ValueError(
                f"{name}.mean and {name}.{part} must have one size; "
                f"got the shapes {value.mean.shape} and {spread.shape}."
            )
        return
    increment = jax.eval_shape(manifold.local, value.mean, value.mean)
    if increment.shape != spread.shape[:1]:
        raise ValueError(
            f"{name}.{part} must have as many rows as increments on the manifold have components, {increment.shape}; "
            f"got the shape {spread.shape} beside a mean of the shape {value.mean.shape}."
        )


def state(value: Any, prior: Gaussian | GaussianRoot) -> None:
    """Raise an error unless a filter's state, or one row of several, is of the kind and the shapes of its prior."""
    kind = type(prior).__name__
    if type(value) is not type(prior):
        raise TypeError(f"the state must be a {kind}, as the prior is; got a {type(value).__name__}.")
    got, wanted = _spread(value)[0], _spread(prior)[0]
    if value.mean.shape != prior.mean.shape or got.ndim != 2 or got.shape[0] != wanted.shape[0]:
        raise ValueError(
            f"the state must have the shapes of the prior, {prior.mean.shape} and {wanted.shape}; "
            f"got {value.mean.shape} and {got.shape}."
        )


def _spread(value: Gaussian | GaussianRoot) -> tuple[Array, str]:
    return (value.root, "root") if isinstance(value, GaussianRoot) else (value.covariance, "covariance")


def transitioned(transition: Callable, x: Array, inputs: PyTree) -> Array:
    """The state after a transition, which must have the shape that it had before."""
    return moved(transition(x, inputs), x)


def moved(after: Any, x: Array) -> Array:
    """The result of a transition, which must have the shape of the state before it."""
    shaped("the result of transition", after, x.shape, ", that of the state")
    return after


def observation(y: Any, mask: Any) -> None:
    """Raise an error unless `y` is an array of one axis, and the mask beside it has its shape."""
    if not hasattr(y, "shape") or not hasattr(y, "dtype"):
        kind = type(y).__name__
        raise TypeError(f"the observation y must be an array of shape (m,), or an Observation of one; got a {kind}.")
    if y.ndim != 1:
        raise ValueError(f"the observation y of one step must have the shape (m,); got {y.shape}.")
    if not y.size:
        raise ValueError(
            "the observation y must have one component or more (NaN or masked where it is missing); got none."
        )
    if mask is not None:
        boolean("Observation.mask", mask, y.shape, ", that of the observation y")


def predicted(y_hat: Any, y: Array, noise_name: str, noise: Any, *, is_root: bool) -> Array:
    """The result of `observe`, which must have the shape of the observation and the size of its noise."""
    floating("the result of observe", y_hat)
    if y_hat.ndim != 1:
        raise ValueError(f"observe must return an array of shape (m,), like y, {y.shape}; got the shape {y_hat.shape}.")
    if y_hat.shape != y.shape:
        raise ValueError(
            f"the observation y must have the shape of what observe returns, {y_hat.shape}; got {y.shape}."
        )
    noise_shape(noise_name, noise, y.size, is_root=is_root)
    return y_hat


def residual_of(residual: Callable) -> Callable:
    """The function `residual`, whose result must have the shape of its arguments."""

    def checked(y: Array, y_hat: Array) -> Array:
        difference = residual(y, y_hat)
        shaped("the result of residual", difference, y_hat.shape, ", that of the observation")
        return difference

    return checked


def count(name: str, value: Any) -> None:
    """Raise an error unless `value` is a Python integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be an integer of at least 1; got {value!r}.")


def probability(name: str, value: Any) -> None:
    """Raise an error unless `value` is one number in (0, 1)."""
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must be one number in (0, 1); got the shape {jnp.shape(value)}.")
    known = concrete(value)
    if known is not None and not 0 < known < 1:
        raise ValueError(f"{name} must be in (0, 1); got {value}.")


def beliefs(name: str, value: Any, prior: Gaussian | GaussianRoot) -> int:
    """The number of frames of beliefs with time first, each of the kind and the shapes of a filter's prior."""
    if type(value) is not type(prior):
        raise TypeError(
            f"{name} must be a {type(prior).__name__} with time first, as the prior of the filter is; "
            f"got a {type(value).__name__}."
        )
    (got, part), wanted = _spread(value), _spread(prior)[0]
    length = value.mean.shape[:1]
    fits = value.mean.shape == (*length, *prior.mean.shape) and got.ndim == 3 and length != (0,)
    if not fits or got.shape[:2] != (*length, wanted.shape[0]):
        raise ValueError(
            f"{name} must have time first and then the shapes of the prior, {prior.mean.shape} and {wanted.shape}; "
            f"its mean has the shape {value.mean.shape}, its {part} {got.shape}."
        )
    return length[0]
