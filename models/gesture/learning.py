"""Models of symbols fitted to strokes, and how well they recognise strokes of people outside of the training set."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxfilters.models.gesture.coded import learn_paths
from jaxfilters.models.gesture.stroke import Drawn, stacked, to_judge
from jaxfilters.models.gesture.symbols import Symbols, learn, recognise_all

EXAMPLES_A_WAY, MOST_WAYS = 40, 20
"""Examples of a symbol for each way to draw it that is looked for, and how many ways at most."""
NUM_STATES, MIN_VARIANCE = 10, 0.1
"""Of strokes with several pieces or in space."""
PATH_STATES, PATH_VARIANCE = 16, 0.15
"""Of strokes of one piece in the plane."""


class LeftOut(NamedTuple):
    """How strokes of one person were recognised by models that were fitted to those of the others."""

    person: str
    right: int
    """Strokes whose best symbol is theirs, whether it beats the threshold model or not."""
    accepted: int
    """Strokes whose best symbol beats the threshold model."""
    right_and_accepted: int
    total: int


def is_path(strokes: Sequence[Drawn]) -> bool:
    """Whether all strokes are of one piece and in the plane, as a fingertip draws them on a desk."""
    return all(len(pieces) == 1 and np.shape(pieces[0])[1:] == (2,) for pieces, _ in strokes)


def ways_of(labels: Sequence[str]) -> int:
    """How many ways to draw a symbol its examples can tell of: one for 40, and at most 20."""
    counts = np.unique(np.asarray(labels), return_counts=True)[1]
    return int(np.clip(np.median(counts) // EXAMPLES_A_WAY, 1, MOST_WAYS))


def learn_strokes(
    strokes: Sequence[Drawn],
    labels: Sequence[str],
    *,
    num_states: int | None = None,
    num_variants: int | None = None,
    min_variance: float | None = None,
) -> Symbols:
    """Models of strokes of any kind, by `coded.learn_paths` where they are paths of fingertips, else by `learn`.

    Args:
        strokes: In two dimensions or in three.
        labels: The symbol of each.
        num_states: States of each model; `None` is as many as suit the kind of strokes.
        num_variants: Ways to draw each symbol; `None` is `ways_of(labels)`.
        min_variance: Floor of the variances of features; `None` is what suits the kind of strokes.

    Raises:
        ValueError: If there is no stroke, `labels` has another length, or a stroke has no sample or one that is not
            finite.
    """
    ways = ways_of(labels) if num_variants is None else num_variants
    if is_path(strokes):
        paths = [(np.asarray(pieces[0]), np.full(len(pieces[0]), fingers, int)) for pieces, fingers in strokes]
        return learn_paths(
            paths,
            labels,
            num_states=num_states or PATH_STATES,
            num_variants=ways,
            min_variance=PATH_VARIANCE if min_variance is None else min_variance,
        )
    return learn(
        stacked(strokes),
        labels,
        num_states=num_states or NUM_STATES,
        num_variants=ways,
        min_variance=MIN_VARIANCE if min_variance is None else min_variance,
    )


def leave_one_out(
    strokes: Sequence[Drawn],
    labels: Sequence[str],
    people: Sequence[str],
    *,
    most: int | None = None,
    left_out: Sequence[str] | None = None,
    num_states: int | None = None,
    num_variants: int | None = None,
) -> list[LeftOut]:
    """Each person in turn, recognised from the strokes of all the others.

    Args:
        strokes: In two dimensions or in three.
        labels: The symbol of each.
        people: Who drew each.
        most: Examples of a symbol that are used of one person, drawn at random but always the same; `None` is all.
        left_out: Who is left out; `None` is everybody.
        num_states: As of `learn_strokes`.
        num_variants: As of `learn_strokes`.

    Raises:
        ValueError: If there are fewer than two people.
    """
    named, who = np.asarray(labels), np.asarray(people)
    everybody = sorted(set(people))
    if len(everybody) < 2:
        raise ValueError(f"people must be two or more; got {everybody}.")
    dimensions = next(np.shape(piece)[1] for pieces, _ in strokes for piece in pieces)
    found = []
    for person in everybody if left_out is None else left_out:
        shown = _shown(named, who, person, most).tolist()
        symbols = learn_strokes(
            [strokes[i] for i in shown], named[shown].tolist(), num_states=num_states, num_variants=num_variants
        )
        own = np.flatnonzero(who == person).tolist()
        judged = recognise_all(symbols, to_judge([strokes[i] for i in own], dimensions))
        right = np.array(symbols.names)[np.argmax(judged.log_likelihood, axis=0)] == named[own]
        accepted = np.asarray(judged.label) >= 0
        found.append(LeftOut(person, int(right.sum()), int(accepted.sum()), int((right & accepted).sum()), len(own)))
    return found


def accuracy(found: Sequence[LeftOut]) -> float:
    """Share of all strokes, in percent, whose best symbol is theirs."""
    return 100 * sum(one.right for one in found) / max(sum(one.total for one in found), 1)


def _shown(labels: np.ndarray, who: np.ndarray, person: str, most: int | None) -> np.ndarray:
    """Indices of the training set where one person is left out."""
    rng = np.random.default_rng(0)
    groups = [
        rng.permutation(np.flatnonzero((who == other) & (labels == label)))[:most]
        for other in np.unique(who[who != person])
        for label in np.unique(labels)
    ]
    return np.concatenate(groups)
