"""Which frames the face is adjusted to, and who it is after that."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.face import person_prior
from jaxfilters.models.face.bundle import Adjustment, Bundle, Views, adjust, square
from jaxfilters.models.face.frame_selection import FrameInformation, by_angles, frame_information, information_gain
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.patches import patches_of
from jaxfilters.models.face.person_prior import Person, Prior, posed_shape
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.models.face.square_root_prior import SquareRootPrior, joined, of_measurements
from jaxfilters.optimize.least_squares import cauchy, huber
from jaxfilters.trackers.head.common.state import POSE
from jaxfilters.trackers.head.mono.config import MonoConfig
from jaxfilters.trackers.head.mono.past import about_face, marginalize_frame, units
from jaxfilters.trackers.head.mono.person import Modes, model_of
from jaxfilters.trackers.head.mono.repetition import total_information
from jaxfilters.trackers.head.mono.state import MonoState, Window, reach_of

STEPS = (5, 5)
"""Of both stages."""
MOST_YAW, MOST_PITCH, LEAST_SCORE = np.radians(25.0), np.radians(20.0), 0.7
"""Of a face that may be adjusted."""
FURTHER = 1.6
"""How much farther it may be turned where landmarks are aligned by patches that turn with it."""
LEAST_GAIN = 0.02
"""Nats about the person for which a frame is taken."""
UNKNOWN = 1e-6
"""Information, in standard deviations, of a person of whom nothing is known beforehand."""


class Frame(NamedTuple):
    """One frame that the face may be adjusted to."""

    view: Views
    pose: Float[Array, " 6"]
    expression: Float[Array, " A"]
    about_person: FrameInformation


def frame_of(
    face: MultilinearFace,
    rig: CameraRig,
    view: Views,
    person: Person,
    x: Float[Array, " n"],
    modes: Modes,
    prior: Prior,
) -> Frame:
    """The frame in which the face was estimated at `x`, and what it tells of the person."""
    expression = modes.expression(face, x[POSE:])
    here = Bundle(x[None, :POSE], expression[None], person)
    return Frame(view, x[:POSE], expression, frame_information(face, rig, view, here, prior))


def informed(face: MultilinearFace, rig: CameraRig, window: Window, person: Person, prior: Prior) -> Window:
    """The window with what its frames tell of the person."""
    found = of_frames(face, rig, window.views, window.bundle(person), prior)
    return window._replace(information=found.information, gradient=found.gradient)


def of_frames(face: MultilinearFace, rig: CameraRig, views: Views, bundle: Bundle, prior: Prior) -> FrameInformation:
    """What each of n frames tells of the person, with the frame axis first; arguments are those of `adjust`."""

    def one(inputs: tuple) -> FrameInformation:
        view, pose, expression = jax.tree.map(lambda leaf: leaf[None], inputs)
        return frame_information(face, rig, view, Bundle(pose, expression, bundle.person), prior)

    # One by one: batches of factorisations can stand still on two cores.
    return jax.lax.map(one, (views, bundle.poses, bundle.expressions))


def with_measurement(
    face: MultilinearFace,
    person: Person,
    frames: FrameInformation,
    past: SquareRootPrior,
    J: Float[Array, "m d"],
    residuals: Float[Array, " m"],
    prior: Prior,
) -> tuple[Float[Array, " d"], SquareRootPrior]:
    """How a person moves once something else was measured of the face, and what is then known beside the frames.

    One step of Newton's method from the person that is the most probable one without the measurement.

    Args:
        face: Model.
        person: As estimated without the measurement.
        frames: What each frame tells of the person.
        past: What is known beside the frames.
        J: Derivative of the residuals by identity and offset, in units of their standard deviations.
        residuals: Of the measurement at the person, in standard deviations.
        prior: What holds the face.

    Returns:
        The step, in standard deviations of identity and offset, and `past` with the measurement.
    """
    unit = units(face, prior)
    rows = J * jnp.where(unit > 0, 1 / jnp.where(unit > 0, unit, 1.0), 0.0)
    values = jnp.matmul(rows, person_prior.parameters(person), precision="highest") - residuals
    past = joined(past, of_measurements(rows, values))
    total = prior_information(face, person, prior) + unit[:, None] * past.information * unit
    total = total + jnp.sum(frames.information, axis=0)
    return -jnp.linalg.solve(total, jnp.matmul(J.T, residuals, precision="highest")), past


def moved_person(face: MultilinearFace, person: Person, step: Float[Array, " d"], prior: Prior) -> Person:
    """The person after a step in standard deviations of identity and offset."""
    change, count = units(face, prior) * step, face.num_identities
    return Person(person.identity + change[:count], person.offset + change[count:].reshape(face.mean.shape))


def uncertainty(
    face: MultilinearFace,
    window: Window,
    prior: Prior,
    person: Person,
    response: Float[Array, "m d"],
) -> Float[Array, "m m"]:
    """Covariance of what responds to identity and offset, by what is not known of them."""
    total = known(face, prior, person) + total_information(face, window)
    root = jnp.linalg.cholesky(total)
    part = jax.scipy.linalg.solve_triangular(root, response.T, lower=True)
    return jnp.matmul(part.T, part, precision="highest")


def choose(
    face: MultilinearFace, window: Window, prior: Prior, person: Person, frame: Frame, options: MonoConfig
) -> tuple[Int[Array, ""], Bool[Array, ""]]:
    """Which frame of the window the new one replaces, and whether it does."""
    may_go = (jnp.arange(len(window.poses)) > 0) | options.is_published
    if options.selection == "information":
        beside = known(face, prior, person)
        place, gain = information_gain(window.information, frame.about_person.information, beside, may_go)
        return place, gain > LEAST_GAIN
    if options.selection == "angles":
        place, _ = by_angles(window.poses[:, 4:], frame.pose[4:], window.ages, may_go)
        return place, jnp.ones((), bool)
    return jnp.argmax(jnp.where(may_go, window.ages, -1)), jnp.ones((), bool)


def adjusted(
    unknown: MultilinearFace,
    face: MultilinearFace,
    rig: CameraRig,
    state: MonoState,
    frame: Frame,
    place: Int[Array, ""],
    options: MonoConfig,
) -> MonoState:
    """The state after an adjustment to the window with a new frame; not finite if that came to nothing.

    Args:
        unknown: The model, which is the face of an unknown person.
        face: Whom the state is about: the same, or an enrolled person.
        rig: One camera.
        state: Before.
        frame: The new one.
        place: Which frame of the window it replaces.
        options: Constants.
    """
    prior = state.prior
    if prior.past is not None and options.past == "marginalised":
        gone = marginalize_frame(unknown, face, state.window, state.person, place, prior)
        prior = prior._replace(past=joined(prior.past, gone))
    start = state.person
    if options.is_published:
        start = start._replace(identity=_average(state))
    state = state._replace(window=_with(state.window, frame, place), prior=prior, num_adjusted=state.num_adjusted + 1)
    bundle, info = fitted(unknown, face, rig, state, state.window.bundle(start), options)
    identity = jnp.where(jnp.isfinite(info.energy), bundle.person.identity, jnp.nan)
    bundle = bundle._replace(person=bundle.person._replace(identity=identity))
    state = state._replace(identities=jnp.concatenate([identity[None], state.identities[:-1]]))
    return settled(face, rig, state, bundle, bundle.poses[place], bundle.expressions[place], options)


def fitted(
    unknown: MultilinearFace,
    face: MultilinearFace,
    rig: CameraRig,
    state: MonoState,
    start: Bundle,
    options: MonoConfig,
    steps: tuple[int, int] = STEPS,
) -> tuple[Bundle, Adjustment]:
    """The window adjusted to one of the faces that it may be of; arguments are those of `adjusted` and `adjust`."""
    prior = state.prior
    if prior.past is not None:
        prior = prior._replace(past=about_face(prior.past, unknown, face))
    losses = (square, square) if options.is_published else (huber, cauchy)
    return adjust(face, rig, state.window.views, start, prior, reach_of(options), steps=steps, losses=losses)


def settled(
    face: MultilinearFace,
    rig: CameraRig,
    state: MonoState,
    bundle: Bundle,
    pose: Float[Array, " 6"],
    expression: Float[Array, " A"],
    options: MonoConfig,
) -> MonoState:
    """The state with its window adjusted: the person, the face that the search works with, particles and belief.

    Args:
        face: Whom the bundle is of.
        rig: One camera.
        state: Before.
        bundle: Of the window.
        pose: Of the frame at hand, now that the face is another.
        expression: The same.
        options: Constants.
    """
    person = bundle.person
    window = state.window._replace(poses=bundle.poses, expressions=bundle.expressions)
    state = state._replace(window=informed(face, rig, window, person, state.prior))
    if options.is_published:
        person = person._replace(identity=_average(state))
    model, modes = model_of(face, person, state.registered.templates)
    x = jnp.concatenate([pose, modes.coefficients(face, expression)])
    state = _at(state._replace(person=person, modes=modes), x, model)
    return state if options.is_published else _registered_anew(face, rig, state, bundle)


def _at(state: MonoState, x: Array, model) -> MonoState:
    """Particles and belief moved to the adjusted pose and expression, in the modes of the adjusted face.

    Particles go by the correction of the estimate. Their velocity stays: that a face turns out larger is no motion.
    """
    product = lambda a, b: jnp.matmul(a, b, precision="highest")
    turning = jax.scipy.linalg.block_diag(jnp.eye(POSE, dtype=x.dtype), product(model.basis.T, state.model.basis))
    covariance = product(product(turning, state.belief.covariance), turning.T)
    turned = product(turning, state.search.particles)
    moved = turned + (x - product(turning, state.belief.mean))[:, None]
    search = state.search._replace(particles=moved, estimate=x)
    return state._replace(model=model, belief=Gaussian(x, covariance), search=search)


def _registered_anew(face: MultilinearFace, rig: CameraRig, state: MonoState, bundle: Bundle) -> MonoState:
    """The patches of the first frame, on the skin of the adjusted face."""
    old = state.registered
    pose, expression = bundle.poses[0], bundle.expressions[0]
    shape = posed_shape(face, bundle.person, expression)
    observed = patches_of(old.wide, shape, pose, rig, old.patches.normals)
    return state._replace(registered=old._replace(patches=observed))


def _with(window: Window, frame: Frame, place: Array) -> Window:
    put = lambda old, new: old.at[place].set(new)
    views = jax.tree.map(lambda old, new: put(old, new[0]), window.views, frame.view)
    return Window(
        views,
        put(window.poses, frame.pose),
        put(window.expressions, frame.expression),
        put(window.ages, jnp.zeros((), window.ages.dtype)),
        put(window.information, frame.about_person.information),
        put(window.gradient, frame.about_person.gradient),
    )


def _average(state: MonoState) -> Array:
    """Mean of the last identities ([4.36])."""
    used = jnp.arange(len(state.identities)) < state.num_adjusted
    return jnp.sum(jnp.where(used[:, None], state.identities, 0.0), axis=0) / jnp.sum(used)


@jax.jit
def known(face: MultilinearFace, prior: Prior, person: Person) -> Float[Array, "d d"]:
    """Information about identity and offset beside the window's, in standard deviations, at a person."""
    both = prior_information(face, person, prior)
    if prior.past is None:
        return both
    unit = units(face, prior)
    return both + unit[:, None] * prior.past.information * unit


@jax.jit
def prior_information(face: MultilinearFace, person: Person, prior: Prior) -> Float[Array, "d d"]:
    """Prior information about identity and offset, in standard deviations.

    Args:
        face: Model.
        person: Whose size decides how far a face may differ from others.
        prior: What holds the face; the past is not counted.
    """
    count, std = face.num_identities, face.identity_std
    prior = prior._replace(past=None)

    def residuals(y: Array) -> Array:
        offset = person.offset + prior.offset_deviations * y[count:].reshape(person.offset.shape)
        other = Person(person.identity + std * y[:count], offset)
        return person_prior.residuals(face, other, face.expression_mean[None], prior)

    J = jax.jacfwd(residuals)(jnp.zeros(count + face.mean.size, std.dtype))
    # Without a weight the box of two deviations to either side is all that is known: as much as its variance of 4 / 3.
    boxed = jnp.where(jnp.asarray(prior.weight) > 0, 0.0, 0.75) * (jnp.arange(J.shape[1]) < count)
    return jnp.matmul(J.T, J, precision="highest") + jnp.diag(boxed + UNKNOWN)
