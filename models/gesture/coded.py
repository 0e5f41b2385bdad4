"""Symbols recognised from what a tracker says of fingertips: direction codes 1..17 and numbers of tips, frame by frame.

Models of two kinds do. `learn_codes` makes the published ones (K. Oka, Y. Sato, H. Koike, IEEE CG&A 22(6), 2002):
states have probabilities of codes and of numbers of tips. `learn_paths` makes models of what the path looks like,
`stroke.features`, to which codes are a path of steps of equal length. It does not matter to these how fast a symbol is
drawn, nor that a tip was missed now and then.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PyTree

from jaxfilters import hmm
from jaxfilters.models.gesture.codes import MOST_TIPS, NUM_DIRECTIONS, STILL, blurred, direction_code
from jaxfilters.models.gesture.stroke import stacked, to_judge, turned
from jaxfilters.models.gesture.symbols import Recognition, Symbols, by_name, learn, recognise_all, trained

FEWEST_STEPS = 5
"""Frames in which a hand has to move for it to have drawn a symbol."""
MARGIN = 0.3
"""Nats a point: of 20 scribbles one is taken for a symbol, of 1000 symbols none is rejected."""
STILL_SHARE = 0.25
"""Of the mean step of a path: a shorter step has no direction."""
TURNS_DEG = (-12.0, 0.0, 12.0)
"""By which the strokes of one writer are turned, to stand for those of others."""
Strokes = Sequence[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]]
"""Codes and numbers of tips of every stroke."""
Paths = Sequence[tuple[Float[np.ndarray, "_ 2"], Int[np.ndarray, " _"]]]
"""Positions and numbers of tips of every stroke."""


def learn_codes(
    strokes: Strokes,
    labels: Sequence[str],
    *,
    num_states: int = 8,
    pseudo_count: float = 0.1,
    spread: float = 1.0,
    max_iterations: int = 10,
) -> Symbols:
    """The published models: codes and numbers of tips, independent of each other in each state.

    Args:
        strokes: Codes (t,) from 1 to 17 and numbers of tips (t,) from 0 to 5; each of at least one frame.
        labels: The symbol of each.
        num_states: States of each left-right model.
        pseudo_count: Times that training adds to those that each code, and number, was observed in a state.
        spread: Standard deviation of the blur of the trained directions, in sectors.
        max_iterations: Of Baum-Welch.

    Raises:
        ValueError: If there is no stroke, `labels` has another length, a stroke has no frame, or a code or number is
            none.
    """
    if not len(strokes) or len(labels) != len(strokes):
        raise ValueError(f"labels must name each of the strokes, at least one; got {len(labels)} of {len(strokes)}.")
    checked = [_checked(codes, counts) for codes, counts in strokes]
    observations, lengths = _padded(checked, max(len(codes) for codes, _ in checked))
    if not np.all(lengths):
        raise ValueError(f"strokes must have at least one frame each; number {int(np.argmin(lengths))} has none.")
    parts = (
        hmm.Codes(jnp.zeros((num_states, STILL)), float(pseudo_count)),
        hmm.Codes(jnp.zeros((num_states, MOST_TIPS + 1)), float(pseudo_count)),
    )
    symbols = trained(hmm.Independent(parts), observations, lengths, by_name(labels), max_iterations=max_iterations)
    learned: Any = symbols.models.emission
    directions, tips = learned.parts
    emission = hmm.Independent((jax.vmap(blurred, (0, None))(directions, spread), tips))
    return Symbols(
        hmm.HiddenMarkovModel(symbols.models.log_initial, symbols.models.log_transition, emission),
        symbols.owner,
        symbols.names,
    )


def learn_paths(
    paths: Paths, labels: Sequence[str], *, num_states: int = 16, num_variants: int = 1, min_variance: float = 0.15
) -> Symbols:
    """Models of the shapes of paths and of their codes, all turned by `TURNS_DEG`, and of the number of tips.

    Args:
        paths: Positions (t, 2), y down, in any unit, and numbers of tips (t,); each of at least one frame.
        labels: The symbol of each.
        num_states: States of each left-right model.
        num_variants: Ways to draw each symbol, found by clustering.
        min_variance: Floor of the variances of the features.

    Raises:
        ValueError: If there is no stroke, `labels` has another length, or a stroke has no frame or one that is not
            finite.
    """
    observed = stacked([([points], voted(counts)) for points, counts in paths])
    codes = codes_of([np.asarray(points, float) for points, _ in paths])
    coded = stacked([([chained(of)], voted(counts)) for of, (_, counts) in zip(codes, paths, strict=True)])
    both = jnp.concatenate([observed, coded])
    shown = jnp.concatenate([turned(both, np.radians(degrees)) for degrees in TURNS_DEG])
    return learn(
        shown,
        [*labels] * 2 * len(TURNS_DEG),
        num_states=num_states,
        num_variants=num_variants,
        min_variance=min_variance,
    )


def chained(codes: Int[np.ndarray, " t"]) -> Float[np.ndarray, "t_and_1 2"]:
    """The path of a hand that moves by 1 in the direction of every code from 1 to 16, and rests at 17; y down."""
    codes = np.asarray(codes)
    angle = (codes - 1) * (2 * np.pi / NUM_DIRECTIONS)
    steps = np.where((codes < STILL)[:, None], np.stack([np.cos(angle), -np.sin(angle)], axis=1), 0.0)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def codes_of(paths: Sequence[Float[np.ndarray, "_ 2"]]) -> list[Int[np.ndarray, " _"]]:
    """Direction codes of the steps of paths in any unit, y down: still where a step is short for its path."""
    steps = np.zeros((len(paths), max(map(len, paths), default=0), 2))
    still = np.zeros((len(paths), 1))
    for i, points in enumerate(paths):
        steps[i, 1 : len(points)] = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps[i, 1 : len(points)], axis=1)
        # No step at all has no direction, either.
        still[i] = max(STILL_SHARE * lengths.sum() / max(np.count_nonzero(lengths), 1), 1e-12)
    codes = np.asarray(direction_code(jnp.asarray(steps / still[..., None]), 1.0))
    return [codes[i, : len(points)] for i, points in enumerate(paths)]


def voted(counts: Int[np.ndarray, " t"]) -> int:
    """The number of tips that was observed most often, if any was observed; the least of several; 0 if none was."""
    times = np.bincount(np.asarray(counts, int), minlength=1)
    return int(np.argmax(times[1:])) + 1 if times[1:].any() else 0


def recognise(
    symbols: Symbols,
    codes: Int[np.ndarray, " _"],
    counts: Int[np.ndarray, " _"],
    *,
    margin: float = MARGIN,
    distance: float = 0.0,
) -> Recognition:
    """What one stroke is, from the codes and numbers of tips of its frames.

    One of no frame, or in which the hand moves for fewer than `FEWEST_STEPS` frames, is rejected, as is one that does
    not beat the threshold model.

    Args:
        symbols: Of `learn_codes` or `learn_paths`.
        codes: From 1 to 17.
        counts: From 0 to 5.
        margin: Nats a point by which the threshold model has to be beaten; nats a frame, and 0 does, for models of
            `learn_codes`.
        distance: Nats a point, or frame, by which every other symbol has to be beaten.

    Raises:
        ValueError: If a code or number is none, or there are not as many of both.
    """
    return _only(recognise_each(symbols, [(codes, counts)], margin=margin, distance=distance))


def recognise_each(symbols: Symbols, strokes: Strokes, *, margin: float = MARGIN, distance: float = 0.0) -> Recognition:
    """What many strokes are, see `recognise`; the strokes last.

    Raises:
        ValueError: If a code or number is none, or a stroke has not as many of both.
    """
    checked = [_checked(codes, counts) for codes, counts in strokes]
    moves = np.array([np.sum(codes < STILL) >= FEWEST_STEPS for codes, _ in checked], bool)
    if isinstance(symbols.models.emission, hmm.Independent):
        longest = max((len(codes) for codes, _ in checked), default=1)
        # Few lengths, few programs.
        observations, lengths = _padded(checked, 1 << max(longest - 1, 63).bit_length())
        return recognise_all(symbols, observations, np.where(moves, lengths, 0), margin=margin, distance=distance)
    drawn = [
        ([chained(codes)] if moved else [], voted(counts))
        for (codes, counts), moved in zip(checked, moves, strict=True)
    ]
    return recognise_all(symbols, to_judge(drawn, 2), margin=margin, distance=distance)


def recognise_path(
    symbols: Symbols,
    points: Float[np.ndarray, "_ 2"],
    counts: Int[np.ndarray, " _"],
    *,
    margin: float = MARGIN,
    distance: float = 0.0,
) -> Recognition:
    """What one stroke is, from the positions and numbers of tips of its frames: more certain than from codes.

    One of no frame, with a position that is not finite, or without extent is rejected, as is one that does not beat
    the threshold model.

    Args:
        symbols: Of `learn_paths`.
        points: y down, in any unit.
        counts: From 0 to 5.
        margin: Nats a point by which the threshold model has to be beaten.
        distance: Nats a point by which every other symbol has to be beaten.

    Raises:
        ValueError: If a number is none, or there are not as many as positions.
    """
    return _only(recognise_paths(symbols, [(points, counts)], margin=margin, distance=distance))


def recognise_paths(symbols: Symbols, paths: Paths, *, margin: float = MARGIN, distance: float = 0.0) -> Recognition:
    """What many strokes are, see `recognise_path`; the strokes last.

    Raises:
        ValueError: If a number is none, or a stroke has not as many as positions.
    """
    drawn = [([points], voted(_checked(np.full(len(points), STILL), counts)[1])) for points, counts in paths]
    return recognise_all(symbols, to_judge(drawn, 2), margin=margin, distance=distance)


def _only(found: Recognition) -> Recognition:
    return jax.tree.map(lambda leaf: leaf[..., 0], found)


def _checked(codes, counts) -> tuple[np.ndarray, np.ndarray]:
    codes, counts = np.asarray(codes), np.asarray(counts)
    if codes.ndim != 1 or codes.shape != counts.shape:
        raise ValueError(f"codes and counts must be (t,), as many of both; got {codes.shape} and {counts.shape}.")
    for name, values, low, high in (("codes", codes, 1, STILL), ("counts", counts, 0, MOST_TIPS)):
        if values.size and (values.dtype.kind not in "iu" or values.min() < low or values.max() > high):
            raise ValueError(f"{name} must be integers from {low} to {high}; got {values}.")
    return codes.astype(np.int32), counts.astype(np.int32)


def _padded(strokes: list[tuple[np.ndarray, np.ndarray]], length: int) -> tuple[PyTree, Int[np.ndarray, " n"]]:
    """Codes from 0 and numbers of tips, (T, n) each, and how many frames of a stroke there are."""
    if not strokes:
        return (np.zeros((length, 0), np.int32),) * 2, np.zeros(0, np.int32)
    observations, lengths = hmm.pad([(codes - 1, counts) for codes, counts in strokes], length)
    return observations, np.asarray(lengths)
