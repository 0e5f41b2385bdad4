r"""Two-filter smoother: a filter forwards and one backwards in time, which meet in every frame.

The backward filter carries $p(y_{t+1:T} \mid x_t) \propto \exp(\eta^T x - |Z^T x|^2 / 2)$, which need not be a density
of x: the information form has no prior (D. C. Fraser and J. E. Potter, "The optimum linear smoother as a combination of
two optimum linear filters", IEEE Transactions on Automatic Control 14(4), 1969). Z is kept, not $Z Z^T$: no digits are
lost by squaring.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jaxfilters.filter import Filter
from jaxfilters.gaussian import checks
from jaxfilters.gaussian.affine import AffineModel, affine_model
from jaxfilters.gaussian.arithmetic import factor
from jaxfilters.gaussian.belief import Gaussian, GaussianRoot
from jaxfilters.gaussian.extended import ExtendedKalman, Observation
from jaxfilters.gaussian.linear import Kalman
from jaxfilters.gaussian.linearize import lower_root, taylor
from jaxfilters.gaussian.manifold import Belief
from jaxfilters.gaussian.noise_models import NonAdditiveNoise
from jaxfilters.gaussian.parallel_in_time import informative
from jaxfilters.math import linalg
from jaxfilters.typing import Mask


def two_filter(
    filter: Filter, beliefs: Belief, observations: PyTree, inputs: PyTree = None, *, mask: Mask | None = None
) -> Belief:
    """Smoothed beliefs, by a second filter that runs backwards in time in information form.

    For linear models the result is that of `rts`. Others are linearised about the beliefs of the filter, the
    observations about the belief after them. Unlike `rts` it needs the observations, and never inverts a predicted
    covariance. The information of an exact observation is infinite: its noise must be positive definite. Where that is
    known only when it runs, beliefs of frames before one that is exact are NaN.

    Args:
        filter: Filter made by `kalman`, `extended_kalman`, `unscented_kalman` or `cubature_kalman`, of vectors.
        beliefs: The states that `jf.run` collects, time first.
        observations: Those of that run.
        inputs: Known inputs of that run, time first.
        mask: The mask of that run.

    Returns:
        The smoothed beliefs, time first; the last is that of the filter.

    Raises:
        ValueError: If `filter` is another kind of filter or its states are no vectors, shapes or lengths differ, or the
            observation noise has a variance of zero.
        TypeError: If `filter` is no filter, or `beliefs` are of another kind than its prior.

    Examples:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior = jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> filter = jf.kalman(prior, jnp.eye(1), 0.1 * jnp.eye(1), jnp.eye(1), jnp.eye(1))
        >>> _, (beliefs, infos) = jf.run(filter, jax.random.key(0), jnp.ones((5, 1)))
        >>> jf.smoothing.two_filter(filter, beliefs, jnp.ones((5, 1))).mean.shape
        (5, 1)
    """
    checks.is_filter("filter", filter)
    model = filter.params
    if not isinstance(model, Kalman | ExtendedKalman) or not model.manifold.flat:
        raise ValueError(
            "filter must be made by kalman, extended_kalman, unscented_kalman or cubature_kalman, and have vectors for "
            f"states; its parameters are {type(model).__name__}."
        )
    length = checks.beliefs("beliefs", beliefs, model.prior)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves((observations, inputs, mask))}
    if lengths != {(length,)}:
        raise ValueError(f"observations, inputs and mask must be as long as beliefs, {length}; got {sorted(lengths)}.")
    _check_noise(model, observations)
    return _two_filter(model, beliefs, observations, inputs, mask)


def _check_noise(model: Kalman | ExtendedKalman, observations: PyTree) -> None:
    """Raise an error where a component of the observation is known to have no noise."""
    has_own = isinstance(observations, Observation) and observations.noise is not None
    # Other noises are evaluated where it runs, or have linearisation errors added to them.
    is_added = isinstance(model, Kalman) or (
        model.linearize is taylor and not isinstance(model.observe, NonAdditiveNoise)
    )
    if has_own or not is_added or not hasattr(model.observation_noise, "shape"):
        return
    R = checks.concrete(model.observation_noise)
    if R is not None and not np.all(np.any(R != 0, axis=1)):
        row = int(np.argmin(np.any(R != 0, axis=1)))
        raise ValueError(
            "the observation noise of filter must be positive definite, because the information of an exact "
            f"observation is infinite; the variance of component {row} is 0. Use jf.smoothing.rts."
        )


@jax.jit
def _two_filter(model: Kalman | ExtendedKalman, beliefs: Belief, observations: PyTree, inputs: PyTree, mask) -> Belief:
    prior = model.prior
    if isinstance(prior, GaussianRoot):
        prior = GaussianRoot(prior.mean, linalg.tria(prior.root))
        assert isinstance(beliefs, GaussianRoot)
        beliefs = GaussianRoot(beliefs.mean, jax.vmap(linalg.tria)(beliefs.root))
    trajectory = jax.tree.map(lambda one, many: jnp.concatenate([one[None], many]), prior, beliefs)
    affine = affine_model(model, trajectory, observations, inputs, mask)

    def step(following: tuple[Array, Array], each: tuple[Belief, AffineModel]) -> tuple[tuple, Belief]:
        belief, frame = each
        smoothed = _combined(belief, *following)
        noise = factor.root(frame.Q) if isinstance(belief, Gaussian) else frame.Q
        root_Q = jnp.hstack([noise, frame.added_Q])
        return _before(frame, root_Q, *_observed(model, frame, *following)), smoothed

    n = prior.mean.size
    nothing = jnp.zeros(n, prior.mean.dtype), jnp.zeros((n, n), prior.mean.dtype)
    return jax.lax.scan(step, nothing, (beliefs, affine), reverse=True)[1]


def _observed(model, frame, eta, Z):
    """The information about a state, with that of the observation of its frame."""
    root_R = model.arithmetic.noise_root(frame.R, frame.read, frame.added_R)
    root_R, whitened = informative(root_R, jnp.where(frame.read[:, None], frame.H, 0.0))
    residual = linalg.solve_triangular(root_R, jnp.where(frame.read, frame.y - frame.d, 0.0))
    return eta + factor.apply(whitened.T, residual), linalg.tria(jnp.hstack([Z, whitened.T]))


def _before(frame, U, eta, Z):
    """The information about the state before a transition, from that about the state after it."""
    # With a root U of the noise, W = Z^T U: the noise is integrated out with I + W W^T = C C^T.
    W = linalg.matmul(Z.T, U)
    C = linalg.tria(jnp.hstack([factor.identity(len(Z), Z.dtype), W]))
    Z_after = linalg.solve_triangular(C, Z.T).T
    lost = linalg.solve_triangular(C, factor.apply(W, factor.apply(U.T, eta)))
    eta = eta - factor.apply(Z_after, lost)
    shift = factor.apply(Z_after, factor.apply(Z_after.T, frame.b))
    return factor.apply(frame.F.T, eta - shift), linalg.matmul(frame.F.T, Z_after)


def _combined(belief, eta, Z):
    """The belief of the filter with the information from later frames."""
    root = lower_root(belief)
    L = linalg.matmul(root.T, Z)
    C = linalg.tria(jnp.hstack([factor.identity(len(Z), Z.dtype), L]))
    after = linalg.solve_triangular(C, root.T).T
    surprise = eta - factor.apply(Z, factor.apply(Z.T, belief.mean))
    mean = belief.mean + factor.apply(after, factor.apply(after.T, surprise))
    if isinstance(belief, Gaussian):
        return Gaussian(mean, factor.outer(after, after))
    return GaussianRoot(mean, linalg.tria(after))
