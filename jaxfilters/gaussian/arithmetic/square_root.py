"""Kalman filter atoms on roots of covariances: orthogonal transformations only, no subtraction anywhere.

Roots may have any width: `root root^T` is the covariance.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters._xla.last_axis import batch_last
from jaxfilters._xla.one_or_many import one_or_many
from jaxfilters.gaussian.arithmetic import factor, info
from jaxfilters.gaussian.belief import GaussianRoot
from jaxfilters.math import linalg

Belief = GaussianRoot


def predict(
    belief: GaussianRoot,
    F: Float[Array, "k n"],
    root_Q: Float[Array, "k _"],
    b: Float[Array, " k"] | float = 0.0,
    added_root: Float[Array, "k _"] | None = None,
) -> GaussianRoot:
    """Belief in `x' = F x + b + root_Q q`, q ~ N(0, I); `added_root` is a root of more noise.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> belief, one = jf.GaussianRoot(jnp.ones(1), 3.0 * jnp.eye(1)), jnp.eye(1)
        >>> ahead = jf.arithmetic.square_root.predict(belief, one, 4.0 * one)
        >>> print(ahead.mean, abs(ahead.root).round(3))
        [1.] [[5.]]
    """
    parts = [linalg.matmul(F, belief.root), root_Q, *([] if added_root is None else [added_root])]
    return GaussianRoot(factor.apply(F, belief.mean) + b, linalg.tria(jnp.hstack(parts)))


def update(
    belief: GaussianRoot,
    y: Float[Array, " m"],
    H: Float[Array, "m n"],
    root_R: Float[Array, "m _"],
    y_hat: Float[Array, " m"] | None = None,
    mask: Bool[Array, " m"] | None = None,
    added_root: Float[Array, "m _"] | None = None,
) -> tuple[GaussianRoot, info.KalmanInfo]:
    """Belief after the observation `y = y_hat + H (x - mean) + root_R r`, r ~ N(0, I), and its diagnostics.

    `y_hat` is `H mean` unless given; for a nonlinear observation it is the predicted one, and H its Jacobian.
    `added_root` is a root of more noise. Components where `mask` is False have no effect, whatever `y`, `y_hat` and the
    rows of `H`, `root_R` and `added_root` hold, NaN included. Neither have those that the diagnostics count as invalid
    or deficient.

    The array algorithm of T. Kailath, A. Sayed, B. Hassibi, "Linear Estimation", 2000, section 12.3. The root is not
    triangular; it is as wide as that of `belief`, or square if that is wider.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> prior, one = jf.GaussianRoot(jnp.zeros(1), jnp.eye(1)), jnp.eye(1)
        >>> posterior, info = jf.arithmetic.square_root.update(prior, jnp.array([2.0]), one, one)
        >>> print(posterior.mean.round(3), (posterior.root @ posterior.root.T).round(3))
        [1.] [[0.5]]
    """
    noise = info.observed(mask, root_R if added_root is None else jnp.hstack([root_R, added_root]))
    usable = info.rows(belief.mean, y, H, noise, y_hat, mask)
    noise = info.observed(usable.observed, noise)
    visible = linalg.matmul(info.observed(usable.observed, H), belief.root)
    root, cross, posterior = _conditioned(visible, noise, belief.root)
    # Rows are finite: what is not is the belief.
    sound = jnp.all(jnp.isfinite(root))
    root = jnp.where(sound, root, 0.0)
    whitened = linalg.solve_triangular(root, usable.deviation)
    posterior = GaussianRoot(belief.mean + factor.apply(cross, whitened), posterior)
    counts = factor.diagonal(root) > 0
    log_density, nis = info.evidence(jnp.where(counts, factor.diagonal(root), 1.0), counts, whitened)
    found = info.Evidence(jnp.where(sound, log_density, -jnp.inf), nis)
    return posterior, info.report(usable, root, found)


def rts(
    belief: GaussianRoot,
    following: GaussianRoot,
    F: Float[Array, "k n"],
    root_Q: Float[Array, "k _"],
    b: Float[Array, " k"] | float = 0.0,
    added_root: Float[Array, "k _"] | None = None,
) -> GaussianRoot:
    """Belief given the future too, from `following`, that of the next step given the same.

    The next step is `x' = F x + b + root_Q q`, q ~ N(0, I). Once x' is known, x has the covariance of an update that
    measured x'; what is not known of x' comes on top (H. Rauch, F. Tung, C. Striebel, "Maximum likelihood estimates of
    linear dynamic systems", AIAA J. 3(8), 1965).

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> earlier, later = jf.GaussianRoot(jnp.zeros(1), one), jf.GaussianRoot(jnp.ones(1), 0.5 * one)
        >>> smoothed = jf.arithmetic.square_root.rts(earlier, later, one, 0.0 * one)
        >>> print(smoothed.mean.round(3), (smoothed.root @ smoothed.root.T).round(3))
        [1.] [[0.25]]
    """
    noise = root_Q if added_root is None else jnp.hstack([root_Q, added_root])
    root, cross, known = _conditioned(linalg.matmul(F, belief.root), noise, belief.root)
    gain = linalg.solve_triangular(root, cross.T, transpose=True).T
    mean = belief.mean + factor.apply(gain, following.mean - factor.apply(F, belief.mean) - b)
    return GaussianRoot(mean, linalg.tria(jnp.hstack([known, linalg.matmul(gain, following.root)])))


def backward(
    belief: GaussianRoot,
    F: Float[Array, "k n"],
    root_Q: Float[Array, "k _"],
    b: Float[Array, " k"] | float = 0.0,
    added_root: Float[Array, "k _"] | None = None,
) -> tuple[Float[Array, "n k"], GaussianRoot]:
    """State given the next one, x': the gain G and the belief N(g, C), so that x is N(g + G x', C).

    The next step is `x' = F x + b + root_Q q`, q ~ N(0, I), as for `rts`.

    Examples:
        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> one = jnp.eye(1)
        >>> gain, rest = jf.arithmetic.square_root.backward(jf.GaussianRoot(jnp.zeros(1), one), one, one)
        >>> print(gain.round(3), (rest.root @ rest.root.T).round(3))
        [[0.5]] [[0.5]]
    """
    noise = root_Q if added_root is None else jnp.hstack([root_Q, added_root])
    root, cross, known = _conditioned(linalg.matmul(F, belief.root), noise, belief.root)
    gain = linalg.solve_triangular(root, cross.T, transpose=True).T
    return gain, GaussianRoot(belief.mean - factor.apply(gain, factor.apply(F, belief.mean) + b), known)


def noise_root(
    root_R: Float[Array, "m _"], mask: Bool[Array, " m"] | None = None, added_root: Float[Array, "m _"] | None = None
) -> Float[Array, "m m"]:
    """Lower root of the noise and of what is added to it by a root, zero where masked.

    Examples:
        The second component is masked.

        >>> import jax.numpy as jnp
        >>> import jaxfilters as jf
        >>> print(jf.arithmetic.square_root.noise_root(2.0 * jnp.eye(2), jnp.array([True, False])))
        [[2. 0.]
         [0. 0.]]
    """
    return linalg.tria(info.observed(mask, root_R if added_root is None else jnp.hstack([root_R, added_root])))


def _conditioned(measured, noise, state):
    """Lower root of the innovation covariance, cross-covariance over it, root of the posterior.

    `measured` and `state` are the measurement's and the state's share in the same random numbers. A row of the
    measurement that depends on those before it gets zeros in the innovation's root.
    """
    m, n = measured.shape[0], state.shape[0]
    if noise.shape[1] != m:
        noise = linalg.tria(noise)
    state = jnp.pad(state, ((0, 0), (0, max(0, n - state.shape[1]))))
    measured = jnp.pad(measured, ((0, 0), (0, state.shape[1] - measured.shape[1])))
    return _triangular(jnp.hstack([measured, noise]), jnp.pad(state, ((0, 0), (0, m))))


def _triangular_one(V, G):
    return _repaired(V, G, *_reflected(V, G)[:3])


def _repaired(V, G, root, *found):
    return jax.lax.cond(jnp.all(_independent(root)), _sound, _deficient, V, G, root, *found)


def _triangular_many(V, G):
    # Most batches have no deficient element, and `vmap` of a condition computes both sides.
    found = jax.vmap(_reflected)(V, G)[:3]
    independent = jax.vmap(batch_last(_independent))(found[0])
    return jax.lax.cond(jnp.all(independent), _sound, jax.vmap(_repaired), V, G, *found)


def _sound(_V, _G, root, cross, posterior):
    return root, cross, posterior


def _deficient(V, G, *_):
    # A reflection was spent on a row that needs none, and hid a direction of the state.
    root, cross, posterior = _ordered(V, G)
    width = G.shape[1] - V.shape[0]
    return root, cross, jnp.pad(posterior, ((0, 0), (0, width - posterior.shape[1])))


def _independent(root):
    tolerance = 4 * root.shape[0] * float(jnp.finfo(root.dtype).eps)
    return jnp.diagonal(root) > tolerance * linalg.safe_norm(root)


def _ordered(V, G):
    m = V.shape[0]
    keep = _independent(linalg.tria(V))
    joint = linalg.tria(jnp.vstack([info.observed(keep, V), G]))
    return joint[:m, :m], joint[m:, :m], joint[m:, m:]


def _reflected_one(V, G):
    m, width = V.shape
    packed, scales = jnp.linalg.qr(V.T, mode="raw")
    packed = packed.T
    turned = jax.lax.linalg.ormqr(packed, scales, G.T, transpose=True).T
    rest = jax.lax.linalg.ormqr(packed, scales, jnp.eye(width, dtype=V.dtype)[:, m:])
    return *linalg.with_positive_diagonal(packed[:m].T, turned[:, :m]), turned[:, m:], rest


def _reflected_small(V, G):
    m, width = V.shape
    L, turned, Q = linalg.reflected(m, V, G, jnp.eye(width, dtype=V.dtype))
    return *linalg.with_positive_diagonal(L[:, :m], turned[:, :m]), turned[:, m:], Q[:, m:]


def _reflected_many(V, G):
    if linalg.is_small(*V.shape[1:]):
        return jax.vmap(batch_last(_reflected_small))(V, G)
    return jax.lax.map(lambda one: _reflect(*one), (V, G))


_reflect = one_or_many(_reflected_one, _reflected_many)


_triangular = one_or_many(_triangular_one, _triangular_many)


@jax.custom_jvp
def _reflected(V, G):
    # One reflection a row of V, and none for the state: its root need not be triangular.
    return _reflect(V, G)


@_reflected.defjvp
def _reflected_jvp(primals, tangents):
    # With Q = [first rest], [V; G] Q = [L 0; C D]. For every skew W, dQ = Q W gives a change of the right side with the
    # right outer product; the W taken keeps L lower and the zero block zero.
    (V, G), (dV, dG) = primals, tangents
    L, C, D, rest = _reflected(V, G)
    independent = jnp.where(_independent(L)[:, None], L, jnp.eye(L.shape[0], dtype=L.dtype))
    solve = partial(linalg.solve_triangular, independent)
    first = solve(V).T
    turned = linalg.matmul(dV, first)
    upper = jnp.triu(solve(turned), 1)
    skew = upper.T - upper
    dL = jnp.tril(turned + linalg.matmul(L, skew))
    unseen = G - factor.outer(C, first)
    dC = linalg.matmul(dG, first) + linalg.matmul(C, skew) + solve(factor.outer(dV, unseen)).T
    hidden = solve(linalg.matmul(dV, rest))
    dD = linalg.matmul(dG, rest) - linalg.matmul(C, hidden)
    return (L, C, D, rest), (dL, dC, dD, -linalg.matmul(first, hidden))
