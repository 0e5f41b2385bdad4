"""What a real depth sensor makes of a rendered image: noise, flying pixels, dropouts, whole millimetres."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt16

from jaxfilters._struct import pytree_dataclass
from jaxfilters.typing import AnyKey


# Numbers may be traced, so the fields are not checked at run time.
@pytree_dataclass
class DepthSensor:
    """Flaws of a time-of-flight camera; the defaults are Gaussian noise alone."""

    noise_std: float = 0.002
    """Standard deviation of the depth, metres; the background has it too."""
    background: float = 3.0
    """Depth of the wall behind everything, metres."""
    flying_fraction: float = 0.0
    """Share of the silhouette's edge pixels that read a depth between object and background."""
    dropout_fraction: float = 0.0
    """Share of all pixels without a reading."""

    def sense(self, key: AnyKey, rendered: Float[Array, "rows cols"]) -> UInt16[Array, "rows cols"]:
        """Sensor image in millimetres, 0 = no reading, of a rendered one in metres with `inf` for nothing there."""
        noise_key, flying_key, depth_key, dropout_key = jax.random.split(key, 4)
        shape, dtype = rendered.shape, rendered.dtype
        depth = jnp.where(jnp.isfinite(rendered), rendered, self.background)
        flying = silhouette_edge(rendered) & jax.random.bernoulli(flying_key, self.flying_fraction, shape)
        mixture = jax.random.uniform(depth_key, shape, dtype)
        depth = jnp.where(flying, depth + mixture * (self.background - depth), depth)
        depth = depth + self.noise_std * jax.random.normal(noise_key, shape, dtype)
        dropped = jax.random.bernoulli(dropout_key, self.dropout_fraction, shape)
        return jnp.where(dropped, 0, jnp.clip(jnp.round(1000 * depth), 0, 65535)).astype(jnp.uint16)


def silhouette_edge(rendered: Float[Array, "rows cols"]) -> Bool[Array, "rows cols"]:
    """Object pixels with background among their four neighbours; nothing beyond the border counts as background."""
    empty = jnp.pad(jnp.isinf(rendered), 1, constant_values=False)
    beside = empty[:-2, 1:-1] | empty[2:, 1:-1] | empty[1:-1, :-2] | empty[1:-1, 2:]
    return jnp.isfinite(rendered) & beside


def depth_from_millimetres(depth_mm: UInt16[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Metres, NaN where the sensor has no reading (0)."""
    return jnp.where(depth_mm > 0, depth_mm / jnp.asarray(1000.0), jnp.nan)
