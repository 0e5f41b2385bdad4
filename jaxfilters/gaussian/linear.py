"""The Kalman filter of a linear Gaussian model, given by its matrices."""

from collections.abc import Callable
from dataclasses import field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, DTypeLike, Float, Num, PyTree

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.last_axis import batch_last
from jaxfilters.filter import Filter
from jaxfilters.gaussian import arithmetic as arithmetics
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.arithmetic import Arithmetic, KalmanInfo, factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import Observation, as_observation
from jaxfilters.gaussian.linearize import Linearization
from jaxfilters.gaussian.manifold import Belief, Manifold, dimension, euclidean
from jaxfilters.math import linalg
from jaxfilters.typing import AnyKey, only_inputs

Matrix = Array | Callable
"""A matrix or vector of the model, or a function of the inputs that gives it."""


class Matrices(NamedTuple):
    """The model of one step."""

    F: Float[Array, "n n"]
    Q: Float[Array, "n _"]
    H: Float[Array, "m n"]
    R: Float[Array, "m _"]
    b: Float[Array, " n"] | None
    d: Float[Array, " m"] | None


@pytree_dataclass
class Kalman:
    """Parameters of a Kalman filter; a `GaussianModel`. Each matrix may be a function of the inputs."""

    prior: Belief
    F: Matrix
    """(n, n)."""
    Q: Matrix
    """(n, n), or (n, any) where the arithmetic takes roots."""
    H: Matrix
    """(m, n)."""
    R: Matrix
    """(m, m), or (m, any) where the arithmetic takes roots."""
    b: Matrix | None
    """(n,)."""
    d: Matrix | None
    """(m,)."""
    arithmetic: Arithmetic = field(metadata={"static": True})

    @property
    def manifold(self) -> Manifold:
        """Vectors."""
        return euclidean

    @property
    def observation_noise(self) -> Matrix:
        """R."""
        return self.R

    @property
    def process_noise(self) -> Matrix:
        """Q."""
        return self.Q

    def transition(self, x: Float[Array, " n"], inputs: PyTree) -> Float[Array, " n"]:
        """F x + b."""
        F, b = self._at("F", inputs), self._at("b", inputs)
        return factor.apply(F, x) if b is None else factor.apply(F, x) + b

    def linear_transition(self, belief: Belief, inputs: PyTree) -> tuple[Array, Linearization]:
        """The predicted mean, and F about it."""
        ahead = self.transition(belief.mean, inputs)
        F = self._at("F", inputs)
        return ahead, Linearization(jnp.zeros_like(ahead), F, jnp.zeros((ahead.size, 0), ahead.dtype))

    def process_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """Q."""
        del belief
        return self._at("Q", inputs)

    def observation_noise_of(self, belief: Belief, inputs: PyTree) -> Array:
        """R."""
        del belief
        return self._at("R", inputs)

    def given(self) -> tuple[Any, ...]:
        """The matrices and vectors as they were given: arrays, functions of the inputs, or None."""
        return tuple(getattr(self, name) for name in Matrices._fields)

    def matrices(self, inputs: PyTree) -> Matrices:
        """The model of one step, with shapes that fit one another."""
        found = Matrices(*(self._at(name, inputs) for name in Matrices._fields))
        _check_shapes(found, self.prior)
        return found

    def _at(self, name: str, inputs: PyTree) -> Any:
        value = getattr(self, name)
        if not callable(value):
            _refuse_unused(self, inputs)
            return value
        found = value(inputs)
        checks.floating(f"the result of {name}", found)
        return found


def kalman(
    prior: Gaussian | GaussianRoot,
    F: Num[ArrayLike, "..."] | Callable,
    Q: Num[ArrayLike, "..."] | Callable,
    H: Num[ArrayLike, "..."] | Callable,
    R: Num[ArrayLike, "..."] | Callable,
    *,
    b: Num[ArrayLike, "..."] | Callable | None = None,
    d: Num[ArrayLike, "..."] | Callable | None = None,
    arithmetic: Arithmetic = arithmetics.joseph,
) -> Filter:
    """Kalman filter of `x' = F x + b + q`, `y = H x + d + r` with `q ~ N(0, Q)` and `r ~ N(0, R)`.

    Observations are arrays `y` with m components, NaN where nothing was read, or `Observation(y, mask, noise)`. The
    state is the belief, and the info a `KalmanInfo` (R. Kalman, "A new approach to linear filtering and prediction
    problems", J. Basic Eng. 82(1), 1960). `smoothing.rts` smooths what it found.

    Each matrix and vector may be a function of the inputs of the step instead, `inputs -> matrix`, for a model that
    changes with time: `b=lambda u: B @ u` is a motor's command. A whole sequence of matrices F_1 .. F_T is itself the
    inputs: `jf.kalman(prior, lambda u: u, Q, H, R)`, run with `inputs=Fs` of shape (T, n, n).

    Args:
        prior: Belief before the first observation, which is predicted once before it is updated: a `Gaussian`, or a
            `GaussianRoot` for `arithmetic.square_root`.
        F: Transition matrix, (n, n).
        Q: Covariance of the process noise, (n, n); a root of it, (n, any width), for `arithmetic.square_root`.
        H: Observation matrix, (m, n).
        R: Covariance of the observation noise, (m, m); a root of it, (m, any width), for `arithmetic.square_root`.
        b: Known change of the state in every step, (n,); none by default.
        d: Known offset of the observation, (m,); none by default.
        arithmetic: `jaxfilters.arithmetic.joseph`, `square_root` or `fast`.

    Returns:
        The filter.

    Raises:
        ValueError: If shapes do not fit one another, the prior does not fit the arithmetic, or a covariance is not
            symmetric and positive semidefinite (tested where its values are known); when it runs, if an observation
            has another shape than `(m,)`, a function returns a matrix of another shape, or inputs are given to a filter
            without functions of them.
        TypeError: If the prior is no belief, or a function takes other arguments than the inputs.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(2), jnp.eye(2))
        >>> F, H = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[1.0, 0.0]])
        >>> filter = jf.kalman(prior, F, 0.01 * jnp.eye(2), H, 0.1 * jnp.eye(1))
        >>> last, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((20, 1)))
        >>> beliefs.mean.shape, infos.log_evidence.shape
        ((20, 2), (20,))
    """
    checks.arithmetic_of(prior, arithmetic)
    dtype = prior.mean.dtype
    given = zip(Matrices._fields, (F, Q, H, R, b, d), strict=True)
    found = Matrices(*(_matrix(name, value, dtype) for name, value in given))
    _check_shapes(found, prior)
    return Filter(Kalman(prior, *found, arithmetic), _init, _predict, _update)


def _check_shapes(matrices: Matrices, prior: Belief) -> None:
    """Raise an error unless the matrices that are known fit one another and the prior."""
    F, Q, H, R, b, d = matrices
    n = prior.mean.shape[0]
    m = None if callable(H) else H.shape[0] if H.ndim else 0
    rows = f"H {m} rows" if m is not None else "H a number of rows that its function decides"
    shapes: list[tuple[str, Any, tuple[int, ...]]] = [("F", F, (n, n)), ("b", b, (n,))]
    if m is not None:
        shapes += [("H", H, (m, n)), ("d", d, (m,))]
    for name, value, shape in shapes:
        if value is not None and not callable(value):
            varies = value.ndim == len(shape) + 1
            hint = "; for one that changes with time, pass a function of the inputs" if varies else ""
            checks.shaped(name, value, shape, f", as the prior has {n} components and {rows}{hint}")
    is_root = isinstance(prior, GaussianRoot)
    for name, value, size in (("Q", Q, n), ("R", R, m)):
        if not callable(value):
            checks.noise(name, value, size, is_root=is_root)


def _init(model: Kalman, key: AnyKey) -> Belief:
    del key
    prior = model.prior
    if isinstance(prior, GaussianRoot) and prior.root.shape[1] != prior.root.shape[0]:
        return GaussianRoot(prior.mean, linalg.tria(prior.root))
    return prior


def _predict(model: Kalman, key: AnyKey, belief: Belief, inputs: PyTree) -> Belief:
    del key
    checks.state(belief, model.prior)
    predict = _predicted if dimension(belief) > factor.UNROLLED else batch_last(_predicted)
    return predict(model, belief, inputs)


def _predicted(model: Kalman, belief: Belief, inputs: PyTree) -> Belief:
    step = model.matrices(inputs)
    return model.arithmetic.predict(belief, step.F, step.Q, 0.0 if step.b is None else step.b)


def _update(
    model: Kalman, key: AnyKey, belief: Belief, observation: PyTree, inputs: PyTree
) -> tuple[Belief, KalmanInfo]:
    del key
    checks.state(belief, model.prior)
    observation = as_observation(observation)
    update = _updated if max(observation.y.size, dimension(belief)) > factor.UNROLLED else batch_last(_updated)
    return update(model, belief, observation, inputs)


def _updated(model: Kalman, belief: Belief, observation: Observation, inputs: PyTree) -> tuple[Belief, KalmanInfo]:
    y, mask, noise = observation
    step = model.matrices(inputs)
    m = step.H.shape[0]
    checks.shaped("the observation y", y, (m,), f", as H has {m} rows")
    if noise is not None:
        checks.noise_shape("Observation.noise", noise, m, is_root=isinstance(belief, GaussianRoot))
    y_hat = None if step.d is None else factor.apply(step.H, belief.mean) + step.d
    return model.arithmetic.update(belief, y, step.H, step.R if noise is None else noise, y_hat, mask)


def _refuse_unused(model: Kalman, inputs: PyTree) -> None:
    if jax.tree.leaves(inputs) and not any(map(callable, model.given())):
        raise ValueError(
            "inputs must be None for a filter made by kalman of arrays alone: "
            "at least one of F, Q, H, R, b and d must be a function of them."
        )


def _matrix(name: str, value: Any, dtype: DTypeLike) -> Any:
    """An array of floating-point numbers, a function of the inputs as a pytree, or None."""
    if value is None or not callable(value):
        return None if value is None else _floating(value, dtype)
    return only_inputs(name, value)


def _floating(matrix: ArrayLike, dtype: DTypeLike) -> Array:
    matrix = jnp.asarray(matrix)
    return matrix if jnp.issubdtype(matrix.dtype, jnp.floating) else matrix.astype(dtype)
