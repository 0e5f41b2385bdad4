"""`jaxfilters fit face-model`: a multilinear model of the face from examples, and how good it is."""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters.math.multilinear import numerical_ranks
from jaxfilters.models.face import gallery
from jaxfilters.models.face.landmarks import EYES, FROM_68, NAMES, NOSTRILS
from jaxfilters.models.face.mirroring import PAIRS, PAIRS_68, Pairs
from jaxfilters.models.face.multilinear import (
    EXPRESSION_MODE,
    PEOPLE_MODE,
    MultilinearFace,
    completed,
    of_tensor,
    shape_tensor,
)
from jaxfilters.models.face.multilinear_fit import leave_one_out
from jaxfilters.models.face.people_alignment import aligned_people
from jaxfilters.models.synthetic.face_training import generator_shapes, ict_shapes, people_of
from jaxfilters.trackers.head.mono.config import EYES_APART_MM
from jaxfilters.trackers.head.mono.dense import tracked
from jaxfilters.trackers.io.enrolled_people import People, write_people
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.face_models import FaceModelFile, save_face_model
from jaxfilters.trackers.io.ict import open_ict
from jaxfilters.trackers.io.landmark_sets import NAMES_68, LandmarkSets, read_landmark_sets, ten_of

_ICT_FILE = "ict_landmarks68.npz"
_MOST_LEFT_OUT = 12
"""People to leave out one after the other: each costs a model."""
_NEAR_MM = 650.0
"""Depth at which errors of size are reported as errors of depth."""


class Examples(NamedTuple):
    """What a model is estimated from."""

    sets: LandmarkSets
    source: str
    """Where it is from, in words."""
    parameters: dict
    """How it was drawn."""
    note: str | None = None
    """What was assumed, for a person."""


class Quality(NamedTuple):
    """How well a model describes its training faces."""

    ranks: tuple[int, int, int]
    """Numerical ranks of landmarks, halves of people and expressions."""
    captured: float
    """Share of the variance about the mean."""
    rms_mm: float
    """Error of an observed coordinate."""


def fit(options: argparse.Namespace) -> str:
    """Learn the model, write `options.out`, and say in a few lines how good it is.

    Training is in double precision, so that the same examples give the same model on every machine.

    Raises:
        InputError: the examples cannot be used, or do not support that many parameters.
        OutputError: the model cannot be written.
    """
    if options.people < 3:
        raise InputError(f"--people must be 3 or more; got {options.people}.")
    with jax.enable_x64(True):
        examples = _examples(options)
        model, tensor, quality = as_input_error(
            lambda: _estimated(examples.sets, options.identities, options.expressions)
        )
        parameters = {
            **examples.parameters,
            "identities": options.identities,
            "expressions": options.expressions,
            "captured": quality.captured,
            "rms_mm": quality.rms_mm,
        }
        sets = examples.sets
        file = FaceModelFile(model, sets.names, sets.pairs, examples.source, parameters)
        save_face_model(options.out, file)
        lines = [*_described(sets, examples.source, quality, options), *_generalisation(tensor, options)]
        lines += [] if examples.note is None else [examples.note]
        lines.append(f"model in {options.out}")
        if options.remember is not None:
            _write_people(options.remember, examples, model, tensor)
            lines.append(f"people in {options.remember}")
        return "\n".join(lines)


def _write_people(path: Path, examples: Examples, model: MultilinearFace, tensor: jax.Array) -> None:
    """The people of the examples; of 68 landmarks with the ten that `track head-mono` follows, as it knows people."""
    known = gallery.of_tensor(model, tensor)
    if model.num_landmarks == len(NAMES_68):
        model, known = tracked(model), known._replace(offset=known.offset[:, list(FROM_68)])
    names = tuple(f"{examples.source}, {i + 1}" for i in range(len(known.identity)))
    write_people(path, People(names, known), model)


def _examples(options: argparse.Namespace) -> Examples:
    drawn = {"people": options.people, "seed": options.seed}
    # The generator of other versions would draw other people from the same seed; this names the one that is meant.
    people_key, noise = jax.random.split(jax.random.key(options.seed, impl="threefry2x32"))
    if options.data is None:
        if options.points == 68:
            raise InputError("--points 68 needs DATA: the generator's faces have 10 landmarks.")
        shapes = generator_shapes(noise, people_of(people_key, options.people))
        return Examples(LandmarkSets(np.asarray(shapes), NAMES, PAIRS, None), "generator of synthetic faces", drawn)
    if (options.data / _ICT_FILE).is_file():
        return _ict_examples(options, noise, drawn)
    sets = read_landmark_sets(options.data)
    if options.points == 10:
        sets = ten_of(sets)
    elif options.points == 68 and len(sets.names) != 68:
        raise InputError(f"--points 68 needs faces of 68 landmarks; {options.data} has {len(sets.names)}.")
    _check_millimetres(sets, options.data)
    note = None if sets.neutral is not None else "no neutral expression is named: faces are taken to be aligned"
    return Examples(_aligned(sets), f"landmark sets {options.data.name}", {"people": len(sets.shapes)}, note)


def _check_millimetres(sets: LandmarkSets, path: Path) -> None:
    """Raise `InputError` where the eyes are as far apart as in no face in millimetres, of ten landmarks or 68."""
    if len(sets.names) not in (len(NAMES), len(NAMES_68)):
        return
    ten = sets.shapes if len(sets.names) == len(NAMES) else sets.shapes[:, :, list(FROM_68)]
    right, left = np.moveaxis(ten[:, :, list(EYES)].reshape(*ten.shape[:2], 2, 2, 3).mean(axis=3), 2, 0)
    apart = float(np.nanmedian(np.linalg.norm(left - right, axis=-1)))
    least, most = EYES_APART_MM
    if not least <= apart <= most:
        raise InputError(
            f"{path}: eyes are {apart:.3g} apart, the median of all faces; expected millimetres, {least:g} to {most:g}."
        )


def _ict_examples(options: argparse.Namespace, key: jax.Array, drawn: dict) -> Examples:
    # Read in single precision, the precision of its files; what is computed with it is double.
    single = open_ict(options.data)
    widened = lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf
    model = jax.tree.map(widened, single)
    landmarks: tuple[int, ...]
    names: tuple[str, ...]
    pairs: Pairs
    landmarks, names, pairs = FROM_68, NAMES, PAIRS
    if options.points == 68:
        landmarks, names, pairs = tuple(range(68)), NAMES_68, PAIRS_68
    shapes = as_input_error(lambda: ict_shapes(key, model, options.people, landmarks=landmarks))
    return Examples(LandmarkSets(np.asarray(shapes), names, pairs, None), "ICT face model", drawn)


def _aligned(sets: LandmarkSets) -> LandmarkSets:
    """Faces in one frame, if the examples name a neutral one to align to."""
    if sets.neutral is None:
        return sets
    skull = np.array([*EYES, *NOSTRILS])
    if len(sets.names) == len(NAMES_68):
        skull = np.array(FROM_68)[skull]
    weights = jnp.zeros(len(sets.names)).at[skull].set(1.0)
    return sets._replace(shapes=np.asarray(aligned_people(jnp.asarray(sets.shapes), sets.neutral, weights)))


def _estimated(sets: LandmarkSets, identities: int, expressions: int) -> tuple[MultilinearFace, jax.Array, Quality]:
    observed = sets.observed
    if min(observed.shape) < 2:
        raise ValueError(f"two people and two expressions are needed; got {observed.shape}.")
    ranks = {PEOPLE_MODE: identities, EXPRESSION_MODE: expressions}
    shapes = jnp.asarray(sets.shapes)
    if observed.all():
        tensor = shape_tensor(shapes, sets.pairs)
    else:
        tensor = completed(shapes, jnp.asarray(observed), ranks, sets.pairs)
    centred = tensor - jnp.mean(tensor, axis=(PEOPLE_MODE, EXPRESSION_MODE), keepdims=True)
    found = [int(rank) for rank in numerical_ranks(centred.reshape(-1, *centred.shape[2:]))]
    _check_support(found, ranks)
    model = of_tensor(tensor, ranks)
    energy, captured = float(jnp.sum(centred**2)), float(jnp.sum(model.tensor**2))
    # Faces that were completed have no error of their own.
    rms_mm = np.sqrt(max(energy - captured, 0.0) / (centred.size * observed.mean()))
    return model, tensor, Quality((found[0], found[1], found[2]), captured / energy, float(rms_mm))


def _check_support(found: list[int], ranks: dict[int, int]) -> None:
    for option, mode, rank in (("--identities", PEOPLE_MODE, found[1]), ("--expressions", EXPRESSION_MODE, found[2])):
        if not 1 <= ranks[mode] <= rank:
            raise ValueError(f"{option} must be 1 to {rank}, the rank of the faces; got {ranks[mode]}.")


def _described(sets: LandmarkSets, source: str, quality: Quality, options: argparse.Namespace) -> list[str]:
    observed = sets.observed
    num_people, num_expressions = observed.shape
    missing = f", {int((~observed).sum())} faces missing" if not observed.all() else ""
    return [
        f"{source}: {num_people} people, {num_expressions} expressions, {len(sets.names)} landmarks{missing}",
        "ranks {} (landmarks), {} (symmetric halves of people), {} (expressions)".format(*quality.ranks),
        f"{options.identities} parameters of identity and {options.expressions} of expression capture "
        f"{100 * quality.captured:.2f} % of the variance; rms error {quality.rms_mm:.3f} mm a coordinate",
    ]


def _generalisation(tensor: jax.Array, options: argparse.Namespace) -> list[str]:
    num_people = tensor.shape[PEOPLE_MODE] // 2
    chosen = np.unique(np.linspace(0, num_people - 1, min(num_people, _MOST_LEFT_OUT)).astype(int))
    try:
        left_out = leave_one_out(
            tensor, chosen.tolist(), identities=options.identities, expressions=options.expressions
        )
    except ValueError as error:
        return [f"no test with one person left out: {error}"]
    rms_mm, size = np.asarray(left_out.rms_mm), np.abs(np.asarray(left_out.size_error))
    return [
        f"{len(chosen)} people, each left out in turn: {rms_mm.mean():.2f} mm a landmark on average, "
        f"{rms_mm.max():.2f} mm at worst",
        f"their size, estimated from their shape alone: {100 * size.mean():.1f} % off on average, "
        f"{100 * size.max():.1f} % at worst; {_NEAR_MM * size.mean():.0f} and {_NEAR_MM * size.max():.0f} mm of depth "
        f"at {_NEAR_MM:.0f} mm",
    ]
