r"""Faces that separate who from what expression: landmarks that are bilinear in identity and expression.

`X = mean + sum_jk tensor[..., j, k] identity_j expression_k` (Y. Sugano 2007, equation 4.15). The tensor is the best
one of its ranks for symmetric halves of training faces, people along one mode and expressions along the other
(equations 4.11-4.14). The scale of the faces is that of the tensor: the parameters of the training faces are rows of
matrices with orthonormal columns, and `(c identity, expression / c)` is the same face.
"""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math.linalg import safe_sqrt
from jaxfilters.math.multilinear import check_finite, hooi
from jaxfilters.math.tensor_completion import complete
from jaxfilters.models.face.mirroring import PAIRS, Pairs, symmetrised

IDENTITIES, EXPRESSIONS = 10, 5
"""S' and A' of the thesis."""
LEAST_VARIANCE = 1e-5
"""Of any combination of parameters, as a share of their mean variance."""
PEOPLE_MODE, EXPRESSION_MODE = 2, 3
"""Of the data tensor (K, 3, 2S, A)."""


@pytree_dataclass
class MultilinearFace:
    """K symmetric landmarks, S parameters of identity, A of expression, and how people differ in them."""

    mean: Float[Array, "K 3"]
    """Mean over the training faces, millimetres in the model frame."""
    tensor: Float[Array, "K 3 S A"]
    """Millimetres (equation 4.14, `Mchk`)."""
    identity_mean: Float[Array, " S"]
    """Of the training people."""
    identity_covariance: Float[Array, "S S"]
    expression_mean: Float[Array, " A"]
    """Of the training expressions."""
    expression_covariance: Float[Array, "A A"]

    @property
    def num_landmarks(self) -> int:
        """K."""
        return self.mean.shape[-2]

    @property
    def num_identities(self) -> int:
        """S, the parameters of who it is."""
        return self.tensor.shape[-2]

    @property
    def num_expressions(self) -> int:
        """A, the parameters of the expression."""
        return self.tensor.shape[-1]

    @property
    def identity_std(self) -> Float[Array, " S"]:
        """Standard deviations of the identity parameters among people."""
        return safe_sqrt(jnp.diagonal(self.identity_covariance, axis1=-2, axis2=-1))

    @property
    def expression_std(self) -> Float[Array, " A"]:
        """Standard deviations of the expression parameters."""
        return safe_sqrt(jnp.diagonal(self.expression_covariance, axis1=-2, axis2=-1))


def shape(model: MultilinearFace, identity: Float[Array, " S"], expression: Float[Array, " A"]) -> Float[Array, "K 3"]:
    """Landmarks in the model frame, millimetres (equation 4.15)."""
    return model.mean + _along_last(expression_basis(model, identity), expression)


def expression_basis(model: MultilinearFace, identity: Float[Array, " S"]) -> Float[Array, "K 3 A"]:
    """Change of the landmarks of a person by each expression parameter, millimetres (equation 4.38)."""
    return jnp.einsum("kdsa,s->kda", model.tensor, identity, precision="highest")


def identity_basis(model: MultilinearFace, expression: Float[Array, " A"]) -> Float[Array, "K 3 S"]:
    """Change of the landmarks with an expression by each identity parameter, millimetres (section 2.3, `M_a`)."""
    return _along_last(model.tensor, expression)


def restricted(model: MultilinearFace, landmarks: Sequence[int]) -> MultilinearFace:
    """The model of some of its landmarks, with the same people and expressions."""
    chosen = np.array(landmarks)
    return replace(model, mean=model.mean[chosen], tensor=model.tensor[chosen])


def shape_tensor(shapes: Float[Array, "S A K 3"], pairs: Pairs = PAIRS) -> Float[Array, "K 3 2*S A"]:
    """Data tensor of equation 4.11: both symmetric halves of every shape, before the mean is subtracted.

    Shapes are moved along x so that the midpoints of their pairs lie at 0 on average. Person i has the indices i (right
    half) and S + i (left half).

    Args:
        shapes: Of S people with A expressions each, millimetres.
        pairs: (right, left) indices of landmarks.
    """
    paired = np.array([index for pair in pairs for index in pair])
    center = jnp.mean(shapes[:, :, paired, :1], axis=2, keepdims=True)
    centred = shapes - center * jnp.array([1, 0, 0], shapes.dtype)
    halves = jax.vmap(jax.vmap(lambda one: symmetrised(one, pairs)))(centred)
    # (S, A, 2, K, 3) to (K, 3, 2, S, A)
    T = jnp.transpose(halves, (3, 4, 2, 0, 1))
    return T.reshape(*T.shape[:2], -1, T.shape[-1])


def learn(
    shapes: Float[Array, "S A K 3"],
    *,
    identities: int = IDENTITIES,
    expressions: int = EXPRESSIONS,
    observed: Bool[Array, "people actions"] | None = None,
    pairs: Pairs = PAIRS,
) -> MultilinearFace:
    """The model of given ranks that fits symmetric halves of the training faces best (equations 4.11-4.14).

    Args:
        shapes: Of S people with A expressions each, millimetres, in one model frame: aligned to each person's neutral
            face. Expressions mean the same for all people.
        identities: S', parameters of identity.
        expressions: A', parameters of expression.
        observed: Which faces there are; the others are completed first (`tensor_completion`). Default: all.
        pairs: (right, left) indices of landmarks.

    Raises:
        ValueError: if a shape that counts is not finite, there are fewer than two people or expressions, a person or an
            expression has no face at all, or the ranks are more than S people in two halves, A expressions and K
            landmarks can have.
    """
    num_people, num_expressions = shapes.shape[:2]
    if num_people < 2 or num_expressions < 2:
        raise ValueError(f"shapes must be of two people and two expressions or more; got {shapes.shape}.")
    ranks = {PEOPLE_MODE: identities, EXPRESSION_MODE: expressions}
    if observed is None:
        check_finite("shapes", shapes)
        T = shape_tensor(shapes, pairs)
    else:
        T = completed(shapes, observed, ranks, pairs)
    return of_tensor(T, ranks)


def completed(
    shapes: Float[Array, "S A K 3"],
    observed: Bool[Array, "people actions"],
    ranks: dict[int, int],
    pairs: Pairs = PAIRS,
) -> Float[Array, "K 3 2*S A"]:
    """Data tensor with the missing faces completed by the model of given ranks that fits the others best.

    Raises:
        ValueError: as `tensor_completion.complete`.
    """
    if observed.shape != shapes.shape[:2]:
        raise ValueError(f"observed must be {shapes.shape[:2]}, a face for each person and expression.")
    T = shape_tensor(jnp.where(observed[:, :, None, None], shapes, jnp.nan), pairs)
    visible = jnp.broadcast_to(jnp.tile(observed, (2, 1)), T.shape)
    mean = jnp.sum(jnp.where(visible, T, 0), axis=(2, 3), keepdims=True) / jnp.maximum(jnp.sum(observed) * 2, 1)
    return complete(T - mean, visible, ranks).filled + mean


def of_tensor(T: Float[Array, "K 3 n A"], ranks: dict[int, int]) -> MultilinearFace:
    """The model of a data tensor (equations 4.13-4.14), whose people are rows and whose faces are symmetric."""
    mean = jnp.mean(T, axis=(PEOPLE_MODE, EXPRESSION_MODE))
    core, factors, _ = hooi(T - mean[:, :, None, None], ranks)
    people, actions = factors[PEOPLE_MODE], factors[EXPRESSION_MODE]
    return MultilinearFace(mean, core, *_moments(people), *_moments(actions))


def _moments(rows):
    """Mean and sample covariance, of full rank also where there are as many parameters as examples."""
    mean = jnp.mean(rows, axis=0)
    apart = rows - mean
    covariance = jnp.matmul(apart.T, apart, precision="highest") / (len(rows) - 1)
    least = LEAST_VARIANCE * jnp.trace(covariance) / len(covariance)
    return mean, covariance + least * jnp.eye(len(covariance), dtype=covariance.dtype)


def _along_last(basis, coefficients):
    return jnp.tensordot(basis, coefficients, 1, precision="highest")
