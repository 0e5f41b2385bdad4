"""A person's parameters from measured shapes, and how well people outside of the training set are described."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from jaxfilters.math import linalg
from jaxfilters.models.face.multilinear import (
    EXPRESSION_MODE,
    EXPRESSIONS,
    IDENTITIES,
    PEOPLE_MODE,
    MultilinearFace,
    of_tensor,
    shape,
)
from jaxfilters.optimize.least_squares import BoxLevenbergMarquardt

LIMIT = 2.0
"""Standard deviations from their mean within which parameters are looked for."""
MEASURED_MM = 1.0
"""What a coordinate errs by, from noise and from what a model leaves out, where shapes are weighed against a prior."""
_MOST_STEPS = 60


class Fit(NamedTuple):
    """A person with several expressions."""

    identity: Float[Array, " S"]
    expressions: Float[Array, "F A"]
    """One row for each face."""
    log_size: Float[Array, ""]
    """Logarithm of the true size over that of the measured shapes; 0 where that is taken for true."""


class Generalisation(NamedTuple):
    """How well people are described by a model that was fitted to all others."""

    rms_mm: Float[Array, " people"]
    """Distance of a landmark from the closest faces within two standard deviations."""
    size_error: Float[Array, " people"]
    """Relative error of the likeliest size where only the shape is known. It is one camera's error of depth, too."""


@jax.jit
def fitted(model: MultilinearFace, shapes: Float[Array, "F K 3"]) -> Fit:
    """The parameters of least squared distance, each within two standard deviations of its mean.

    Args:
        model: Of K landmarks.
        shapes: Of one person, millimetres in the model frame.
    """
    near = lambda fit: shapes - _faces(model, fit)
    deviations = lambda x: Fit(
        model.identity_mean + model.identity_std * x.identity,
        model.expression_mean + model.expression_std * x.expressions,
        x.log_size,
    )
    start = _start(model, shapes)
    bound = Fit(jnp.full_like(start.identity, LIMIT), jnp.full_like(start.expressions, LIMIT), start.log_size)
    options = {"lower": jax.tree.map(jnp.negative, bound), "upper": bound}
    return deviations(_solved(lambda x: near(deviations(x)), start, options))


@jax.jit
def fitted_up_to_size(model: MultilinearFace, shapes: Float[Array, "F K 3"]) -> Fit:
    """The likeliest parameters of shapes of unknown size, which is how one camera sees them.

    Measured coordinates err by `MEASURED_MM`; parameters have their means and covariances, any size is as likely.
    """
    start = _start(model, shapes)
    return _parameters(model, _solved(lambda x: _weighed(model, shapes, x), start, {}))


@jax.jit
def likeliest(
    model: MultilinearFace, shapes: Float[Array, "F K 3"]
) -> tuple[Fit, Float[Array, "S S"], Float[Array, "K 3"]]:
    """The likeliest parameters of shapes in millimetres, the covariance of the identity, and what is left on average.

    As `fitted_up_to_size`, but of the size that was measured. The covariance is that of Laplace's approximation.
    """
    start = _start(model, shapes)
    held = lambda x: _weighed(model, shapes, x._replace(log_size=jnp.zeros_like(x.log_size)))
    found = _solved(held, start, {})
    flat, unravel = jax.flatten_util.ravel_pytree((found.identity, found.expressions))

    def residuals(y: Array) -> Array:
        identity, expressions = unravel(y)
        return jax.flatten_util.ravel_pytree(held(Fit(identity, expressions, found.log_size)))[0]

    J = jax.jacfwd(residuals)(flat)
    inverse = jnp.linalg.inv(_product(J.T, J))[: found.identity.size, : found.identity.size]
    root, _ = _roots(model)
    fit = _parameters(model, found)
    return fit, _product(_product(root, inverse), root.T), jnp.mean(shapes - _faces(model, fit), axis=0)


def _roots(model):
    # A singular covariance is possible: fewer people than parameters.
    return linalg.cholesky(_regular(model.identity_covariance)), linalg.cholesky(_regular(model.expression_covariance))


def _parameters(model, x):
    """Of numbers that have a standard normal distribution."""
    identity_root, expression_root = _roots(model)
    return Fit(
        model.identity_mean + _product(identity_root, x.identity),
        model.expression_mean + _product(x.expressions, expression_root.T),
        x.log_size,
    )


def _weighed(model, shapes, x):
    fit = _parameters(model, x)
    near = (shapes - jnp.exp(-fit.log_size) * _faces(model, fit)) / MEASURED_MM
    return near, x.identity, x.expressions


_product = partial(jnp.matmul, precision="highest")


def leave_one_out(
    tensor: Float[Array, "K 3 halves A"],
    people: Sequence[int],
    *,
    identities: int = IDENTITIES,
    expressions: int = EXPRESSIONS,
) -> Generalisation:
    """How well some of the S people of a data tensor are described by models of the S - 1 others.

    A person's faces are the means of their symmetric halves, which share one identity.

    Args:
        tensor: Data tensor (`multilinear.shape_tensor`).
        people: Whom to leave out, one after the other.
        identities: Parameters of identity.
        expressions: Parameters of expression.

    Raises:
        ValueError: if the others are fewer than two, or too few for the ranks.
    """
    num_people = tensor.shape[PEOPLE_MODE] // 2
    if num_people < 3:
        raise ValueError(f"tensor must have three people or more to leave one out; got {num_people}.")
    one = lambda person: _left_out(tensor, person, identities, expressions)
    # Not vmap: batches of singular value decompositions can stand still on two cores.
    return Generalisation(*jax.lax.map(one, jnp.asarray(people)))


@partial(jax.jit, static_argnums=(2, 3))
def _left_out(tensor, person, identities, expressions):
    num_people = tensor.shape[PEOPLE_MODE] // 2
    # Those after the person move up: the number of the others is known before compilation.
    others = jnp.arange(num_people - 1)
    others = others + (others >= person)
    both = jnp.concatenate([others, others + num_people])
    model = of_tensor(tensor[:, :, both], {PEOPLE_MODE: identities, EXPRESSION_MODE: expressions})
    faces = jnp.moveaxis((tensor[:, :, person] + tensor[:, :, person + num_people]) / 2, -1, 0)
    apart = faces - _faces(model, fitted(model, faces))
    rms_mm = jnp.sqrt(jnp.mean(jnp.sum(jnp.square(apart), axis=-1)))
    return rms_mm, jnp.expm1(fitted_up_to_size(model, faces).log_size)


def _faces(model, fit):
    return jax.vmap(lambda expression: shape(model, fit.identity, expression))(fit.expressions)


def _start(model, shapes):
    """All parameters at their means."""
    zeros = partial(jnp.zeros, dtype=shapes.dtype)
    return Fit(zeros(model.num_identities), zeros((shapes.shape[0], model.num_expressions)), zeros(()))


def _solved(residuals, start, options):
    tolerance = 100 * float(np.finfo(start.identity.dtype).eps)
    solver = BoxLevenbergMarquardt(rtol=tolerance, atol=tolerance)
    solve = optimistix.least_squares
    return solve(lambda x, _: residuals(x), solver, start, options=options, max_steps=_MOST_STEPS, throw=False).value


def _regular(covariance):
    return covariance + 1e-6 * jnp.trace(covariance) / len(covariance) * jnp.eye(
        len(covariance), dtype=covariance.dtype
    )
