"""How well the size of a face follows from its shape alone, which is all that one camera shows of an unknown person."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.synthetic.face import Identity, make_identity

NUM_PEOPLE = 20_000
"""Of the generator, from whom the regression is estimated."""


def size_errors(shapes: Float[np.ndarray, "n K 3"]) -> Float[np.ndarray, " n"]:
    """Relative errors of the sizes of neutral faces by linear regression on their exact shapes.

    The same as relative errors of the depth: a face that is taken for larger is taken for farther away. What a tracker
    sees is less than this, a shape with errors; what it knows is less, too, a few hundred faces.

    Args:
        shapes: Millimetres.
    """
    people: Callable[[Array], Identity] = jax.vmap(make_identity)
    known = np.asarray(people(jax.random.split(jax.random.key(5), NUM_PEOPLE)).neutral, float)
    features, log_sizes = _apart(known)
    coefficients = np.linalg.lstsq(features, log_sizes, rcond=None)[0]
    features, log_sizes = _apart(np.asarray(shapes, float))
    return np.expm1(features @ coefficients - log_sizes)


def _apart(shapes: Float[np.ndarray, "n K 3"]) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"]]:
    """Shapes of size one as rows of features, and the logarithms of their sizes."""
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    sizes = np.linalg.norm(centred, axis=(1, 2))
    flat = (centred / sizes[:, None, None]).reshape(len(shapes), -1)
    return np.column_stack([np.ones(len(shapes)), flat]), np.log(sizes)
