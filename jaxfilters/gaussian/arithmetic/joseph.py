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
    """
    return covariance.update(_form, belief, y, H, R, y_hat, mask, added_root)


def condition(
    P: Float[Array, "n n"], H: Float[Array, "m n"], R: Float[Array, "m m"], innovation: Float[Array, " m"]
) -> covariance.Update:
    """The update with every component observed, of which the covariance depends on no reading: shared by an ensemble.

    NaN in the innovation becomes NaN in the shift and in the log density.
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
    """
    return covariance.backward(_form, belief, F, Q, b, added_root)


def _form(P, H, R, gain, W):
    del W
    return factor.turned(covariance.kept(gain, H), P) + factor.turned(gain, R)
