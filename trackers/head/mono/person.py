"""Between a multilinear face with a person, and the face model with orthonormal modes that the search works with."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.models.face.multilinear import MultilinearFace, expression_basis
from jaxfilters.models.face.person_prior import Person, posed_shape
from jaxfilters.models.face.shape_model import FaceModel
from jaxfilters.trackers.head.common.state import NUM_MODES

FAINTEST_MODE = 1e-3
"""Millimetres, root of the sum over all landmarks: deviation of a mode that does nothing."""


class Modes(NamedTuple):
    """Expressions of one person as orthonormal modes of the shape: `a = mean + to_expression c`."""

    to_expression: Float[Array, "A B"]
    from_expression: Float[Array, "B A"]

    def expression(self, face: MultilinearFace, c: Float[Array, " B"]) -> Float[Array, " A"]:
        """Parameters of an expression given by mode coefficients, millimetres."""
        return face.expression_mean + _product(self.to_expression, c)

    def coefficients(self, face: MultilinearFace, expression: Float[Array, " A"]) -> Float[Array, " B"]:
        """Mode coefficients of an expression, millimetres."""
        return _product(self.from_expression, expression - face.expression_mean)


def model_of(face: MultilinearFace, person: Person, templates: Float[Array, "C K T T"]) -> tuple[FaceModel, Modes]:
    """The person with the mean expression, and all expressions as modes of standard deviations as in the training set.

    The singular vectors of `M_s chol(covariance of a)`: of a model with more expressions than the search has modes the
    strongest remain.
    """
    neutral = posed_shape(face, person, face.expression_mean)
    root = jnp.linalg.cholesky(face.expression_covariance)
    moves = _product(expression_basis(face, person.identity).reshape(neutral.size, -1), root)
    U, d, Vt = jnp.linalg.svd(moves, full_matrices=False)
    lacking = max(NUM_MODES - d.size, 0)
    U, d = jnp.pad(U[:, :NUM_MODES], ((0, 0), (0, lacking))), jnp.pad(d[:NUM_MODES], (0, lacking))
    Vt = jnp.pad(Vt[:NUM_MODES], ((0, lacking), (0, 0)))
    acts = d > FAINTEST_MODE
    d = jnp.where(acts, d, 0.0)
    inverse = jnp.where(acts, 1 / jnp.where(acts, d, 1.0), 0.0)
    to_unit = jax.scipy.linalg.solve_triangular(root, jnp.eye(len(root), dtype=root.dtype), lower=True)
    modes = Modes(_product(root, Vt.T * inverse), d[:, None] * _product(Vt, to_unit))
    return FaceModel(neutral, U, d, templates), modes


def _product(a: Array, b: Array) -> Array:
    """Matrix product in full precision on every device."""
    return jnp.matmul(a, b, precision="highest")
