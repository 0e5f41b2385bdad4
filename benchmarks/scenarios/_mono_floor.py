"""How well the size of a face follows from its shape alone, which is all that one camera shows of an unknown person."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.synthetic.face import Identity, make_identity
from jaxfilters.models.synthetic.ict_face import read_ict

NUM_PEOPLE = 20_000
"""Of the generator, from whom the regression is estimated."""
NUM_MODELLED, NUM_JUDGED, NUM_VERTICES = 6000, 400, 500
"""Modelled people from whom a regression is estimated, others whom it is judged by, and vertices of their skin."""
NUM_COMPONENTS = 100
"""Principal components of shapes, as many as modelled people have modes."""
NOISE_MM = {"exact": 0.0, "half_mm": 0.5, "one_mm": 1.0}
"""Standard deviations of the coordinates of a shape."""


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


def modelled_size_metrics(seed: int, distance_mm: float) -> dict[str, Metric]:
    """Mean errors in depth by linear regression on shapes of modelled people: ten landmarks, 68, points of the skin.

    Args:
        seed: Of the people, the vertices and the errors of shapes.
        distance_mm: Of the heads.

    Raises:
        RecordingError: if the model is not there.
    """
    model, draw = read_ict(recording_folder("ict_face_model")), np.random.default_rng(seed)
    neutral, modes, landmarks = (np.asarray(a) for a in (model.neutral, model.identity, model.landmarks))
    points = {
        "ten": landmarks[list(FROM_68)],
        "68": landmarks,
        "skin": draw.choice(len(neutral), NUM_VERTICES, replace=False),
    }
    weights = draw.normal(size=(NUM_MODELLED + NUM_JUDGED, len(modes)))
    metrics: dict[str, Metric] = {}
    for name, chosen in points.items():
        shapes = neutral[chosen] + np.tensordot(weights, modes[:, chosen].astype(float), 1)
        for how, noise_mm in NOISE_MM.items():
            errors = _size_errors_of_others(shapes, shapes + draw.normal(0, noise_mm, shapes.shape))
            mean = distance_mm * float(np.mean(np.abs(errors)))
            metrics[f"error_modelled_z_of_{name}_{how}"] = Metric(mean, "mm", "lower")
    return metrics


def _size_errors_of_others(
    shapes: Float[np.ndarray, "n K 3"], observed: Float[np.ndarray, "n K 3"]
) -> Float[np.ndarray, " m"]:
    """Relative errors of the sizes of the last people, by a regression on the observed shapes of the others."""
    features, log_sizes = _apart(observed)[0][:, 1:], _apart(shapes)[1]
    known = slice(NUM_MODELLED)
    features = features - features[known].mean(axis=0)
    axes = np.linalg.eigh(features[known].T @ features[known])[1][:, -NUM_COMPONENTS:]
    scores = np.column_stack([np.ones(len(features)), features @ axes])
    coefficients = np.linalg.lstsq(scores[known], log_sizes[known], rcond=None)[0]
    return np.expm1((scores @ coefficients - log_sizes)[NUM_MODELLED:])


def _apart(shapes: Float[np.ndarray, "n K 3"]) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"]]:
    """Shapes of size one as rows of features, and the logarithms of their sizes."""
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    sizes = np.linalg.norm(centred, axis=(1, 2))
    flat = (centred / sizes[:, None, None]).reshape(len(shapes), -1)
    return np.column_stack([np.ones(len(shapes)), flat]), np.log(sizes)
