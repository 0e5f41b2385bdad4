r"""Proposals of particle filters.

`linearized` and `laplace` propose from the observation, for `jf.guided` and `jf.auxiliary`. The others are for the
argument `proposal` of Rao-Blackwellized filters, and say how the increment of the nonlinear state is drawn.

Such a proposal draws $\delta = z - A_n m$, the deviation of the increment $z$ from its prediction by the mean $m$ of
the linear state. Given the past, $\delta \sim N(0, N)$ with $N = A_n P A_n^T + Q_n$, where $P$ is the covariance of the
linear state (T. Schön, F. Gustafsson and P.-J. Nordlund, "Marginalized particle filters for mixed linear/nonlinear
state-space models", IEEE Transactions on Signal Processing 53, 2005). Each is
`(noise, N, Q_n) -> (delta, log_correction)`, where `noise` is standard normal and `log_correction` is the logarithm of
the ratio of this density to the one that was drawn from, to be added to the log weight.
"""

from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters._full_precision import dot
from jaxfilters.math.linalg import cholesky, solve_triangular
from jaxfilters.particle.gaussian_proposals import laplace as laplace
from jaxfilters.particle.gaussian_proposals import linearized as linearized


@runtime_checkable
class IncrementProposal(Protocol):
    """Draw the deviation `(n,)` of the increment from standard normal noise; returns it and its log correction."""

    def __call__(
        self, noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"], /
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]: ...


def exact(
    noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Draw from N(0, N), the transition with the linear state integrated out, which needs no correction.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> delta, log_correction = jf.proposals.exact(jnp.ones(1), jnp.array([[4.0]]), jnp.array([[1.0]]))
        >>> round(float(delta[0]), 3), round(float(log_correction), 3)
        (2.0, 0.0)
    """
    del Q_n
    return dot(cholesky(N), noise), jnp.zeros((), noise.dtype)


def plug_in(
    noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Draw from N(0, Q_n) without correction, with the mean of the linear state in place of its true value.

    The proposal is that of Kajihara and Tanaka, "A method for 3D hand pose tracking using a Rao-Blackwellized particle
    filter", equations 49-54. The result is the filter of a model in which one noise drives both states; for the given
    model its posterior is too narrow.

    Examples:
        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> delta, log_correction = jf.proposals.plug_in(jnp.ones(1), jnp.array([[4.0]]), jnp.array([[1.0]]))
        >>> round(float(delta[0]), 3), round(float(log_correction), 3)
        (1.0, 0.0)
    """
    del N
    return dot(cholesky(Q_n), noise), jnp.zeros((), noise.dtype)


def plug_in_corrected(
    noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Draw from N(0, Q_n) and correct the weight to N(0, N): consistent, with weights of larger variance.

    Examples:
        At zero, the density of N(0, 4) is half of that of N(0, 1).

        >>> import jax.numpy as jnp, jaxfilters as jf
        >>> delta, log_correction = jf.proposals.plug_in_corrected(jnp.zeros(1), jnp.array([[4.0]]), jnp.array([[1.0]]))
        >>> round(float(jnp.exp(log_correction)), 3)
        0.5
    """
    root_Q, root_N = cholesky(Q_n), cholesky(N)
    delta = dot(root_Q, noise)
    whitened = solve_triangular(root_N, delta)
    # A direction without noise in either has no density to correct.
    scales = jnp.stack([jnp.diagonal(root_Q), jnp.diagonal(root_N)])
    log_scales = jnp.log(jnp.where(jnp.any(scales > 0, axis=0), scales, 1.0))
    narrower = jnp.sum(log_scales[0] - log_scales[1])
    return delta, 0.5 * (dot(noise, noise) - dot(whitened, whitened)) + narrower
