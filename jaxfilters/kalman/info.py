"""What a Kalman update reports, and what a mask does to a measurement."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters import gaussian, linalg


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class KalmanInfo:
    """Diagnostics of one update."""

    innovation: Float[Array, "..."]
    """(m,): `y - y_hat`; 0 for components left out: masked, or certain before they were seen."""
    innovation_root: Float[Array, "..."]
    """(m, m), lower L with `L L^T` the covariance of the innovation; zeros for components left out."""
    log_evidence: Float[Array, "..."]
    """Log density of the components of y that count, given all before them."""
    nis: Float[Array, "..."]
    """Normalised innovation squared: chi-squared with as many degrees of freedom as components count."""


def report(deviation: Float[Array, " m"], root: Float[Array, "m m"]) -> KalmanInfo:
    """Diagnostics of an innovation and the lower root of its covariance."""
    innovation = jnp.where(jnp.diagonal(root) == 0, 0.0, deviation)
    whitened = linalg.solve_triangular(root, innovation)
    return KalmanInfo(innovation, root, gaussian.logpdf(innovation, root), jnp.sum(whitened * whitened))


def innovation(
    mean: Float[Array, " n"], y: Float[Array, " m"], H: Float[Array, "m n"], y_hat: Float[Array, " m"] | None
) -> Float[Array, " m"]:
    """`y - y_hat`, with `H mean` for `y_hat` unless given."""
    return y - (H @ mean if y_hat is None else y_hat)


def observed(mask: Bool[Array, " m"] | None, rows: Float[Array, "m *k"]) -> Float[Array, "m *k"]:
    """The rows, zero where masked; all of them without a mask."""
    if mask is None:
        return rows
    return jnp.where(mask.reshape(mask.shape + (1,) * (rows.ndim - 1)), rows, 0.0)
