"""Pose and deformation that fit the aligned landmarks best, with an honest covariance.

Each landmark is where the model puts it, moved by a small unknown amount in space (what registration got wrong, and
deformations that no mode describes), observed with the error that its alignment reports. One landmark's pictures in all
cameras share that unknown, so they are weighed together. Heavy tails (Student's t by iterated reweighting) keep a
hidden or mistaken landmark from pulling the head along.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float

from jaxfilters._full_precision import dot, einsum
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face.alignment import Alignment
from jaxfilters.models.face.patches import Slopes
from jaxfilters.models.face.rig import CameraRig, jacobian, project_shape
from jaxfilters.models.face.shape_model import FaceModel, shape

ITERATIONS = 5
DEGREES_OF_FREEDOM = 4.0
LEAST_SCORE = 0.5
"""Normalised correlation from which on an aligned patch counts as the landmark."""
PIXEL_FLOOR = 0.01
"""Standard deviation, pixels, that no alignment is better than: the grid on which grey values were sampled."""
MOST_DISTANCE = 9.0
"""Squared deviations a row beyond which a landmark is mistaken, and says nothing more about its place."""
COMMON_BIAS_PX = 0.004
"""Standard deviation, pixels, of what all landmarks of one image are off alike: interpolation favours some phases of
the grid, and the landmarks of two images share their phase of depth."""
UNSEEN = 1e4
"""Standard deviation, pixels, of a landmark that was not visible."""


class Refined(NamedTuple):
    """The fit to one frame."""

    belief: Gaussian
    """Of pose (mm, rad) and mode coefficients (mm): (6 + B,)."""
    log_evidence: Float[Array, ""]
    """log p of the aligned landmarks under the model, by Laplace's approximation."""
    excess: Float[Array, " K"]
    """Squared residual beyond what the alignment's error explains, mm^2 on each axis; may be negative."""
    alignment_variance: Float[Array, " K"]
    """Of the alignment's error, mm^2 on each axis; infinite where no camera sees the landmark."""
    trust: Float[Array, " K"]
    """Weight in the last iteration: about 1 for a landmark that fits, towards 0 for one that does not."""
    residual_scale: Float[Array, ""]
    """Squared errors of the alignments over what they claim, as this frame has it; 1 in the mean if they are right."""
    misfit_share: Float[Array, ""]
    """How far this frame can tell, 0 to 1: the share of the alignments' errors in what residuals are expected."""
    num_observed: Float[Array, ""]
    """Landmarks that at least one camera sees."""


def refine(
    prior: Gaussian,
    found: Alignment,
    slopes: Slopes,
    model: FaceModel,
    model_variance: Float[Array, "K 3 3"],
    rig: CameraRig,
    start: Float[Array, " n"],
    is_own: Bool[Array, "C K"] | None = None,
) -> Refined:
    """Posterior mode and its covariance.

    The covariance is the inverse of the expected information of Student's t (K. Lange, R. Little, J. Taylor, "Robust
    statistical modeling using the t distribution", 1989): `(nu + p) / (nu + p + 2)` of that of the last weights, for a
    landmark of p rows.

    Args:
        prior: Of pose and mode coefficients before the frame.
        found: Landmarks in the images.
        slopes: How the skin around them is inclined.
        model: Shape and modes.
        model_variance: Covariance of each landmark about the model, model frame, mm^2.
        rig: Cameras.
        start: Where the iteration begins.
        is_own: Landmarks whose covariances are those of alignments alone; all if none. Only these give the scale.
    """
    observed = found.observed & (found.score > LEAST_SCORE)
    precision = jnp.linalg.inv(prior.covariance)
    per_landmark = 2.0 * jnp.sum(observed, axis=0)

    def pieces(x):
        M = shape(model, x[6:])
        residual, H, S, by_shape = _rows(x, M, found, slopes, observed, model, model_variance, rig)
        distance = einsum("ki,ki->k", residual, _solve(S, residual))
        trust = (DEGREES_OF_FREEDOM + per_landmark) / (DEGREES_OF_FREEDOM + distance)
        return residual, H, S, by_shape, distance, trust

    def iterate(_, x):
        residual, H, S, _, _, trust = pieces(x)
        SH = _solve(S, H)
        gradient = einsum("k,kia,ki->a", trust, SH, residual) + dot(precision, prior.mean - x)
        return x + jnp.linalg.solve(precision + einsum("k,kia,kib->ab", trust, SH, H), gradient)

    x = jax.lax.fori_loop(0, ITERATIONS, iterate, start)
    residual, H, S, by_shape, distance, trust = pieces(x)
    SH = _solve(S, H)
    information = precision + einsum("k,kia,kib->ab", trust, SH, H)
    covariance = _covariance(precision, information, trust, per_landmark, SH, H)
    log_evidence = jnp.sum(_log_t(distance, per_landmark, S, observed)) + _laplace(
        x - prior.mean, precision, information
    )
    excess, alignment_variance = _excess(found, observed, residual, S, by_shape, x.size)
    own = jnp.where((observed if is_own is None else observed & is_own)[..., None, None], found.covariance, 0.0)
    residual_scale, share = _misfit(own, residual, S, SH, trust, information)
    return Refined(
        belief=Gaussian(x, covariance),
        log_evidence=log_evidence,
        excess=excess,
        alignment_variance=alignment_variance,
        trust=trust,
        residual_scale=residual_scale,
        misfit_share=share,
        num_observed=jnp.sum(per_landmark > 0).astype(x.dtype),
    )


def _laplace(off, precision, information):
    """What the prior and the width of the posterior add to the log evidence."""
    return 0.5 * (jnp.linalg.slogdet(precision)[1] - jnp.linalg.slogdet(information)[1] - dot(dot(off, precision), off))


def _covariance(precision, information, trust, per_landmark, SH, H):
    """Of the mode: inverse expected information, and a bias that is common to all landmarks of one image."""
    expected = trust * (DEGREES_OF_FREEDOM + per_landmark) / (DEGREES_OF_FREEDOM + per_landmark + 2)
    covariance = jnp.linalg.inv(precision + einsum("k,kia,kib->ab", expected, SH, H))
    by_bias = jnp.linalg.solve(information, einsum("k,kia->ai", trust, SH))
    covariance += dot(COMMON_BIAS_PX**2 * by_bias, by_bias.T)
    return 0.5 * (covariance + covariance.T)


def _misfit(own, residual, S, SH, trust, information):
    """Factor that the alignments' covariances `own` (C, K, 2, 2) lack, and how far the residuals can tell.

    Restricted maximum likelihood of a variance component (H. Patterson, R. Thompson, 1971): with `P` the inverse of S
    less what the fit has taken, `r^T S^-1 own S^-1 r / tr(P own)`.
    """
    C = own.shape[0]
    white = jnp.moveaxis(_solve(S, residual).reshape(-1, C, 2), 1, 0)
    square = einsum("k,cki,ckij,ckj->", trust, white, own, white)
    inverse = jnp.linalg.inv(S)
    block = lambda c: slice(2 * c, 2 * c + 2)
    blocks = jnp.stack([inverse[:, block(c), block(c)] for c in range(C)])
    expected = einsum("ckij,ckji->", blocks, own)
    by_rows = jnp.moveaxis(SH.reshape(-1, C, 2, SH.shape[-1]), 1, 0)
    taken = einsum("k,ckia,ckij,ckjb->ab", trust, by_rows, own, by_rows)
    left = expected - jnp.trace(jnp.linalg.solve(information, taken))
    rows = 2.0 * jnp.sum(own[..., 0, 0] > 0)
    return square / jnp.maximum(left, 0.1 * expected + 1e-6), expected / jnp.maximum(rows, 1.0)


def _excess(found, observed, residual, S, by_shape, size):
    """What residuals hold beyond the alignments' own errors, and these, spread over the axes of the model frame."""
    count = 2.0 * jnp.sum(observed)
    fitted = jnp.maximum(count / jnp.maximum(count - size, 2.0), 1.0)
    squares = jnp.minimum(jnp.sum(residual**2, axis=1), MOST_DISTANCE * jnp.trace(S, axis1=1, axis2=2))
    own = jnp.sum(jnp.where(observed[..., None], jnp.diagonal(found.covariance, axis1=2, axis2=3), 0.0), axis=(0, 2))
    reach = jnp.maximum(jnp.sum(jnp.where(observed[..., None, None], by_shape**2, 0.0), axis=(0, 2, 3)), 1e-6)
    is_observed = jnp.any(observed, axis=0)
    return jnp.where(is_observed, (fitted * squares - own) / reach, 0.0), jnp.where(is_observed, own / reach, jnp.inf)


def running_variance(
    variance: Float[Array, " K"],
    excess: Float[Array, " K"],
    alignment_variance: Float[Array, " K"],
    gain: float,
    limits: tuple[float, float],
) -> Float[Array, " K"]:
    """Variance of each landmark about the model after one more frame.

    A frame counts by its Fisher information about the variance `v`, which is that of a residual with a variance of
    `v + a` for an alignment's error of `a`: `(v / (v + a))^2` of what a perfect alignment would tell. A landmark that
    is followed at a loss of precision must not look as if it fitted the model perfectly.

    Args:
        variance: Before, mm^2.
        excess: Of the frame, as `Refined` has it.
        alignment_variance: The same.
        gain: Of a frame with perfect alignments.
        limits: Least and most.
    """
    likely = jnp.maximum(variance, excess)
    share = jnp.square(likely / (likely + alignment_variance))
    return jnp.clip(variance + gain * share * (excess - variance), *limits)


def displaced(
    x: Float[Array, " n"],
    found: Alignment,
    slopes: Slopes,
    model: FaceModel,
    model_variance: Float[Array, "K 3 3"],
    rig: CameraRig,
) -> Float[Array, "K 3"]:
    """Shape of which every landmark has moved from the model towards where it was found, as `model_variance` allows.

    The posterior mean of each landmark's place in the model frame, millimetres, for a pose and mode coefficients `x`.
    """
    observed = found.observed & (found.score > LEAST_SCORE)
    M = shape(model, x[6:])
    residual, _, S, by_shape = _rows(x, M, found, slopes, observed, model, model_variance, rig)
    stacked = jnp.moveaxis(by_shape, 1, 0).reshape(len(M), -1, 3)
    return M + einsum("kxy,kiy,ki->kx", model_variance, stacked, _solve(S, residual))


def _rows(x, M, found, slopes, observed, model, model_variance, rig):
    """Residuals (K, 2C), their derivatives by the state, their covariances, and the derivative by the shape."""
    C, K = observed.shape
    uv, _ = project_shape(rig, M, x[:6])
    by_shape, by_pose = jacobian(rig, M, x[:6])
    modes = model.basis.reshape(K, 3, -1)
    by_state = jnp.concatenate([by_pose, einsum("ckix,kxb->ckib", by_shape, modes)], axis=-1)
    mask = observed[..., None, None]
    by_state, by_shape = (jnp.where(mask, J, 0.0) for J in (by_state, by_shape))
    residual = jnp.where(observed[..., None], found.uv - uv, 0.0)
    noise = jnp.where(mask, found.covariance + PIXEL_FLOOR**2 * jnp.eye(2), UNSEEN**2 * jnp.eye(2))
    stacked = jnp.moveaxis(by_shape, 1, 0).reshape(K, 2 * C, 3)
    S = einsum("kix,kxy,kjy->kij", stacked, model_variance, stacked)
    inclined = jnp.moveaxis(jnp.where(mask, found.by_slope, 0.0), 1, 0).reshape(K, 2 * C, -1)
    S += einsum("kix,kxy,kjy->kij", inclined, slopes.covariance, inclined)
    for camera in range(C):
        rows = slice(2 * camera, 2 * camera + 2)
        S = S.at[:, rows, rows].add(noise[camera])
    return (
        jnp.moveaxis(residual, 1, 0).reshape(K, 2 * C),
        jnp.moveaxis(by_state, 1, 0).reshape(K, 2 * C, -1),
        S,
        by_shape,
    )


def _solve(S, b):
    return jnp.linalg.solve(S, b if b.ndim == 3 else b[..., None]).reshape(b.shape)


def _log_t(distance, size, S, observed):
    """Log density of Student's t over the observed rows; the others have a constant share of the determinant."""
    nu = DEGREES_OF_FREEDOM
    num_unobserved = 2.0 * jnp.sum(~observed, axis=0)
    log_det = jnp.linalg.slogdet(S)[1] - num_unobserved * 2 * math.log(UNSEEN)
    return (
        gammaln((nu + size) / 2)
        - gammaln(nu / 2)
        - 0.5 * size * math.log(nu * math.pi)
        - 0.5 * log_det
        - 0.5 * (nu + size) * jnp.log1p(distance / nu)
    )
