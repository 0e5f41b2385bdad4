"""How well size and rotation of a face follow from the places of its landmarks, which are all that a camera shows."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.face.pose import angles
from jaxfilters.models.face.rigid import align
from jaxfilters.models.synthetic.face import Identity, make_identity
from jaxfilters.models.synthetic.ict_course import read_livelink
from jaxfilters.models.synthetic.ict_face import IctModel, read_ict

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
    metrics: dict[str, Metric] = {}
    for name, shapes, _ in _people(model, draw):
        for how, noise_mm in NOISE_MM.items():
            errors = _size_errors_of_others(shapes, shapes + draw.normal(0, noise_mm, shapes.shape))
            mean = distance_mm * float(np.mean(np.abs(errors)))
            metrics[f"error_modelled_z_of_{name}_{how}"] = Metric(mean, "mm", "lower")
    return metrics


def modelled_rotation_metrics(seed: int) -> dict[str, Metric]:
    """Errors of yaw and pitch by linear regression on shapes of modelled people to a millimetre, neutral and speaking.

    A shape has the rotation that takes the mean shape nearest to it; the regression is of what that is off by. Of the
    recorded speech the first half is for the people from whom it is estimated, the second for those who are judged:
    from exact shapes it would follow the first half too closely.

    Args:
        seed: Of the people, the vertices, the expressions and the errors of shapes.

    Raises:
        RecordingError: if the model or the recorded speech is not there.
    """
    model, draw = read_ict(recording_folder("ict_face_model")), np.random.default_rng(seed)
    speech = read_livelink(recording_folder("livelinkface_take"), model.names)
    half = len(speech) // 2
    rows = [draw.integers(0, half, NUM_MODELLED), draw.integers(half, len(speech), NUM_JUDGED)]
    strengths = speech[np.concatenate(rows)]
    metrics: dict[str, Metric] = {}
    for name, shapes, expressions in _people(model, draw):
        for how, faces in (("neutral", shapes), ("speaking", shapes + np.tensordot(strengths, expressions, 1))):
            observed = faces + draw.normal(0, NOISE_MM["one_mm"], faces.shape)
            rms = np.degrees(np.sqrt(np.mean(np.square(_rotation_errors_of_others(observed)), axis=0)))
            metrics |= {
                f"error_modelled_{axis}_of_{name}_{how}": Metric(float(value), "deg", "lower")
                for axis, value in zip(("yaw", "pitch"), rms[1:], strict=True)
            }
    return metrics


def _people(
    model: IctModel, draw: np.random.Generator
) -> Iterator[tuple[str, Float[np.ndarray, "n K 3"], Float[np.ndarray, "57 K 3"]]]:
    """Ten landmarks, 68, and points of the skin: their name, their places on random neutral faces, and expressions."""
    landmarks = np.asarray(model.landmarks)
    points = {
        "ten": landmarks[list(FROM_68)],
        "68": landmarks,
        "skin": draw.choice(len(model.neutral), NUM_VERTICES, replace=False),
    }
    weights = draw.normal(size=(NUM_MODELLED + NUM_JUDGED, len(model.identity)))
    for name, chosen in points.items():
        neutral, modes, expressions = (
            np.asarray(a)[..., chosen, :].astype(float) for a in (model.neutral, model.identity, model.expression)
        )
        yield name, neutral + np.tensordot(weights, modes, 1), expressions


def _rotation_errors_of_others(shapes: Float[np.ndarray, "n K 3"]) -> Float[np.ndarray, "m 3"]:
    """Errors of roll, yaw and pitch of the last people, by a regression on the shapes of the others; radians."""
    known = slice(NUM_MODELLED)
    mean = jnp.asarray(shapes[known].mean(axis=0))
    rotations, _ = jax.vmap(lambda one: align(mean, one))(jnp.asarray(shapes))
    upright = np.einsum("nki,nij->nkj", shapes - shapes.mean(axis=1, keepdims=True), np.asarray(rotations, float))
    turned = np.asarray(jax.vmap(angles)(rotations), float)
    scores = _scores(upright)
    coefficients = np.linalg.lstsq(scores[known], turned[known], rcond=None)[0]
    return (turned - scores @ coefficients)[NUM_MODELLED:]


def _scores(shapes: Float[np.ndarray, "n K 3"]) -> Float[np.ndarray, "n p"]:
    """A one and the principal components of shapes of size one."""
    features = _apart(shapes)[0][:, 1:]
    features = features - features[:NUM_MODELLED].mean(axis=0)
    axes = np.linalg.eigh(features[:NUM_MODELLED].T @ features[:NUM_MODELLED])[1][:, -NUM_COMPONENTS:]
    return np.column_stack([np.ones(len(features)), features @ axes])


def _size_errors_of_others(
    shapes: Float[np.ndarray, "n K 3"], observed: Float[np.ndarray, "n K 3"]
) -> Float[np.ndarray, " m"]:
    """Relative errors of the sizes of the last people, by a regression on the observed shapes of the others."""
    scores, log_sizes, known = _scores(observed), _apart(shapes)[1], slice(NUM_MODELLED)
    coefficients = np.linalg.lstsq(scores[known], log_sizes[known], rcond=None)[0]
    return np.expm1((scores @ coefficients - log_sizes)[NUM_MODELLED:])


def _apart(shapes: Float[np.ndarray, "n K 3"]) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"]]:
    """Shapes of size one as rows of features, and the logarithms of their sizes."""
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    sizes = np.linalg.norm(centred, axis=(1, 2))
    flat = (centred / sizes[:, None, None]).reshape(len(shapes), -1)
    return np.column_stack([np.ones(len(shapes)), flat]), np.log(sizes)
