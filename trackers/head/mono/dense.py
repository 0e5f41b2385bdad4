"""A start from the 68 landmarks of iBUG, of which the tracker goes on with ten.

Many landmarks tell more of a face than the ten that can be followed: who it is, and so how large. What they tell of the
face of the ten is kept as a Gaussian (`SquareRootPrior`), in which nothing else is left of them: the frames that the
face is adjusted to later must not count the same detections again.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters.models.face.bundle import POSE_UNITS, Bundle, Reach, Views, adjust, frame_residuals, projected
from jaxfilters.models.face.frame_selection import reduced
from jaxfilters.models.face.landmarks import FROM_68, NUM_LANDMARKS
from jaxfilters.models.face.multilinear import MultilinearFace, restricted
from jaxfilters.models.face.person_prior import Person, Prior, observed_size, parameters
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.square_root_prior import SquareRootPrior, of_energy
from jaxfilters.trackers.head.mono.adjustment import UNKNOWN
from jaxfilters.trackers.head.mono.past import units as person_units
from jaxfilters.trackers.head.mono.start import WIDE, Start

NUM_DENSE = 68
STEPS = (5, 30)
"""Of both stages of the adjustment, which sets out from that to the ten."""
REACH = WIDE._replace(deviations=4.0)
"""Of the adjustment."""
UNMODELLED_MM = 0.55
"""Of each coordinate of a landmark from frame to frame, what a model leaves of people outside of its training set.

Measured as that of the ten (`estimate.UNMODELLED_MM`), with the same people and speech: .54 to .61 mm, .65 at the brows
and the mouth, .24 at the eyes.
"""


class Dense(NamedTuple):
    """Landmarks in n frames, beside the ten."""

    uv: Float[np.ndarray, "n 68 2"]
    """Pixels, in iBUG's order."""
    covariance: Float[np.ndarray, "n 68 2 2"]
    """Pixels squared."""
    observed: Bool[np.ndarray, "n 68"]
    """Not what a detector does not give, or not reliably."""
    misplaced_mm: float
    """By how much they lie beside the model's landmarks, the same in all frames: standard deviation of a coordinate."""


class DenseStart(NamedTuple):
    """What many landmarks say."""

    start: Start
    """Of the ten."""
    past: SquareRootPrior
    """What they tell of the face of the ten."""


def tracked(face: MultilinearFace) -> MultilinearFace:
    """The model of the ten landmarks that are followed.

    Raises:
        ValueError: if the model is neither of them nor of the 68 of iBUG.
    """
    if face.num_landmarks == NUM_LANDMARKS:
        return face
    if face.num_landmarks != NUM_DENSE:
        raise ValueError(
            f"face must have {NUM_LANDMARKS} landmarks, or the {NUM_DENSE} of iBUG; got {face.num_landmarks}."
        )
    return restricted(face, FROM_68)


def start_densely(face: MultilinearFace, rig: CameraRig, start: Start, dense: Dense, prior: Prior) -> DenseStart:
    """A start of the ten landmarks, better than what they say themselves.

    Args:
        face: Model of the 68.
        rig: One camera, which is the world.
        start: From the ten alone: where the search sets out.
        dense: Landmarks in the same frames.
        prior: What holds the face; its weight is not 0.
    """
    numbers = lambda tree: jax.tree.map(lambda a: jnp.asarray(a, start.uv.dtype), tree)
    views = Views(numbers(dense.uv), numbers(dense.covariance), jnp.asarray(dense.observed))
    return _adjusted(face, rig, start, views, numbers(dense.misplaced_mm), numbers(prior), numbers(REACH))


@compiled_quickly
def _adjusted(
    face: MultilinearFace, rig: CameraRig, start: Start, views: Views, misplaced: Array, prior: Prior, reach: Reach
) -> DenseStart:
    offset_std = jnp.asarray(prior.offset_std)
    both_std = jnp.hypot(offset_std, misplaced)
    # The distance of the eyes is that of landmarks among the ten: the tracker's own prior has it.
    prior = prior._replace(offset_std=both_std, eyes_apart_std=jnp.zeros_like(offset_std))
    begun = start.bundle._replace(person=Person(start.bundle.person.identity, jnp.zeros_like(face.mean)))
    px_per_mm = rig.focal[0] / begun.poses[:, None, 2:3]
    unmodelled = jnp.square(UNMODELLED_MM * px_per_mm)[..., None] * jnp.eye(2, dtype=px_per_mm.dtype)
    views = views._replace(covariance=views.covariance + unmodelled)
    found, info = adjust(face, rig, views, begun, prior, reach, steps=STEPS)
    ten = restricted(face, FROM_68)
    # The rest of the offset is the detector's, and no part of the face.
    of_face = jnp.square(offset_std / jnp.where(both_std > 0, both_std, 1.0))
    person = Person(found.person.identity, of_face * found.person.offset[jnp.asarray(FROM_68)])
    bundle = Bundle(found.poses, found.expressions, person)
    past = information_of_ten(face, rig, views, found, person, prior, misplaced)
    return DenseStart(Start(bundle, info, projected(ten, rig, bundle)), past)


def information_of_ten(
    face: MultilinearFace,
    rig: CameraRig,
    views: Views,
    bundle: Bundle,
    person: Person,
    prior: Prior,
    misplaced: Float[ArrayLike, ""],
) -> SquareRootPrior:
    """What views of the 68 tell of identity and offset of the ten, the rest integrated out.

    Args:
        face: Model of the 68.
        rig: One camera.
        views: Landmarks in n frames.
        bundle: Adjusted to them; of its offset a part is the detector's.
        person: Of the ten, with the other part.
        prior: What held the bundle.
        misplaced: Standard deviation of the detector's part, millimetres.
    """
    split = _Parts(face)
    y = split.joined(person, bundle.person.offset, misplaced)
    units = jnp.concatenate([jnp.asarray(POSE_UNITS, y.dtype), face.expression_std])
    std = jnp.asarray(prior.offset_std), jnp.asarray(misplaced)
    of_face = jnp.sqrt(jnp.maximum(jnp.square(std[0]) - jnp.square(std[1]), 0.0))

    def held(y: Array, expression: Array) -> tuple[Array, Array]:
        """The offsets of the ten, and all others, in standard deviations."""
        own, rest, beside = split.offsets(y)
        size = observed_size(face, split.identity(y), expression[None])
        in_std = lambda value, std: jnp.where(std > 0, value / jnp.where(std > 0, std, 1.0), 0.0) / size
        return in_std(own, of_face), jnp.concatenate([in_std(rest, std[0]), beside / size])

    def of_frame(inputs: tuple) -> tuple[Array, Array]:
        view, pose, expression = jax.tree.map(lambda leaf: leaf[None], inputs)

        def residuals(y: Array, own: Array) -> Array:
            person, a = split.person(y, misplaced), expression + units[6:] * own[6:]
            observed = frame_residuals(face, rig, view, Bundle(pose + units[:6] * own[:6], a, person), prior.weight)
            # Offsets are held once, in proportion to the size that the face has in all frames.
            return jnp.concatenate([observed, *(part / np.sqrt(len(views.uv)) for part in held(y, a[0]))])

        information, _, gradient = reduced(residuals, y, jnp.zeros_like(units))
        return information, gradient

    # One by one: batches of factorisations can stand still on two cores.
    each = jax.lax.map(of_frame, (views, bundle.poses, bundle.expressions))
    information, gradient = (jnp.sum(part, axis=0) for part in each)
    # How the offsets of the ten are held is known to the tracker.
    ours = lambda y: jax.vmap(lambda a: held(y, a)[0])(bundle.expressions).ravel() / np.sqrt(len(views.uv))
    J, product = jax.jacfwd(ours)(y), lambda a, b: jnp.matmul(a, b, precision="highest")
    count, known = parameters(person).size, UNKNOWN * jnp.eye(y.size, dtype=y.dtype)
    information, gradient = _without_rest(information + known, gradient, count)
    information, gradient = information - product(J.T, J)[:count, :count], gradient - product(J.T, ours(y))[:count]
    unit = person_units(tracked(face), prior)
    return of_energy(unit[:, None] * information * unit, unit * gradient, parameters(person), unit)


class _Parts:
    """All that the 68 landmarks of a person have in common in all frames, in one vector.

    Identity, the offsets of the ten, those of the others, and what the detector misplaces the ten by, in its standard
    deviations.
    """

    def __init__(self, face: MultilinearFace) -> None:
        self._ten = np.array(FROM_68)
        self._others = np.setdiff1d(np.arange(face.num_landmarks), self._ten)
        sizes = face.num_identities, 3 * self._ten.size, 3 * self._others.size
        self.ends = np.cumsum(sizes)

    def joined(self, ten: Person, offset: Float[Array, "68 3"], misplaced: Float[ArrayLike, ""]) -> Float[Array, " d"]:
        """Of the ten's person, and the offset of all with what is misplaced."""
        beside = (offset[self._ten] - ten.offset) / jnp.where(jnp.asarray(misplaced) > 0, misplaced, 1.0)
        return jnp.concatenate([parameters(ten), offset[self._others].ravel(), beside.ravel()])

    def identity(self, y: Float[Array, " d"]) -> Float[Array, " S"]:
        """Of the person."""
        return y[: self.ends[0]]

    def offsets(self, y: Float[Array, " d"]) -> list[Array]:
        """Of the ten, of the others, and what is misplaced."""
        return jnp.split(y[self.ends[0] :], self.ends[1:] - self.ends[0])

    def person(self, y: Float[Array, " d"], misplaced: Float[ArrayLike, ""]) -> Person:
        """Of all landmarks, with what is misplaced."""
        own, rest, beside = (part.reshape(-1, 3) for part in self.offsets(y))
        offset = jnp.zeros((self._ten.size + self._others.size, 3), y.dtype)
        return Person(self.identity(y), offset.at[self._ten].set(own + misplaced * beside).at[self._others].set(rest))


def _without_rest(
    information: Float[Array, "m m"], gradient: Float[Array, " m"], count: int
) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """An energy of the first parameters where all others are the likeliest for them."""
    product = lambda a, b: jnp.matmul(a, b, precision="highest")
    root, cross = (jnp.linalg.cholesky(information[count:, count:]), True), information[count:, :count]
    share = jax.scipy.linalg.cho_solve(root, cross)
    about = information[:count, :count] - product(share.T, cross)
    return (about + about.T) / 2, gradient[:count] - product(share.T, gradient[count:])
