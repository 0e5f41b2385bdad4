"""Faces to learn from, people along one axis and expressions along the next: of the generator, of additive models."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters.models.face.landmarks import FROM_68
from jaxfilters.models.synthetic.face import LEVELS, NEUTRAL_LEVELS, Identity, face_shape, make_identity
from jaxfilters.models.synthetic.ict_face import IctModel
from jaxfilters.typing import AnyKey

NOISE_MM = 0.5
"""Standard deviation of a measured coordinate."""
ICT_EXPRESSIONS: tuple[dict[str, float], ...] = (
    {},
    {"jawOpen": 0.25},
    {"jawOpen": 0.6},
    {"mouthSmile_L": 0.4, "mouthSmile_R": 0.4},
    {"mouthSmile_L": 0.9, "mouthSmile_R": 0.9, "cheekSquint_L": 0.5, "cheekSquint_R": 0.5},
    {"mouthSmile_L": 0.8, "mouthSmile_R": 0.8, "jawOpen": 0.35},
    {"mouthPucker": 0.5},
    {"mouthPucker": 0.9},
    {"mouthFunnel": 0.7, "jawOpen": 0.2},
    {"mouthStretch_L": 0.7, "mouthStretch_R": 0.7, "jawOpen": 0.15},
    {"mouthFrown_L": 0.7, "mouthFrown_R": 0.7},
    {"mouthRollLower": 0.6, "mouthRollUpper": 0.6, "mouthPress_L": 0.4, "mouthPress_R": 0.4},
    {"mouthUpperUp_L": 0.6, "mouthUpperUp_R": 0.6, "noseSneer_L": 0.5, "noseSneer_R": 0.5},
    {"mouthLowerDown_L": 0.6, "mouthLowerDown_R": 0.6, "jawOpen": 0.15},
    {"mouthShrugLower": 0.7, "mouthShrugUpper": 0.4},
    {"browInnerUp_L": 0.5, "browInnerUp_R": 0.5},
    {"browInnerUp_L": 1.0, "browInnerUp_R": 1.0, "browOuterUp_L": 0.7, "browOuterUp_R": 0.7, "jawOpen": 0.3},
    {"browDown_L": 0.5, "browDown_R": 0.5},
    {"browDown_L": 1.0, "browDown_R": 1.0, "eyeSquint_L": 0.5, "eyeSquint_R": 0.5},
    {"eyeBlink_L": 1.0, "eyeBlink_R": 1.0},
)
"""Weights of a model with ARKit's names: the sounds of speech, laughter, brows up and down, a blink."""


def people_of(key: AnyKey, num_people: int) -> Identity:
    """Random people of the generator, one along each leading index of the leaves."""
    return jax.vmap(make_identity)(jax.random.split(key, num_people))


@jax.jit
def generator_shapes(key: AnyKey, people: Identity, noise_mm: float | Array = NOISE_MM) -> Float[Array, "S 10 10 3"]:
    """The training faces: five levels of either expression, and noise.

    Args:
        key: For the noise.
        people: One along each leading index of the leaves.
        noise_mm: Standard deviation of a coordinate.
    """
    widened, opened = (np.asarray(LEVELS) - neutral for neutral in NEUTRAL_LEVELS)
    strengths = np.concatenate([np.stack([widened, 0 * widened], axis=-1), np.stack([0 * opened, opened], axis=-1)])
    e1, e2 = jnp.asarray(strengths, people.neutral.dtype).T
    one = lambda person: jax.vmap(lambda a, b: face_shape(person, a, b))(e1, e2)
    shapes = jax.vmap(one)(people)
    return shapes + noise_mm * jax.random.normal(key, shapes.shape, shapes.dtype)


def additive_shapes(
    neutral: Float[Array, "K 3"],
    identity: Float[Array, "modes K 3"],
    expression: Float[Array, "E K 3"],
    identity_weights: Float[Array, "S modes"],
    expression_weights: Float[Array, "*people A E"],
) -> Float[Array, "S A K 3"]:
    """Faces of an additive model, `neutral + sum_m w_m identity_m + sum_e v_e expression_e`.

    Args:
        neutral: Mean face.
        identity: Displacements by each mode of identity.
        expression: Displacements by each expression.
        identity_weights: Of each person.
        expression_weights: Of each expression to sample, the same for all people or, with a leading axis of S, their
            own.
    """
    product = lambda weights, modes: jnp.tensordot(weights, modes, 1, precision="highest")
    expressions = product(expression_weights, expression)
    if expressions.ndim == 3:
        expressions = expressions[None]
    return neutral + product(identity_weights, identity)[:, None] + expressions


def ict_shapes(
    key: AnyKey,
    model: IctModel,
    num_people: int,
    *,
    landmarks: tuple[int, ...] = FROM_68,
    gain_log_std: float = 0.15,
    noise_mm: float = 0.0,
) -> Float[Array, "S A K 3"]:
    """Faces of random people of the ICT face model with the expressions `ICT_EXPRESSIONS`.

    Its expressions are the same for everybody; here each person has a strength of each of its own, as the people of the
    generator have. Millimetres about the centroid of the ten tracked landmarks of each neutral face.

    Args:
        key: For people, strengths and noise.
        model: Identities with unit variance.
        num_people: S.
        landmarks: Which of the 68 of iBUG; the ten tracked ones by default.
        gain_log_std: Standard deviation of the logarithm of a person's strength of an expression.
        noise_mm: Standard deviation of a coordinate.

    Raises:
        ValueError: if the model lacks one of the expressions.
    """
    identity_key, gains, noise = jax.random.split(key, 3)
    points = model.landmarks
    neutral, identity, expression = (part[..., points, :] for part in (model.neutral, model.identity, model.expression))
    weights = jnp.asarray(expression_weights(model.names), neutral.dtype)
    strength = jnp.exp(gain_log_std * jax.random.normal(gains, (num_people, len(weights), 1), neutral.dtype))
    people = jax.random.normal(identity_key, (num_people, len(identity)), neutral.dtype)
    shapes = additive_shapes(neutral, identity, expression, people, strength * weights)
    # Expressions are listed with the neutral face first.
    center = jnp.mean(shapes[:, :1, np.array(FROM_68)], axis=2, keepdims=True)
    chosen = (shapes - center)[:, :, np.array(landmarks)]
    return chosen + noise_mm * jax.random.normal(noise, chosen.shape, chosen.dtype)


def expression_weights(names: tuple[str, ...]) -> Float[np.ndarray, "A E"]:
    """`ICT_EXPRESSIONS` as weights of a model's expressions.

    Raises:
        ValueError: if the model lacks one of them.
    """
    unknown = {name for mixed in ICT_EXPRESSIONS for name in mixed} - set(names)
    if unknown:
        raise ValueError(f"model must have the expressions of ARKit; it lacks {', '.join(sorted(unknown))}.")
    weights = np.zeros((len(ICT_EXPRESSIONS), len(names)))
    for row, mixed in zip(weights, ICT_EXPRESSIONS, strict=True):
        for name, weight in mixed.items():
            row[names.index(name)] = weight
    return weights
