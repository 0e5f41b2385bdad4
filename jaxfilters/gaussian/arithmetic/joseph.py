"""Kalman filter atoms on covariances, with Joseph's form of the update: never indefinite by subtraction."""

from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian.arithmetic import covariance, factor, info
from jaxfilters.gaussian.arithmetic.covariance import noise_root as noise_root
from jaxfilters.gaussian.arithmetic.covariance import predict as predict
from jaxfilters.gaussian.belief import Gaussian

Belief = Gaussian


def update(
    belief: Gaussian,
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    R: Float[Array, "m m"],
    y_hat: Float[Array, " m"] | None = None,
    mask: Bool[Array, " m"] | None = None,
    added_root: Float[Array, "m _"] | None = None,
) -> tuple[Gaussian, info.KalmanInfo]:
    """Belief after the observation `y = y_hat + H (x - mean) + r`, r ~ N(0, R), and its diagnostics.

    `y_hat` is `H mean` unless given; for a nonlinear observation it is the predicted one, and H its Jacobian.
    `added_root` is a root of more noise. Components where `mask` is False have no effect, whatever `y`, `y_hat` and the
    rows of `H`, `R` and `added_root` hold, NaN included. Neither have those that the diagnostics count as invalid or
    deficient. The
    covariance is `(I - K H) P (I - K H)^T + K R K^T` (R. Bucy, P. Joseph, "Filtering for stochastic processes", 1968).

    Examples:
        A reading of 2 whose noise is as uncertain as the prior N(0, 1).

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior, one = jf.Gaussian(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> posterior, info = jf.arithmetic.joseph.update(prior, jnp.array([2.0]), one, one)
        >>> print(posterior.mean.round(3), posterior.covariance.round(3))
        [1.] [[0.5]]
    """
    return covariance.update(_form, belief, y, H, R, y_hat, mask, added_root)


def condition(
    P: Float[Array, "n n"], H: Float[Array, "m n"], R: Float[Array, "m m"], innovation: Float[Array, " m"]
) -> covariance.Update:
    """The update with every component observed, of which the covariance depends on no reading: shared by an ensemble.

    NaN in the innovation becomes NaN in the shift and in the log density.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> update = jf.arithmetic.joseph.condition(one, one, one, jnp.array([2.0]))
        >>> print(update.shift.round(3))
        [1.]
    """
    return covariance.condition(_form, P, H, R, innovation)


def rts(
    belief: Gaussian,
    following: Gaussian,
    F: Float[Array, "k n"],
    Q: Float[Array, "k k"],
    b: Float[Array, " k"] | float = 0.0,
    added_root: Float[Array, "k _"] | None = None,
) -> Gaussian:
    """Belief given the future too, from `following`, that of the next step given the same.

    The next step is `x' = F x + b + q`, q ~ N(0, Q). Once x' is known, x has the covariance of an update that measured
    x'; what is not known of x' comes on top: no covariance is subtracted (H. Rauch, F. Tung, C. Striebel, "Maximum
    likelihood estimates of linear dynamic systems", AIAA J. 3(8), 1965).

    Examples:
        A constant: what is known later holds earlier, too.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> earlier, later = jf.Gaussian(jnp.zeros(1), one), jf.Gaussian(jnp.ones(1), 0.5 * one)
        >>> smoothed = jf.arithmetic.joseph.rts(earlier, later, one, 0.0 * one)
        >>> print(smoothed.mean, smoothed.covariance)
        [1.] [[0.5]]
    """
    return covariance.rts(_form, belief, following, F, Q, b, added_root)


def backward(
    belief: Gaussian,
    F: Float[Array, "k n"],
    Q: Float[Array, "k k"],
    b: Float[Array, " k"] | float = 0.0,
    added_root: Float[Array, "k _"] | None = None,
) -> tuple[Float[Array, "n k"], Gaussian]:
    """State given the next one, x': the gain G and the belief N(g, C), so that x is N(g + G x', C).

    The next step is `x' = F x + b + q`, q ~ N(0, Q), as for `rts`.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> gain, rest = jf.arithmetic.joseph.backward(jf.Gaussian(jnp.zeros(1), one), one, one)
        >>> print(gain.round(3), rest.covariance.round(3))
        [[0.5]] [[0.5]]
    """
    return covariance.backward(_form, belief, F, Q, b, added_root)


def _form(P, H, R, gain, W):
    del W
    return factor.turned(covariance.kept(gain, H), P) + factor.turned(gain, R)
