"""The focal length of a camera that nobody knows, from the frames that a face was adjusted to.

A wide angle shows a near face with more perspective than a long focal length shows a far one. That is little: nose and
eyes differ by a tenth of a face's distance, and a face that is a little flatter looks the same. So the answer is a
distribution, and often that the images do not tell.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.bundle import Bundle
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.recognition import weighed
from jaxfilters.trackers.head.mono.state import MonoState

LOG_STD = 0.3
"""Of the logarithm of a focal length about the given one, whatever is known of that: as wide as among cameras."""
FACTORS = np.exp(np.linspace(-2.5, 2.5, 21) * LOG_STD)
"""Of the assumed focal length that are tried."""
DETERMINED = 0.5
"""Share of `LOG_STD` below which the images are said to tell the focal length."""


class FocalLength(NamedTuple):
    """What the images say."""

    factor: Float[Array, ""]
    """Mean of the focal length over the assumed one."""
    log_std: Float[Array, ""]
    """Standard deviation of its logarithm."""

    @property
    def is_determined(self) -> bool:
        """Whether the images tell much more than what is assumed of cameras."""
        return bool(self.log_std < DETERMINED * LOG_STD)


@partial(compiled_quickly, static_argnames="options")
def focal_length(
    unknown: MultilinearFace, face: MultilinearFace, rig: CameraRig, state: MonoState, options: MonoConfig
) -> FocalLength:
    """The focal length by the evidence of the window's frames, of which each is tried with all others anew.

    Args:
        unknown: The model, which is the face of an unknown person.
        face: Whom the state is about: the same, or an enrolled person.
        rig: One camera, with the assumed focal length.
        state: Its window holds heads turned several ways; what they tell of the focal length grows with that.
        options: Constants.
    """
    window = state.window

    def log_evidence(factor: Array) -> Array:
        start = Bundle(window.poses.at[:, 2].multiply(factor), window.expressions, state.person)
        camera = replace(rig, focal=rig.focal * factor)
        return weighed(unknown, face, camera, state, start, options)[1]

    logs = jnp.log(jnp.asarray(FACTORS, window.poses.dtype))
    # One by one: batches of factorisations can stand still on two cores.
    found = jax.lax.map(log_evidence, jnp.exp(logs)) - 0.5 * jnp.square(logs / LOG_STD)
    shares = jax.nn.softmax(jnp.where(jnp.isfinite(found), found, -jnp.inf))
    mean = jnp.sum(shares * logs)
    return FocalLength(jnp.exp(mean), jnp.sqrt(jnp.sum(shares * jnp.square(logs - mean))))
