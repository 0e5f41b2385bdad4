r"""How a Rao-Blackwellized particle filter draws the nonlinear state.

The quantity drawn is the innovation $\delta = z - A_n m$: what the nonlinear state does beyond what the mean $m$ of the
linear state predicts. Given the past, $\delta \sim N(0, N)$ with $N = A_n P A_n^T + Q_n$, because the linear state is
uncertain (Schön, Gustafsson and Nordlund 2005). Each proposal is `(noise, N, Q_n) -> (delta, log_correction)`, where
`noise` is standard normal and `log_correction` is the log ratio of that density to the one drawn from, to be added to
the log weight.
"""

from typing import Protocol, runtime_checkable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.math.linalg import cholesky, solve_triangular


@runtime_checkable
class Proposal(Protocol):
    """Draw the innovation of the nonlinear state from standard normal noise."""

    def __call__(
        self, noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"], /
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]: ...


def exact(
    noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Draw from N(0, N), the transition with the linear state integrated out: no correction is due."""
    del Q_n
    return cholesky(N) @ noise, jnp.zeros((), noise.dtype)


def plug_in(
    noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Draw from N(0, Q_n) without correction, as Kajihara and Tanaka, eqs. 49-54.

    It treats the mean of the linear state as its true value: what it filters is a model in which one noise drives both
    states, and its posterior is too narrow.
    """
    del N
    return cholesky(Q_n) @ noise, jnp.zeros((), noise.dtype)


def plug_in_corrected(
    noise: Float[Array, " n"], N: Float[Array, "n n"], Q_n: Float[Array, "n n"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Draw from N(0, Q_n) and correct the weight to N(0, N): consistent, with more variable weights than `exact`."""
    root_Q, root_N = cholesky(Q_n), cholesky(N)
    delta = root_Q @ noise
    whitened = solve_triangular(root_N, delta)
    log_ratio = 0.5 * (noise @ noise - whitened @ whitened) + _half_log_det(root_Q) - _half_log_det(root_N)
    return delta, log_ratio


def _half_log_det(root: Float[Array, "n n"]) -> Float[Array, ""]:
    return jnp.log(jnp.diagonal(root)).sum()
