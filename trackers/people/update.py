"""What the silhouettes of each camera change in the beliefs about everybody."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfilters.gaussian.arithmetic import joseph
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.gaussian.consider import consider
from jaxfilters.trackers.people.fit import Fit, as_measurement
from jaxfilters.trackers.people.image_shift import displacement_by_shift, shift_sd
from jaxfilters.trackers.people.silhouette_bias import bias_factor
from jaxfilters.trackers.people.silhouettes import stature
from jaxfilters.trackers.people.state import BIAS, HEIGHT, PLACE, STATE, WIDTH, PeopleScene

WHOLE = 0.9
"""Share of the silhouette from which on a person's height is measured."""
_LEAST_HEIGHT_M = 0.5
LEAST_DT_S = 1e-3


def updated(
    scene: PeopleScene, predicted: Gaussian, fit: Fit, dt: Float[Array, ""]
) -> tuple[Gaussian, Float[Array, " slots"]]:
    """Beliefs after the readings in turn, and their mean normalised innovation squared.

    Args:
        scene: Cameras and constants.
        predicted: Beliefs of all slots.
        fit: What the images say.
        dt: Seconds since the frame before.
    """
    # What disagrees stays for seconds: as noise, it must be worth one look in two of its time constants.
    frames = 2 * scene.config.silhouette_bias_s / jnp.clip(dt, LEAST_DT_S, 2 * scene.config.silhouette_bias_s)
    readings = as_measurement(fit, scene.config.silhouette_sd_m)
    belief, nis = predicted, jnp.zeros(len(fit.score))
    for i in range(readings.y.shape[1]):
        mine = jax.tree.map(lambda leaf, i=i: leaf[:, i], readings)
        one = jax.vmap(lambda b, r, w, i=i: _of_one(scene, i, b, r, w, frames))
        belief, one_nis = one(belief, mine, fit.share_seen > WHOLE)
        nis += one_nis
    return belief, nis / jnp.maximum(jnp.sum(jnp.any(readings.observed, axis=-1), axis=-1), 1)


def _of_one(scene, camera, belief, reading, whole, frames):
    in_state = jnp.eye(STATE)[jnp.array(PLACE)]
    H = (reading.H @ in_state).at[:, HEIGHT].multiply(stature(belief.mean))
    H, R = H.at[:, BIAS].set(reading.H @ bias_factor(scene, belief.mean)), reading.R
    if camera:
        height = jnp.maximum(belief.mean[HEIGHT], _LEAST_HEIGHT_M)
        by_shift = displacement_by_shift(scene.cameras[camera], belief.mean[:2], height)
        loading = shift_sd(scene)[camera] * reading.H[:, :3] @ by_shift
        R += frames * loading @ loading.T
    after, info = joseph.update(belief, reading.y, H, R, mask=reading.observed)
    size = (jnp.arange(STATE) == HEIGHT) | (jnp.arange(STATE) == WIDTH)
    return jax.tree.map(lambda a, b: jnp.where(whole, a, b), after, consider(belief, after, size)), info.nis
