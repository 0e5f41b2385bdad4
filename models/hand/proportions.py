"""One person's hand: an average hand, its lengths and radii multiplied, and what depth images of it say of these."""

import math
from dataclasses import field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters import fit
from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.limits import limit_log_likelihood
from jaxfilters.models.hand.skeleton import HandGeometry, forward_kinematics, retract
from jaxfilters.models.rendering.depth import render_capsules
from jaxfilters.models.rendering.silhouette import soft_silhouette

DEPTH_SPAN = 0.28
"""Metres of depth in which a reading near the hand may lie, if it is not of the surface that is rendered there."""
SPREAD = 0.1
"""Standard deviation of the logarithm of each proportion over adults."""


class HandProportions(NamedTuple):
    """Factors on an average hand; positive."""

    palm: Float[Array, ""]
    """On the places of the wrist ends and the first joints."""
    digits: Float[Array, "5"]
    """On the lengths of thumb, index, middle, ring and little finger."""
    thickness: Float[Array, ""]
    """On all radii."""

    def of(self, average: HandGeometry) -> HandGeometry:
        """The hand with these proportions."""
        return replace(
            average,
            bases=average.bases * self.palm,
            metacarpal_starts=average.metacarpal_starts * self.palm,
            lengths=average.lengths * self.digits[:, None],
            radii=average.radii * self.thickness,
            metacarpal_radius=average.metacarpal_radius * self.thickness,
        )


class HandStills(NamedTuple):
    """The parameters to estimate from some depth images of one hand in different poses."""

    proportions: HandProportions
    noise: Float[Array, ""]
    """Standard deviation of a reading about the rendered depth, metres: the sensor's, and what the model lacks."""
    steps: Float[Array, "f 21"]
    """From the pose where each image's search began, in the tangent space there, in units of `pose_spread`."""


@pytree_dataclass
class StillsDensity:
    r"""Log posterior of `HandStills`, through the renderer.

    A pixel that shows a hand at depth d, where a fraction $\alpha$ of it is covered by the model at depth z, has the
    density $(1 - \epsilon) [\beta N(d; z, \sigma^2) + (\alpha - \beta) / L] + \epsilon / L$ with
    $\beta = \max(0, 2 \alpha - 1)$, one of the background has the probability $1 - (1 - \epsilon) \alpha$; L is
    `DEPTH_SPAN`. The coverage is smooth across outlines, so that they pull on pose and size as well as depths do; the
    depth counts within the outline alone, where there is one, and more the further in.
    """

    average: HandGeometry
    cameras: Pinhole
    """Of the windows, leaves (f, ...)."""
    observed: Float[Array, "..."]
    """(f, rows, cols) metres; `inf` background, NaN says nothing."""
    starts: Float[Array, "..."]
    """(f, 22) poses."""
    pose_spread: Float[Array, "..."]
    """(21,) standard deviations of the prior on the steps."""
    softness: float | Float[Array, ""] = 0.5
    """Pixels over which coverage falls across an outline: the larger, the farther outlines pull."""
    outlier_share: float = field(default=0.05, metadata={"static": True})
    pixel_worth: float = field(default=0.1, metadata={"static": True})
    """How many independent readings a pixel is worth: errors of neighbours are alike."""

    def __call__(self, theta: HandStills) -> Float[Array, ""]:
        hand = theta.proportions.of(self.average)

        def image(camera: Pinhole, observed: Array, start: Array, step: Array) -> Array:
            pose = retract(start, self.pose_spread * step)
            limits = limit_log_likelihood(pose[7:])
            prior = -0.5 * jnp.sum(step**2)
            return self.pixel_worth * self.pixels(camera, observed, hand, pose, theta.noise) + limits + prior

        images = jax.vmap(image)(self.cameras, self.observed, self.starts, theta.steps)
        usual = sum(jnp.sum((jnp.log(factor) / SPREAD) ** 2) for factor in theta.proportions)
        return jnp.sum(images) - 0.5 * usual

    def pixels(
        self, camera: Pinhole, observed: Float[Array, "rows cols"], hand: HandGeometry, pose: Array, noise: Array
    ) -> Float[Array, ""]:
        """Log-likelihood of all pixels of one image."""
        capsules = forward_kinematics(pose, hand).capsules
        covered = soft_silhouette(camera, capsules, softness=self.softness)
        depth = render_capsules(camera, capsules)
        is_hand, is_hit = jnp.isfinite(observed), jnp.isfinite(depth)
        gap = jnp.where(is_hand & is_hit, jnp.where(is_hand, observed, 0.0) - jnp.where(is_hit, depth, 0.0), 0.0)
        matches = -0.5 * (gap / noise) ** 2 - jnp.log(noise) - 0.5 * math.log(2 * math.pi)
        within = jnp.where(is_hit, jnp.maximum(0.0, 2 * covered - 1), 0.0) * (1 - self.outlier_share)
        anywhere = ((1 - self.outlier_share) * covered - within + self.outlier_share) / DEPTH_SPAN
        log_within = jnp.where(within > 0, jnp.log(jnp.where(within > 0, within, 1.0)), -jnp.inf)
        of_hand = jnp.logaddexp(jnp.where(within > 0, log_within + matches, -jnp.inf), jnp.log(anywhere))
        of_background = jnp.log1p(-covered * (1 - self.outlier_share))
        return jnp.sum(jnp.where(is_hand, of_hand, jnp.where(jnp.isposinf(observed), of_background, 0.0)))


SOFTENING = (3.0, 1.0, 0.5, 0.25, 0.12)
"""Pixels of softness in turn: first outlines pull from afar, at last coverage has no part in the thickness."""


def learn(
    density: StillsDensity, theta: HandStills, constraints: HandStills, *, method: Any, errors: Any = fit.no_errors
) -> fit.Fit:
    """`HandStills` at a maximum of their density, each stage of `SOFTENING` from where the one before ended.

    Args:
        density: Of the images; its softness is replaced.
        theta: Where to start.
        constraints: As for `jaxfilters.fit.maximize`; `fit.fixed` for proportions that are known.
        method: As there; `fit.adam(0.03)` serves: depth jumps where one finger hides another.
        errors: As there, of the last stage.
    """
    for softness in SOFTENING[:-1]:
        stage = replace(density, softness=jnp.asarray(softness))
        theta = fit.maximize(stage, theta, constraints, method=method, errors=fit.no_errors).theta
    last = replace(density, softness=jnp.asarray(SOFTENING[-1]))
    return fit.maximize(last, theta, constraints, method=method, errors=errors)
