"""By how much landmarks that a detector finds lie beside those of a model, for all images of one person alike.

A detector that puts nostrils three millimetres too far out does so in every image. Of this error the mean is known from
people whose landmarks are known, and what differs from person to person is a nuisance that no number of images reduces:
it is part of the person's offset from the model (`jaxfilters.models.face.person_prior.Person`), which all images share.
"""

from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float


class Misplacement(NamedTuple):
    """A Gaussian of the offset of a face as large as the mean one, with what the model lacks of the face included."""

    mean: Float[Array | np.ndarray, "K 3"]
    """Millimetres in the model frame."""
    std: Float[Array | np.ndarray, "K 3"]
    """Standard deviations."""
    whitening: Float[Array | np.ndarray, "3*K 3*K"]
    """Takes an offset about its mean to independent standard deviations: the inverse of a root of the covariance."""


def misplacement(
    mean: Float[ArrayLike, "K 3"], covariance: Float[ArrayLike, "3*K 3*K"], offset_std: float
) -> Misplacement:
    """The sum of what a detector misplaces and of what the model lacks, which are independent.

    Args:
        mean: Of the detector's part, millimetres in the model frame.
        covariance: Of the detector's part among people, mm^2.
        offset_std: Of each coordinate of what the model lacks, millimetres.

    Raises:
        ValueError: if the sum has no root.
    """
    total = np.asarray(covariance, float) + offset_std**2 * np.eye(np.size(mean))
    try:
        root = np.linalg.cholesky(total)
    except np.linalg.LinAlgError as error:
        raise ValueError("covariance must be positive definite once offset_std is added.") from error
    std = np.sqrt(np.diagonal(total)).reshape(np.shape(mean))
    return Misplacement(np.asarray(mean, float), std, np.linalg.inv(root))
