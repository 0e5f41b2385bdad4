"""Models of symbols fitted to strokes, and how well they recognise strokes of people outside of the training set."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxfilters.models.gesture import calibration
from jaxfilters.models.gesture.calibration import Scores
from jaxfilters.models.gesture.coded import learn_paths
from jaxfilters.models.gesture.discriminative import trained_apart
from jaxfilters.models.gesture.free_hand import with_variations
from jaxfilters.models.gesture.stroke import NUM_POINTS, Drawn, stacked, to_judge
from jaxfilters.models.gesture.symbols import SHARPNESS, Symbols, learn, recognise_all

EXAMPLES_PER_VARIANT, MOST_VARIANTS = 40, 20
"""Examples of a symbol for each variant in which it is drawn, and how many variants at most."""
NUM_STATES, MIN_VARIANCE, NUM_ITERATIONS = 10, 0.1, 8
"""Of many strokes."""
FEW_STATES, FEW_VARIANCE, FEW_ITERATIONS = 18, 0.07, 4
"""Of few strokes, with their variations: these show how strokes differ, so that variances need a lower floor
than those of few examples, and few iterations of Baum-Welch suffice."""
PATH_STATES, PATH_VARIANCE = 16, 0.15
"""Of strokes of one piece in the plane."""
EXAMPLES_TO_PART, MOST_VARIANTS_APART = 40, 8
"""Examples of a symbol from which on models are trained discriminatively, of which fewer do: with 8 examples of each
no decision changes, and with 20 variants models learn the training strokes by heart."""
NUM_FOLDS, FEWEST_SCORES = 3, 20
"""Parts of the strokes that are left out in turn to calibrate, and recognised strokes that this takes."""


class Settings(NamedTuple):
    """How models of strokes are fitted; `None` is what suits the kind and the number of strokes."""

    num_states: int | None = None
    """States of each model."""
    num_variants: int | None = None
    """Of each symbol; `None` is `num_variants_of(labels)`, and at most `MOST_VARIANTS_APART` of models that are trained
    discriminatively."""
    min_variance: float | None = None
    """Floor of the variances of features."""


USUAL = Settings()


class LeftOut(NamedTuple):
    """Strokes of one person by models that were fitted to those of the others."""

    person: str
    scores: Scores


class Evaluated(NamedTuple):
    """The same with confidences and margins that were fitted to the other people's scores."""

    person: str
    right: Bool[np.ndarray, " n"]
    """Strokes whose best symbol is theirs, whether it is accepted or not."""
    confidence: Float[np.ndarray, " n"]
    """Of the best symbol."""
    beyond: Float[np.ndarray, " n"]
    """Nats a point by which it beats the threshold model beside its margin: it is accepted from 0 on."""


def is_path(strokes: Sequence[Drawn]) -> bool:
    """Whether all strokes are of one piece and in the plane, as a fingertip draws them on a desk."""
    return all(len(pieces) == 1 and np.shape(pieces[0])[1:] == (2,) for pieces, _ in strokes)


def num_variants_of(labels: Sequence[str]) -> int:
    """How many variants of a symbol its examples can distinguish: one for 40, and at most 20."""
    counts = np.unique(np.asarray(labels), return_counts=True)[1]
    return int(np.clip(np.median(counts) // EXAMPLES_PER_VARIANT, 1, MOST_VARIANTS))


def learn_strokes(strokes: Sequence[Drawn], labels: Sequence[str], settings: Settings = USUAL) -> Symbols:
    """Models of strokes of any kind, by `coded.learn_paths` where they are paths of fingertips.

    Others are fitted by `symbols.learn` and, where there are many, trained discriminatively by
    `discriminative.trained_apart`. Few are fitted with `free_hand.with_variations`.

    Args:
        strokes: In two dimensions or in three.
        labels: The symbol of each.
        settings: States, variants and floor of variances.

    Raises:
        ValueError: If there is no stroke, `labels` has another length, or a stroke has no sample or one that is not
            finite.
    """
    num_states, num_variants, min_variance = settings
    if is_path(strokes):
        paths = [(np.asarray(pieces[0]), np.full(len(pieces[0]), fingers, int)) for pieces, fingers in strokes]
        return learn_paths(
            paths,
            labels,
            num_states=num_states or PATH_STATES,
            num_variants=num_variants_of(labels) if num_variants is None else num_variants,
            min_variance=PATH_VARIANCE if min_variance is None else min_variance,
        )
    are_many = np.median(np.unique(np.asarray(labels), return_counts=True)[1]) >= EXAMPLES_TO_PART
    variants = (
        min(num_variants_of(labels), MOST_VARIANTS_APART if are_many else MOST_VARIANTS)
        if num_variants is None
        else num_variants
    )
    usual_states, usual_variance, iterations = NUM_STATES, MIN_VARIANCE, NUM_ITERATIONS
    if not are_many:
        strokes, labels = with_variations(strokes, labels)
        usual_states, usual_variance, iterations = FEW_STATES, FEW_VARIANCE, FEW_ITERATIONS
    features = stacked(strokes)
    symbols = learn(
        features,
        labels,
        num_states=num_states or usual_states,
        num_variants=variants,
        max_iterations=iterations,
        min_variance=usual_variance if min_variance is None else min_variance,
    )
    return trained_apart(symbols, features, labels) if are_many else symbols


def leave_one_out(
    strokes: Sequence[Drawn],
    labels: Sequence[str],
    people: Sequence[str],
    *,
    most: int | None = None,
    left_out: Sequence[str] | None = None,
    settings: Settings = USUAL,
) -> list[LeftOut]:
    """Each person in turn, recognised from the strokes of all the others.

    Args:
        strokes: In two dimensions or in three.
        labels: The symbol of each.
        people: Who drew each.
        most: Examples of a symbol that are used of one person, drawn at random but always the same; `None` is all.
        left_out: Who is left out; `None` is everybody.
        settings: As of `learn_strokes`.

    Raises:
        ValueError: If there are fewer than two people.
    """
    named, drawn_by = np.asarray(labels), np.asarray(people)
    everybody = sorted(set(people))
    if len(everybody) < 2:
        raise ValueError(f"people must be two or more; got {everybody}.")
    found = []
    for person in everybody if left_out is None else left_out:
        shown = shown_of_others(named, drawn_by, person, most)
        scores = _scores(strokes, named, shown, np.flatnonzero(drawn_by == person), settings)
        found.append(LeftOut(person, scores))
    return found


def shown_of_others(labels: np.ndarray, drawn_by: np.ndarray, person: str, most: int | None) -> np.ndarray:
    """Indices of the training set where one person is left out.

    Args:
        labels: The symbol of each stroke.
        drawn_by: Who drew each.
        person: Who is left out.
        most: Examples of a symbol that are used of one person, drawn at random but always the same; `None` is all.
    """
    rng = np.random.default_rng(0)
    groups = [
        rng.permutation(np.flatnonzero((drawn_by == other) & (labels == label)))[:most]
        for other in np.unique(drawn_by[drawn_by != person])
        for label in np.unique(labels)
    ]
    return np.concatenate(groups)


def cross_calibrated(
    symbols: Symbols,
    strokes: Sequence[Drawn],
    labels: Sequence[str],
    people: Sequence[str],
    settings: Settings = USUAL,
) -> Symbols:
    """`calibrated` by `cross_scores` of the strokes that the symbols were fitted to; as they are if these are too few.

    Arguments are those of `leave_one_out`.
    """
    if len(strokes) < FEWEST_SCORES:
        return symbols
    return calibrated(symbols, cross_scores(strokes, labels, people, settings))


def cross_scores(
    strokes: Sequence[Drawn], labels: Sequence[str], people: Sequence[str], settings: Settings = USUAL
) -> Scores:
    """All strokes by models of others, in `NUM_FOLDS` parts: of people where there are two or more, else of strokes.

    Arguments are those of `leave_one_out`.
    """
    named, drawn_by = np.asarray(labels), np.unique(np.asarray(people), return_inverse=True)[1]
    parts = drawn_by
    if not drawn_by.max():
        parts = np.zeros(len(named), int)
        for name in np.unique(named):
            parts[named == name] = np.arange(np.sum(named == name))
    fold = parts % min(NUM_FOLDS, parts.max() + 1)
    scores = [
        _scores(strokes, named, np.flatnonzero(fold != i), np.flatnonzero(fold == i), settings)
        for i in np.unique(fold)
        if np.any(fold != i)
    ]
    return together(scores)


def together(scores: Sequence[Scores]) -> Scores:
    """Those of several sets of strokes, by models of the same symbols."""
    return Scores(
        np.concatenate([one.log_likelihood for one in scores], axis=1),
        np.concatenate([one.lead for one in scores]),
        np.concatenate([one.truth for one in scores]),
    )


def calibrated(symbols: Symbols, scores: Scores) -> Symbols:
    """Symbols with the confidences and margins that suit strokes of people outside of the training set.

    They stay as they are where fewer than `FEWEST_SCORES` strokes were recognised.
    """
    if np.sum(scores.is_right & np.isfinite(scores.lead)) < FEWEST_SCORES:
        return symbols
    found = calibration.fitted(scores)
    margins = jnp.asarray(found.margins, float)
    return replace(symbols, sharpness=found.sharpness, lapse=found.lapse, margins=margins)


def evaluated(found: Sequence[LeftOut]) -> list[Evaluated]:
    """Every person's strokes, with confidences and margins fitted to those of the other people."""
    rows = []
    for one in found:
        others = [other.scores for other in found if other is not one]
        known = bool(others) and sum(int(other.is_right.sum()) for other in others) >= FEWEST_SCORES
        fitted = calibration.fitted(together(others)) if known else None
        share, lapse = (fitted.sharpness, fitted.lapse) if fitted else (SHARPNESS, 0.0)
        margins = fitted.margins if fitted else np.zeros(len(one.scores.log_likelihood))
        confidence = calibration.confidences(one.scores, share, lapse)
        rows.append(Evaluated(one.person, one.scores.is_right, confidence, one.scores.lead - margins[one.scores.best]))
    return rows


def accuracy(found: Sequence[Evaluated | LeftOut]) -> float:
    """Share of all strokes, in percent, whose best symbol is theirs."""
    right = np.concatenate([one.right if isinstance(one, Evaluated) else one.scores.is_right for one in found])
    return 100 * float(right.mean())


def _scores(
    strokes: Sequence[Drawn],
    labels: np.ndarray,
    shown: np.ndarray,
    own: np.ndarray,
    settings: Settings,
) -> Scores:
    """Of the strokes `own` by models of the strokes `shown`; a symbol that is not among these has `-inf`."""
    dimensions = next(np.shape(piece)[1] for pieces, _ in strokes for piece in pieces)
    symbols = learn_strokes([strokes[i] for i in shown], labels[shown].tolist(), settings)
    found = recognise_all(symbols, to_judge([strokes[i] for i in own], dimensions))
    everything = np.unique(labels)
    log_likelihood = np.full((len(everything), len(own)), -np.inf)
    log_likelihood[np.searchsorted(everything, symbols.names)] = NUM_POINTS * np.asarray(found.log_likelihood, float)
    return Scores(log_likelihood, np.asarray(found.lead, float), np.searchsorted(everything, labels[own]))
