"""What faces of ten landmarks look like: plane patches with random waves around each landmark, before random waves.

Specification of the stereo head tracker, section 4.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.landmarks import MIRROR
from jaxfilters.typing import AnyKey

NUM_WAVES = 14
WAVELENGTHS_MM = (7.0, 22.0)
TEXTURE_RMS, WINDOW_MM = 40.0, 6.0
"""Grey levels before the Gaussian window, and the window's standard deviation."""
NUM_BACKGROUND_WAVES, BACKGROUND_AMPLITUDE, BACKGROUND_MEAN = 40, 5.0, 95.0
BACKGROUND_WAVELENGTHS_PX = (12.0, 120.0)
_COSINE = (0.999999989, -19.7392045, 64.9391159, -85.4501134, 60.1674298, -25.9668846, 6.52770596)
"""The cosine of an angle as a polynomial in the square of its turns from -1/2 to 1/2: Chebyshev's interpolation, whose
error is 1.1e-8."""
_RMS_REACH_MM = 3 * WINDOW_MM
_RIGHT = (0, 1, 4, 6, 8)
_SOURCE = np.array([_RIGHT.index(k if k in _RIGHT else MIRROR[k]) for k in range(len(MIRROR))])
_FLIP = np.array([(1.0 if k in _RIGHT else -1.0, 1.0) for k in range(len(MIRROR))])

_NORMAL_TABLE = np.array(
    [
        (-0.55, -0.05, -0.83),
        (-0.20, 0.00, -0.98),
        (0.20, 0.00, -0.98),
        (0.55, -0.05, -0.83),
        (-0.30, 0.10, -0.95),
        (0.30, 0.10, -0.95),
        (-0.25, 0.35, -0.90),
        (0.25, 0.35, -0.90),
        (-0.15, -0.20, -0.97),
        (0.15, -0.20, -0.97),
    ]
)
NORMALS = _NORMAL_TABLE / np.linalg.norm(_NORMAL_TABLE, axis=1, keepdims=True)
"""(10, 3) outward normals of the patches in the model frame."""


def _axes() -> np.ndarray:
    across = np.array([1.0, 0.0, 0.0]) - NORMALS[:, :1] * NORMALS
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.stack([across, np.cross(across, NORMALS)], axis=1)


AXES = _axes()
"""(10, 2, 3) directions of a patch's coordinates in its plane: the model's x laid into it, and the one downwards."""


@pytree_dataclass
class FaceTexture:
    """Sums of cosines in the coordinates of each patch."""

    wave: Float[Array, "10 waves 2"]
    """Wave vectors, radians per millimetre."""
    phase: Float[Array, "10 waves"]
    """Radians."""
    amplitude: Float[Array, " 10"]
    """Of every wave of a patch, grey levels."""


@pytree_dataclass
class FaceScene:
    """All that is visible besides shape and pose."""

    texture: FaceTexture
    background: Float[Array, "C rows cols"]
    """Grey levels behind the head in every camera."""


@compiled_quickly
def make_texture(key: AnyKey) -> FaceTexture:
    """Random texture, alike on both sides of the face.

    The rms is taken over the square of three standard deviations of the window to all sides.
    """
    lengths, orientations, phases = jax.random.split(key, 3)
    size = (len(_RIGHT), NUM_WAVES)
    number = 2 * math.pi / jax.random.uniform(lengths, size, minval=WAVELENGTHS_MM[0], maxval=WAVELENGTHS_MM[1])
    angle = jax.random.uniform(orientations, size, maxval=math.pi)
    right = number[..., None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    phase = jax.random.uniform(phases, size, maxval=2 * math.pi)
    place = jnp.arange(-_RMS_REACH_MM, _RMS_REACH_MM + 0.5)
    x, y = jnp.meshgrid(place, place)
    amplitude = jax.vmap(lambda w, p: TEXTURE_RMS / jnp.sqrt(jnp.mean(_waves(w, p, x, y) ** 2)))(right, phase)
    flip = jnp.asarray(_FLIP, right.dtype)
    return FaceTexture(right[_SOURCE] * flip[:, None], phase[_SOURCE], amplitude[_SOURCE])


@partial(compiled_quickly, static_argnums=1)
def make_background(key: AnyKey, shape: tuple[int, int]) -> Float[Array, "rows cols"]:
    """Random waves about a mean grey level, not clipped."""
    lengths, orientations, phases = jax.random.split(key, 3)
    size = (NUM_BACKGROUND_WAVES,)
    low, high = BACKGROUND_WAVELENGTHS_PX
    number = 2 * math.pi / jax.random.uniform(lengths, size, minval=low, maxval=high)
    angle = jax.random.uniform(orientations, size, maxval=2 * math.pi)
    phase = jax.random.uniform(phases, size, maxval=2 * math.pi)
    v, u = jnp.meshgrid(*(jnp.arange(n, dtype=float) for n in shape), indexing="ij")
    wave = number[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    return BACKGROUND_MEAN + BACKGROUND_AMPLITUDE * _waves(wave, phase, u, v)


def make_scene(key: AnyKey, shape: tuple[int, int], *, num_cameras: int = 2) -> FaceScene:
    """A texture, and a background of its own for each camera, whose images have `shape` (rows, columns)."""
    texture, background = jax.random.split(key)
    keys = jax.random.split(background, num_cameras)
    return FaceScene(make_texture(texture), jnp.stack([make_background(one, shape) for one in keys]))


def patch(
    wave: Float[Array, "waves 2"],
    phase: Float[Array, " waves"],
    amplitude: Float[Array, ""],
    x: Float[Array, "*places"],
    y: Float[Array, "*places"],
) -> Float[Array, "*places"]:
    """Grey levels that one landmark adds, window included, at places in its plane, millimetres from the landmark."""
    return amplitude * jnp.exp(-0.5 * (x**2 + y**2) / WINDOW_MM**2) * _waves(wave, phase, x, y)


def _waves(wave, phase, x, y):
    # Written out so that XLA makes one loop over the places of it.
    return sum(_cosine(wave[j, 0] * x + wave[j, 1] * y + phase[j]) for j in range(wave.shape[0]))


def _cosine(angle: Float[Array, "*places"]) -> Float[Array, "*places"]:
    """As `jnp.cos`, which is not vectorised on a CPU, in a sixth of its time; to the rounding of `angle` and 1e-6."""
    turns = angle * (0.5 / math.pi)
    squared = (turns - jnp.round(turns)) ** 2
    result = jnp.full_like(squared, _COSINE[-1])
    for coefficient in _COSINE[-2::-1]:
        result = result * squared + coefficient
    return result
