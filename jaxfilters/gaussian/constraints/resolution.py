"""A check that a covariance in single precision can represent the width of an inequality, where both are known."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.constraints.constant_rows import known_values
from jaxfilters.gaussian.constraints.linear import LinearConstraints
from jaxfilters.gaussian.extended import ExtendedKalman
from jaxfilters.gaussian.linear import Kalman

NARROWEST = 3e-3
"""Width in prior standard deviations below which repeated truncation along an oblique normal is not resolved by a
float32 covariance: the log evidence of six frames is wrong by up to 0.12 at a width of 1e-3."""


def check_resolution(inner: Filter, constraints: LinearConstraints, lasting: Any) -> None:
    """Reject narrow lasting rows on oblique directions for beliefs with a covariance in single precision.

    A float32 matrix does not represent a variance below 1e-7 of the others along a direction that is not an axis. Such
    rows need a `GaussianRoot` belief or float64: section 6 of `docs/derivations/narrow_constraints.md`. Nothing is
    checked for filters of another kind and where values are not known yet.

    Args:
        inner: The filter of the state.
        constraints: k rows.
        lasting: (k,), True for rows that are declared constant in time.

    Raises:
        ValueError: A row is too narrow; the message names the row and its width.
    """
    model = inner.params
    if not isinstance(model, ExtendedKalman | Kalman) or not isinstance(model.prior, Gaussian):
        return
    if jnp.asarray(model.prior.covariance).dtype != jnp.float32 or not model.manifold.flat:
        return
    bounds = (constraints.normals, constraints.lower, constraints.upper)
    known = known_values((*bounds, lasting, model.prior.covariance))
    if known is None:
        return
    normals, lower, upper, is_lasting, covariance = known
    widths = (upper - lower) / np.sqrt(np.maximum(np.sum(normals @ covariance * normals, axis=1), 1e-30))
    unresolved = is_lasting & (np.count_nonzero(normals, axis=1) > 1) & (widths < NARROWEST)
    if unresolved.any():
        k = int(np.argmax(unresolved))
        raise ValueError(
            f"constraints: {constraints.names[k]} is {widths[k]:.2g} prior standard deviations wide along a direction "
            f"that is not an axis; a float32 covariance resolves {NARROWEST:g} or more. Expected a filter with "
            "arithmetic=jf.arithmetic.square_root, or float64."
        )
