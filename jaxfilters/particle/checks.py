"""Checks of what users pass to filters made of samples: shapes and types when traced, values where they are concrete.

Every check raises a `ValueError` (a `TypeError` for a wrong kind of object) whose message names the argument, what was
expected and what came. Shapes and types are known while JAX traces a function, so that the checks cost nothing at run
time. Values are checked only where they are concrete: a parameter that is being differentiated or fitted is a traced
array without a value.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxfilters.particle.guidance import Guidance, GuidanceMixture

_SYMMETRY_TOLERANCE = 1e-4
_EIGENVALUE_TOLERANCE = 1e-5
"""As shares of the largest element; float32 rounding of products of a few hundred terms stays below both."""


def concrete(value: Any) -> np.ndarray | None:
    """The value of a number or an array as a NumPy array, or `None` where JAX is tracing it."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value)):
        return None
    return np.asarray(value)


def check_callables(**arguments: Any) -> None:
    """Require every argument to be callable, or absent (`None`)."""
    for name, value in arguments.items():
        if value is not None and not callable(value):
            raise TypeError(f"{name} must be callable; got {value!r}.")


def check_num_particles(num_particles: Any, at_least: int = 1, name: str = "num_particles") -> None:
    """Require a Python integer, not a boolean, of at least `at_least`."""
    if isinstance(num_particles, bool) or not isinstance(num_particles, int) or num_particles < at_least:
        raise ValueError(f"{name} must be an integer of at least {at_least}; got {num_particles!r}.")


def check_scalar(name: str, value: Any, condition: str, holds: Callable[[np.ndarray], Any]) -> None:
    """Require one real number that is not NaN and, where it is concrete, meets a condition.

    Args:
        name: Name of the argument.
        value: The number, maybe traced.
        condition: The condition in words, e.g. "at least 1".
        holds: The condition as a function of the number.
    """
    is_number = isinstance(value, int | float | np.number | np.ndarray | jax.Array) and not isinstance(value, bool)
    if not is_number or not (jnp.issubdtype(jnp.result_type(value), jnp.floating) or _is_integer(value)):
        raise TypeError(f"{name} must be a number, {condition}; got {value!r}.")
    if jnp.shape(value) != ():
        raise ValueError(f"{name} must be a single number, {condition}; got an array of shape {jnp.shape(value)}.")
    number = concrete(value)
    if number is not None and not holds(number):
        raise ValueError(f"{name} must be {condition}; got {number}.")


def check_values(name: str, values: Any, condition: str, holds: Callable[[np.ndarray], Any]) -> None:
    """Require that a condition, described in words, holds for all numbers of an array where it is concrete."""
    numbers = concrete(values)
    if numbers is not None and not np.all(holds(numbers)):
        raise ValueError(f"{name} must be {condition}; got {numbers.tolist()}.")


def _is_integer(value: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(value), jnp.integer)


def check_ensemble(num_particles: Any, ess_threshold: Any, scheme: Any, temper: Any) -> None:
    """Check what builders of particle filters have in common.

    Args:
        num_particles: A Python integer of at least 1.
        ess_threshold: A number of at least 0.
        scheme: A resampling scheme: a function, or an object with a method `resample`.
        temper: A function, or `None`; of an `AdaptiveTempering` the concrete `ess_fraction` must be in (0, 1].
    """
    check_num_particles(num_particles)
    check_scalar("ess_threshold", ess_threshold, "a fraction of num_particles, at least 0", lambda value: value >= 0)
    if not callable(scheme) and not callable(getattr(scheme, "resample", None)):
        raise TypeError(f"scheme must be a function of jaxfilters.resampling or similar; got {scheme!r}.")
    check_callables(temper=temper)
    if hasattr(temper, "ess_fraction"):
        check_scalar("ess_fraction of temper", temper.ess_fraction, "in (0, 1]", lambda value: 0 < value <= 1)


def check_shape(name: str, value: Any, expected: tuple[int, ...], reason: str = "") -> None:
    """Require an array of exactly this shape."""
    if jnp.shape(value) != expected:
        explained = f" ({reason})" if reason else ""
        raise ValueError(f"{name} must have the shape {expected}{explained}; got {jnp.shape(value)}.")


def check_floating(name: str, value: Any) -> None:
    """Require floating-point numbers."""
    if not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        raise TypeError(f"{name} must hold floating-point numbers; got {jnp.result_type(value)}.")


def check_covariance(name: str, value: Any, size: int | None = None, kind: str = "a covariance") -> None:
    """Require a square matrix; where it is concrete also one that is finite, symmetric and positive semidefinite.

    Args:
        name: Name of the argument.
        value: The matrix, maybe traced.
        size: Number of its rows, if that is known.
        kind: What the matrix is, for the message.
    """
    shape = jnp.shape(value)
    if len(shape) != 2 or shape[0] != shape[1] or (size is not None and shape[0] != size):
        expected = "(n, n)" if size is None else f"({size}, {size})"
        raise ValueError(f"{name} must be {kind} of shape {expected}; got {shape}.")
    matrix = concrete(value)
    if matrix is None or matrix.size == 0:
        return
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name} must be {kind} of finite numbers; got {matrix.tolist()}.")
    largest = np.max(np.abs(matrix))
    if np.max(np.abs(matrix - matrix.T)) > _SYMMETRY_TOLERANCE * largest:
        raise ValueError(f"{name} must be {kind}, which is symmetric; got {matrix.tolist()}.")
    lowest = np.linalg.eigvalsh(matrix.astype(float))[0]
    if lowest < -_EIGENVALUE_TOLERANCE * largest:
        raise ValueError(
            f"{name} must be {kind}, which is positive semidefinite; got one with the eigenvalue {lowest:.3g}."
        )


def check_gaussian(name: str, belief: Any) -> None:
    """Require a `Gaussian` with a mean (n,) and a covariance (n, n) of floating-point numbers."""
    if not (hasattr(belief, "mean") and hasattr(belief, "covariance")):
        raise TypeError(f"{name} must be a Gaussian with mean and covariance; got {_kind(belief)}.")
    mean, covariance = jnp.shape(belief.mean), jnp.shape(belief.covariance)
    if len(mean) != 1 or covariance != mean * 2:
        raise ValueError(f"{name} must have a mean (n,) and a covariance (n, n); got {mean} and {covariance}.")
    check_floating(f"{name}.mean", belief.mean)
    check_floating(f"{name}.covariance", belief.covariance)
    check_covariance(f"{name}.covariance", belief.covariance)


def check_vectors(name: str, particles: Any) -> None:
    """Require that an ensemble holds vectors of floating-point numbers: one array (n, N)."""
    shapes = [jnp.shape(leaf)[:-1] for leaf in jax.tree.leaves(particles)]
    if not isinstance(particles, jax.Array) or len(shapes[0]) != 1:
        raise ValueError(f"{name} must return one vector of shape (n,); got {_described(particles, shapes)}.")
    check_floating(f"the result of {name}", particles)


def _described(tree: PyTree, shapes: list) -> str:
    if isinstance(tree, jax.Array):
        return f"the shape {shapes[0]}"
    return f"{_kind(tree)} with leaves of shape {', '.join(map(str, shapes))}"


def _kind(value: Any) -> str:
    """The kind of an object, for messages: JAX's own classes of arrays have no names that a user knows."""
    return f"an array of shape {value.shape}" if isinstance(value, jax.Array) else f"a {type(value).__name__}"


def ensemble_size(particles: PyTree) -> int:
    """Number of particles of an ensemble, which is the last axis of every leaf."""
    return jax.tree.leaves(particles)[0].shape[-1]


def checked_noise(noise: PyTree, particles: PyTree) -> PyTree:
    """The noise of an ensemble, each leaf of which must have the ensemble axis of `particles` last."""
    count = ensemble_size(particles)
    for leaf in jax.tree.leaves(noise):
        if jnp.shape(leaf)[-1:] != (count,):
            raise ValueError(f"noise must draw leaves of shape (..., {count}); got {jnp.shape(leaf)}.")
    return noise


def like(name: str, value: PyTree, reference: PyTree, reference_name: str, hint: str = "") -> PyTree:
    """The value, which must be a pytree with the structure, shapes and types of `reference`."""
    structures: tuple[Any, Any] = (jax.tree.structure(value), jax.tree.structure(reference))
    if structures[0] != structures[1]:
        raise ValueError(f"{name} must have the structure of {reference_name}, {structures[1]}; got {structures[0]}.")
    pairs = zip(jax.tree_util.tree_leaves_with_path(value), jax.tree.leaves(reference), strict=True)
    for (path, new), old in pairs:
        if (jnp.shape(new), jnp.result_type(new)) != (jnp.shape(old), jnp.result_type(old)):
            raise ValueError(
                f"{name}{jax.tree_util.keystr(path)} must have the shape and type of {reference_name}, "
                f"{jnp.shape(old)} {jnp.result_type(old)}; got {jnp.shape(new)} {jnp.result_type(new)}{hint}."
            )
    return value


def checked_transition(sample_transition: Callable) -> Callable:
    """The transition of one particle, which must return a state like the one that it is given."""

    def transition(randomness: Any, x: PyTree, inputs: PyTree) -> PyTree:
        shapes = [leaf.shape for leaf in jax.tree.leaves(randomness) if hasattr(leaf, "shape")]
        hint = f" (x is what sample_prior draws; randomness has the shape {', '.join(map(str, shapes))})"
        return like("the result of sample_transition", sample_transition(randomness, x, inputs), x, "x", hint)

    return transition


def checked_log_likelihood(log_likelihood: Callable) -> Callable:
    """The log-likelihood of one particle, which must be one real number."""

    def scalar(x: PyTree, y: PyTree, inputs: PyTree) -> Array:
        return scalar_log_density("log_likelihood", log_likelihood(x, y, inputs))

    return scalar


def scalar_log_density(name: str, value: Any) -> Any:
    """The result of a callback, which must be one real number."""
    leaves = jax.tree.leaves(value)
    if len(leaves) != 1 or leaves[0] is not value or jnp.issubdtype(jnp.result_type(value), jnp.complexfloating):
        raise TypeError(f"{name} must return one real number; got {value!r}.")
    if jnp.shape(value) != ():
        raise ValueError(
            f"{name} must return a scalar, of shape (), for one particle; got the shape {jnp.shape(value)}."
        )
    return value


def log_likelihoods_of_ensemble(value: Any, count: int) -> Any:
    """Log-likelihoods of all particles at once, which must be one array (n,)."""
    if not isinstance(value, jax.Array) or jnp.shape(value) != (count,):
        raise ValueError(
            f"log_likelihood must return one number for each particle, of shape ({count},); got {_kind(value)}."
        )
    return value


def check_log_weights(log_weights: Any) -> None:
    """Require a vector of floating-point numbers, none of them NaN where they are concrete."""
    if jnp.ndim(log_weights) != 1:
        raise ValueError(f"log_weights must have the shape (n,); got {jnp.shape(log_weights)}.")
    check_floating("log_weights", log_weights)
    known = concrete(log_weights)
    if known is not None and np.isnan(known).any():
        raise ValueError(f"log_weights must not be NaN; {np.isnan(known).sum()} of {known.size} are.")


def check_ancestors(ancestors: Any, count: int) -> None:
    """Require the result of a resampling scheme to be n integers."""
    if jnp.shape(ancestors) != (count,) or not jnp.issubdtype(jnp.result_type(ancestors), jnp.integer):
        got = f"{jnp.shape(ancestors)} {jnp.result_type(ancestors)}"
        raise ValueError(f"scheme must return ancestor indices, integers of shape ({count},); got {got}.")


def checked_dynamics(dynamics: Callable, noise_dim: int | tuple[int, ...], linear_size: int) -> Callable:
    """The dynamics of one particle of a Rao-Blackwellized filter, whose fields must have the shapes of the model."""
    n: Any = noise_dim
    l = linear_size
    expected = {"A_n": (n, l), "Q_n": (n, n), "f_l": (l,), "A_l": (l, l), "Q_l": (l, l)}

    def checked(x: PyTree, inputs: PyTree) -> Any:
        step = dynamics(x, inputs)
        if not all(hasattr(step, name) for name in ("f_n", *expected)):
            raise TypeError(f"dynamics must return a MixedDynamics; got {_kind(step)}.")
        like("f_n of dynamics", step.f_n, x, "x, which sample_prior draws")
        for name, shape in expected.items():
            sizes = f"noise_dim is {n} and linear_prior has {l} components"
            check_shape(f"{name} of dynamics", getattr(step, name), shape, sizes)
        check_covariance("Q_n of dynamics", step.Q_n)
        check_covariance("Q_l of dynamics", step.Q_l)
        return step

    return checked


def check_linear_observation(linear: Any, y: Any, linear_size: int) -> None:
    """Require the fields of a `LinearObservation` and the observation itself to have matching shapes."""
    if not all(hasattr(linear, name) for name in ("h", "C", "R")):
        raise TypeError(f"observe must return a LinearObservation; got {_kind(linear)}.")
    if jnp.ndim(linear.h) != 1:
        raise ValueError(f"h of observe must have the shape (m,); got {jnp.shape(linear.h)}.")
    size = jnp.shape(linear.h)[0]
    check_shape("C of observe", linear.C, (size, linear_size), "the sizes of h and of linear_prior")
    check_covariance("R of observe", linear.R, size)
    check_shape("observation", y, (size,), "the size of h of observe")


def check_sizes(name: str, sizes: Any) -> None:
    """Require one size, or a tuple of sizes, each an integer of at least 0."""
    for size in sizes if isinstance(sizes, tuple) else (sizes,):
        if isinstance(size, bool) or not isinstance(size, int) or size < 0:
            raise ValueError(f"{name} must be an integer or a tuple of integers, at least 0; got {sizes!r}.")


def check_partitions(partitions: Any, num_coordinates: int) -> None:
    """Require boolean groups (g, d) that hold every coordinate, and a jitter of at least 0, where they are concrete."""
    check_callables(stage_weights=partitions.stage_weights)
    check_scalar("jitter of partitions", partitions.jitter, "at least 0", lambda value: value >= 0)
    groups = partitions.groups
    shape = jnp.shape(groups)
    if len(shape) != 2 or shape[0] < 1 or shape[1] != num_coordinates:
        raise ValueError(f"groups of partitions must have the shape (g, {num_coordinates}); got {shape}.")
    if not jnp.issubdtype(jnp.result_type(groups), jnp.bool_):
        raise TypeError(f"groups of partitions must be boolean; got {jnp.result_type(groups)}.")
    members = concrete(groups)
    if members is not None and not np.all(members.any(axis=0)):
        missing = np.flatnonzero(~members.any(axis=0)).tolist()
        raise ValueError(f"groups of partitions must hold every coordinate; got none that holds {missing}.")


def check_guidance(guidance: Any, x: PyTree, size: int) -> None:
    """Require points like the state of one particle, each with an information matrix of its tangent space."""
    if isinstance(guidance, GuidanceMixture):
        _check_mixture(guidance, x, size)
        return
    if not isinstance(guidance, Guidance):
        raise TypeError(f"guide must return a Guidance or a GuidanceMixture; got {_kind(guidance)}.")
    like("point of guide", guidance.point, x, "the nonlinear state of a particle")
    check_covariance("information of guide", guidance.information, size, "an information matrix")


def _check_mixture(mixture: GuidanceMixture, x: PyTree, size: int) -> None:
    heights = jnp.asarray(mixture.log_likelihoods)
    check_shape("log_likelihoods of guide", heights, (heights.size,), "one for each point")
    if heights.size == 0:
        raise ValueError("guide must return at least one point; got none.")
    check_values("log_likelihoods of guide", heights, "below infinity", lambda values: values < np.inf)
    several = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (heights.size, *jnp.shape(leaf))), x)
    expected = f"nonlinear states of {heights.size} particles, as many as there are log_likelihoods"
    like("points of guide", mixture.points, several, expected)
    matrices = (heights.size, size, size)
    check_shape("information of guide", mixture.information, matrices, "an information matrix for each point")
    information, values = concrete(mixture.information), concrete(heights)
    if information is not None and values is not None:
        for matrix in information[values > -np.inf]:
            check_covariance("information of guide", matrix, size, "an information matrix")


def check_jump(jump: Any, size: int) -> None:
    """Require a probability between 0 and 1 where it is concrete, and a covariance of the tangent space."""
    if not (hasattr(jump, "probability") and hasattr(jump, "covariance")):
        raise TypeError(f"jump must return a Jump; got {_kind(jump)}.")
    check_scalar("probability of jump", jump.probability, "between 0 and 1", lambda value: 0 < value < 1)
    check_covariance("covariance of jump", jump.covariance, size)


def check_history(history: Any) -> None:
    """Require the ensembles of a run: leaves with time as first and the particles as last axis, integer ancestors."""
    if not all(hasattr(history, name) for name in ("particles", "log_weights", "ancestors")):
        raise TypeError(f"history must be a History, as keep_history collects it; got {_kind(history)}.")
    if jnp.ndim(history.log_weights) != 2:
        raise ValueError(f"log_weights of history must have the shape (t, n); got {jnp.shape(history.log_weights)}.")
    length, count = jnp.shape(history.log_weights)
    check_shape("ancestors of history", history.ancestors, (length, count), "that of its log_weights")
    if not _is_integer(history.ancestors):
        raise TypeError(f"ancestors of history must be integers; got {jnp.result_type(history.ancestors)}.")
    for path, leaf in jax.tree_util.tree_leaves_with_path(history.particles):
        shape = jnp.shape(leaf)
        if len(shape) < 2 or (shape[0], shape[-1]) != (length, count):
            name = f"particles{jax.tree_util.keystr(path)} of history"
            raise ValueError(f"{name} must have the shape ({length}, ..., {count}); got {shape}.")


def names_matrices_that_cannot_be_shared(step: Callable) -> Callable:
    """Wrap a prediction or an update, so that its error explains which matrices must not depend on the particle."""

    @wraps(step)
    def wrapped(model: Any, *args: Any) -> Any:
        try:
            return step(model, *args)
        except ValueError as error:
            if model.covariance_axis is not None or "out_axes" not in str(error):
                raise
            raise ValueError(
                "dynamics and observe of rao_blackwell_shared must return matrices that do not depend on the particle "
                f"(rao_blackwell takes those that do); got other ones: {error}"
            ) from error

    return wrapped
