"""A face of one person: mean shape, linear deformations, and what its landmarks look like."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.math import linalg


@pytree_dataclass
class FaceModel:
    """K landmarks with B modes of deformation, observed by C cameras; B may be 0."""

    mean: Float[Array, "K 3"]
    """Mean shape in the model frame, millimetres about the centroid of the registered landmarks."""
    basis: Float[Array, "3*K B"]
    """Modes as orthonormal columns for shapes flattened landmark by landmark; zero where not yet estimated."""
    deviation: Float[Array, " B"]
    """Standard deviations mu of the mode coefficients, millimetres; 0 for modes not yet estimated."""
    templates: Float[Array, "C K T T"]
    """Grey levels around the landmarks at registration."""

    @property
    def num_modes(self) -> int:
        """B."""
        return self.basis.shape[-1]


def rigid(mean: Float[Array, "K 3"], templates: Float[Array, "C K T T"], *, num_modes: int = 0) -> FaceModel:
    """A face that does not deform, with room for modes to be estimated."""
    return FaceModel(mean, jnp.zeros((mean.size, num_modes), mean.dtype), jnp.zeros(num_modes, mean.dtype), templates)


def shape(model: FaceModel, a: Float[Array, " B"]) -> Float[Array, "K 3"]:
    """Landmarks in the model frame, millimetres: `mean + basis a`.

    Oka and Sato 2006, equation 14; Sugano 2007, equation 3.1.
    """
    return model.mean + linalg.matmul(model.basis, a[:, None]).reshape(model.mean.shape)
