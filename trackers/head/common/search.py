"""The particle filter that finds the head again in every frame, near where it was headed."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.from_host import from_host
from jaxfilters.filter import Filter
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.math import diffusion
from jaxfilters.math.diffusion import DiffusionFit
from jaxfilters.models.face.correlation import score_points
from jaxfilters.models.face.landmarks import NUM_LANDMARKS
from jaxfilters.models.face.likelihood import log_weights, scores
from jaxfilters.models.face.patches import SIZE
from jaxfilters.models.face.rig import CameraRig, project_shape
from jaxfilters.models.face.shape_model import FaceModel, rigid, shape
from jaxfilters.particle.adaptive import AdaptiveDiffusionState, adaptive_diffusion
from jaxfilters.particle.partitioned import Partitions, consecutive
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.state import NUM_MODES, POSE, UNITS
from jaxfilters.typing import AnyKey

KAPPA = 0.5
"""Diffusion of the mode coefficients in their standard deviations."""
LEAST_DEVIATION = 0.3
"""Millimetres: of a mode."""
LOW = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 0.1]) * UNITS
HIGH = np.array([40.0, 40.0, 40.0, 15.0, 15.0, 15.0]) * UNITS
"""Limits of the diffusion a frame."""
LEAST_STEPS = 0.1
"""Frame times between two images from which on they tell a velocity."""
MODE_SCALE = 5.0
"""Millimetres and degrees that count as one in the distance to the particle of the highest weight."""


@pytree_dataclass
class FaceLikelihood:
    """How well particles of pose and mode coefficients explain images (Oka and Sato 2006, equations 16 and 17)."""

    model: FaceModel
    templates: Float[Array, "C K T T"]
    rig: CameraRig
    sigma: float | Float[Array, ""] = 3.0
    """Standard deviation of the sum of the scores."""

    def __call__(
        self, particles: Float[Array, "d n"], images: Num[Array, "C rows cols"], inputs: Array | None = None
    ) -> Float[Array, " n"]:
        """Log weights; the inputs, which are the time since the last frame, do not matter."""
        del inputs

        def project(x: Array) -> Array:
            return project_shape(self.rig, shape(self.model, x[POSE:]), x[:POSE])[0]

        uv = jax.vmap(project, in_axes=-1, out_axes=-1)(particles)
        found = scores(images, self.templates, uv)
        total, size = jnp.sum(found, axis=(0, 1)), found.shape[0] * found.shape[1]
        return log_weights(total, particles[POSE:], self.model.deviation, num_scores=size, sigma=self.sigma)


class Searches(NamedTuple):
    """The filters whose state is `HeadState.search`, for no face yet: `at` fits them to the model of the day."""

    rigid: Filter
    layered: Filter
    """Half of the particles move in the pose, half in the deformation (Sugano 2007, section 3.3.2)."""


def searches(rig: CameraRig, options: HeadConfig) -> Searches:
    """The filters for a rig."""
    templates = jnp.zeros((rig.num_cameras, NUM_LANDMARKS, SIZE, SIZE))
    nobody = rigid(jnp.zeros((NUM_LANDMARKS, 3)), templates, num_modes=NUM_MODES)
    build = partial(
        adaptive_diffusion,
        _no_prior,
        FaceLikelihood(nobody, templates, rig),
        first_diffusion(options),
        num_particles=options.num_particles,
        mode_scale=from_host([*(MODE_SCALE * UNITS), *[LEAST_DEVIATION] * NUM_MODES]),
        steady_std=jnp.zeros(NUM_MODES),
        low=from_host(LOW),
        high=from_host(HIGH),
        update_fit=diffusion.update if options.diffusion == "online" else diffusion.fixed,
    )
    return Searches(build(), build(partitions=Partitions(consecutive(POSE, NUM_MODES))))


def first_diffusion(options: HeadConfig) -> DiffusionFit:
    """`A = I` and a unit of each coordinate a frame; no `A` if it is fixed."""
    # Its arguments are checked by value, also where a caller is being traced.
    with jax.ensure_compile_time_eval():
        scale = from_host(UNITS)
        if options.diffusion == "fixed":
            return diffusion.start(scale, slope=0.0, offset=options.fixed_diffusion)
        return diffusion.start(scale)


def at(filter: Filter, model: FaceModel, templates: Array, deviation: Array) -> Filter:
    """The filter for a model that has changed, with noise of the mode coefficients of `KAPPA deviation`."""
    params = filter.params
    likelihood = replace(params.log_likelihood, model=model, templates=templates)
    floor = jnp.maximum(model.deviation, LEAST_DEVIATION)
    return replace(
        filter,
        params=replace(
            params,
            log_likelihood=likelihood,
            steady_std=KAPPA * deviation,
            mode_scale=params.mode_scale.at[POSE:].set(floor),
        ),
    )


def gathered(search: AdaptiveDiffusionState, x: Float[Array, " d"]) -> AdaptiveDiffusionState:
    """All particles at one place."""
    particles = jnp.broadcast_to(x[:, None], search.particles.shape)
    return search._replace(particles=particles, log_weights=weights.uniform(particles.shape[1], particles.dtype))


def scattered(
    key: AnyKey, search: AdaptiveDiffusionState, x: Float[Array, " d"], deviation: Float[Array, " 6"]
) -> tuple[AdaptiveDiffusionState, Gaussian]:
    """Particles and belief about a state at rest whose pose has these standard deviations.

    Args:
        key: Random key.
        search: Before.
        x: Pose and mode coefficients.
        deviation: Of the pose, millimetres and radians.
    """
    width = jnp.zeros_like(x).at[:POSE].set(deviation)
    search = gathered(search, x)
    noise = jax.random.normal(key, search.particles.shape, search.particles.dtype)
    search = search._replace(
        particles=search.particles + width[:, None] * noise, estimate=x, velocity=jnp.zeros_like(search.velocity)
    )
    return search, Gaussian(x, jnp.diag(width**2) + 1e-4 * jnp.eye(len(width), dtype=width.dtype))


def start(x: Float[Array, " d"], options: HeadConfig, fit: DiffusionFit | None = None) -> AdaptiveDiffusionState:
    """The state at registration: the place is known, and counts as the first estimate.

    Args:
        x: Pose and mode coefficients.
        options: Constants.
        fit: The diffusion; that of the options if none.
    """
    n = options.num_particles
    return AdaptiveDiffusionState(
        particles=jnp.broadcast_to(x[:, None], (x.size, n)),
        log_weights=weights.uniform(n, x.dtype),
        ancestors=jnp.arange(n, dtype=jnp.int32),
        spread=jnp.zeros_like(x),
        estimate=x,
        velocity=jnp.zeros(POSE, x.dtype),
        elapsed=jnp.zeros((), x.dtype),
        num_estimates=jnp.ones((), jnp.int32),
        fit=first_diffusion(options) if fit is None else fit,
    )


def score_at(
    model: FaceModel, templates: Float[Array, "C K T T"], rig: CameraRig, x: Float[Array, " d"], images: Array
) -> Float[Array, ""]:
    """Mean correlation of the templates at one state, -1 where a window leaves the image; flat ones do not count."""
    uv, _ = project_shape(rig, shape(model, x[POSE:]), x[:POSE])

    at_one = lambda image, template, point: score_points(image, template, point[None])[0]
    found = jax.vmap(jax.vmap(at_one, (None, 0, 0)))(images, templates, uv)
    is_visible = jnp.max(templates, axis=(2, 3)) > jnp.min(templates, axis=(2, 3))
    return jnp.sum(jnp.where(is_visible, found, 0.0)) / jnp.maximum(jnp.sum(is_visible), 1)


def _no_prior(key: AnyKey) -> Array:
    """Stands where a filter wants a prior: this one starts where the face was registered."""
    del key
    return jnp.zeros(POSE + NUM_MODES)
