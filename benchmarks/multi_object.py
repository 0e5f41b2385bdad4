"""How well people on a floor were followed: CLEAR-MOT and identity metrics of points in metres."""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

GATE_M = 1.0
"""How far an estimate may be from a person to count as that person."""
MOSTLY_TRACKED, MOSTLY_LOST = 0.8, 0.2
"""Shares of a person's frames from which, and below which, the person counts as such."""


class FloorTracks(NamedTuple):
    """Positions with identities, one row for each person and frame; `floor_tracks` makes checked ones."""

    frame: Int[np.ndarray, " n"]
    """Frame numbers, in increasing order."""
    identity: Int[np.ndarray, " n"]
    """Who it is; at most one row a frame."""
    xy_m: Float[np.ndarray, "n 2"]
    """Positions on the floor in metres."""


class Matches(NamedTuple):
    """Which row of the truth goes with which row of the estimate, frame by frame."""

    truth: Int[np.ndarray, " m"]
    """Row of the truth."""
    estimate: Int[np.ndarray, " m"]
    """Row of the estimate."""
    is_switch: Bool[np.ndarray, " m"]
    """Whether the person had another identity when matched last."""


class MultiObjectScores(NamedTuple):
    """CLEAR-MOT (Bernardin & Stiefelhagen 2008) and identity metrics (Ristani et al. 2016)."""

    mota: float
    """Accuracy in percent: 100 (1 - (misses + false positives + switches) / rows of truth); may be negative."""
    mean_error_m: float
    """Mean distance of matched pairs in metres (MOTP); NaN without any."""
    localisation_error_m: float
    """Mean distance in metres of pairs that are chosen in each frame alone; NaN without any. It is smaller than
    `mean_error_m` where two people walk closer together than the gate and one of them was matched with the other's
    identity before: CLEAR-MOT then keeps both wrong pairs."""
    idf1: float
    """Harmonic mean of `idp` and `idr`, in percent."""
    idp: float
    """Share of the estimates that bear the right identity, in percent."""
    idr: float
    """Share of the truth that is found under the right identity, in percent."""
    id_switches: int
    """How often a person is matched with another identity than last time."""
    transfers: int
    """How often an identity is matched with another person than last time where that person has no other identity so
    far: one who takes over the identity of another, which `id_switches` does not count."""
    false_positives: int
    """Estimates without a person."""
    misses: int
    """People without an estimate."""
    fragmentations: int
    """How often a person is lost and found again later."""
    mostly_tracked: int
    """People who are matched in at least 80 percent of their frames."""
    mostly_lost: int
    """People who are matched in less than 20 percent of their frames."""
    people: int
    """Identities in the truth."""
    radial_error_m: float
    """Mean absolute error along the line of sight, on the floor, in metres; NaN where no camera is given."""
    lateral_error_m: float
    """Mean absolute error across the line of sight, on the floor, in metres; NaN where no camera is given."""
    radial_bias_m: float
    """Mean error along the line of sight, positive where estimates are too far, in metres."""
    lateral_bias_m: float
    """Mean error across the line of sight, positive to the left of it, in metres."""


def floor_tracks(
    frame: Sequence | np.ndarray,
    identity: Sequence | np.ndarray,
    xy_m: Sequence | np.ndarray,
    *,
    in_area: Sequence | np.ndarray | None = None,
) -> FloorTracks:
    """Checked rows, ordered by frame; rows of one frame keep their order.

    Args:
        frame: (n,) frame numbers.
        identity: (n,) numbers of people.
        xy_m: (n, 2) positions in metres.
        in_area: (n,) whether a row counts at all, as where only part of the floor is annotated; all by default.

    Raises:
        ValueError: for wrong shapes, positions that are not finite, or an identity twice in a frame.
    """
    frames, identities = np.asarray(frame).reshape(-1), np.asarray(identity).reshape(-1)
    positions = np.asarray(xy_m, float).reshape(-1, 2)
    counts = np.ones(len(frames), bool) if in_area is None else np.asarray(in_area).astype(bool).reshape(-1)
    if not len(frames) == len(identities) == len(positions) == len(counts):
        lengths = (len(frames), len(identities), len(positions), len(counts))
        raise ValueError(f"frame, identity, xy_m and in_area must have one row each; got {lengths} rows.")
    order = np.flatnonzero(counts)[np.argsort(frames[counts], kind="stable")]
    rows = FloorTracks(frames[order].astype(np.int64), identities[order].astype(np.int64), positions[order])
    if not np.isfinite(rows.xy_m).all():
        worst = int(rows.frame[~np.isfinite(rows.xy_m).all(axis=1)][0])
        raise ValueError(f"xy_m must be finite; frame {worst} is not.")
    pairs, repeats = np.unique(np.stack([rows.frame, rows.identity]), axis=1, return_counts=True)
    if (repeats > 1).any():
        at, identity = pairs[:, np.argmax(repeats > 1)]
        raise ValueError(f"identity {identity} stands twice in frame {at}.")
    return rows


def evaluate(
    truth: FloorTracks,
    estimate: FloorTracks,
    *,
    gate_m: float = GATE_M,
    camera_xy_m: Sequence | np.ndarray | None = None,
) -> MultiObjectScores:
    """Scores of `estimate` against `truth`.

    Args:
        truth: Where the people are.
        estimate: Where a tracker says they are; any numbers for identities.
        gate_m: Largest distance of a match in metres.
        camera_xy_m: (2,) the camera above the floor, in metres, for errors along and across the line of sight.

    Raises:
        ValueError: where `truth` is empty or the gate not positive.
    """
    if len(truth.frame) == 0:
        raise ValueError("truth must have at least one row; it has none.")
    matches = match(truth, estimate, gate_m=gate_m)
    matched = len(matches.truth)
    misses, false_positives = len(truth.frame) - matched, len(estimate.frame) - matched
    switches = int(matches.is_switch.sum())
    identified = _identified(truth, estimate, gate_m)
    shares, fragmentations = _coverage(truth, matches)
    errors = estimate.xy_m[matches.estimate] - truth.xy_m[matches.truth]
    return MultiObjectScores(
        mota=100 * (1 - (misses + false_positives + switches) / len(truth.frame)),
        mean_error_m=_mean(np.linalg.norm(errors, axis=1)),
        localisation_error_m=_mean(_distances_by_frame(truth, estimate, gate_m)),
        idf1=200 * identified / (len(truth.frame) + len(estimate.frame)),
        idp=100 * identified / len(estimate.frame) if len(estimate.frame) else float("nan"),
        idr=100 * identified / len(truth.frame),
        id_switches=switches,
        transfers=_transfers(truth, estimate, matches),
        false_positives=false_positives,
        misses=misses,
        fragmentations=fragmentations,
        mostly_tracked=int((shares >= MOSTLY_TRACKED).sum()),
        mostly_lost=int((shares < MOSTLY_LOST).sum()),
        people=len(shares),
        **_errors_by_sight(errors, truth.xy_m[matches.truth], camera_xy_m),
    )


def match(truth: FloorTracks, estimate: FloorTracks, *, gate_m: float = GATE_M) -> Matches:
    """Pairs of rows, frame by frame (Bernardin & Stiefelhagen 2008, section 2.1.3).

    Whoever is still within the gate of the identity that was theirs last keeps it. The others are paired one to one:
    as many as possible, and among these pairings the one with the smallest sum of distances. As in `motmetrics`, an
    identity is remembered across frames in which the person is not matched, and of two people who claim the same one
    the earlier row has it.

    Raises:
        ValueError: where the gate is not positive.
    """
    if not gate_m > 0:
        raise ValueError(f"gate_m must be positive, in metres; got {gate_m}.")
    rows_of_truth, rows_of_estimate = _rows_by_frame(truth), _rows_by_frame(estimate)
    last: dict[int, int] = {}
    pairs: list[tuple[int, int, bool]] = []
    for frame in sorted(set(rows_of_truth) & set(rows_of_estimate)):
        people, found = rows_of_truth[frame], rows_of_estimate[frame]
        distance = cdist(truth.xy_m[people], estimate.xy_m[found])
        for i, j in _pairs_of_frame(truth.identity[people], estimate.identity[found], distance, gate_m, last):
            person, name = int(truth.identity[people[i]]), int(estimate.identity[found[j]])
            pairs.append((people[i], found[j], last.get(person, name) != name))
            last[person] = name
    columns = np.array(pairs, np.int64).reshape(-1, 3).T
    return Matches(columns[0], columns[1], columns[2].astype(bool))


def _rows_by_frame(rows: FloorTracks) -> dict[int, np.ndarray]:
    frames, first = np.unique(rows.frame, return_index=True)
    return (
        dict(zip(frames.tolist(), np.split(np.arange(len(rows.frame)), first[1:]), strict=True)) if len(first) else {}
    )


def _distances_by_frame(truth: FloorTracks, estimate: FloorTracks, gate_m: float) -> np.ndarray:
    """Metres between the pairs of every frame, paired one to one as if it were the first."""
    rows_of_truth, rows_of_estimate = _rows_by_frame(truth), _rows_by_frame(estimate)
    found: list[float] = []
    for frame in sorted(set(rows_of_truth) & set(rows_of_estimate)):
        people, others = rows_of_truth[frame], rows_of_estimate[frame]
        distance = cdist(truth.xy_m[people], estimate.xy_m[others])
        pairs = _pairs_of_frame(truth.identity[people], estimate.identity[others], distance, gate_m, {})
        found += [float(distance[pair]) for pair in pairs]
    return np.array(found)


def _pairs_of_frame(people, names, distance, gate_m, last) -> list[tuple[int, int]]:
    place = {int(name): j for j, name in enumerate(names)}
    kept: dict[int, int] = {}
    for i, person in enumerate(people.tolist()):
        j = place.get(last.get(person, -1)) if person in last else None
        if j is not None and j not in kept.values() and distance[i, j] <= gate_m:
            kept[i] = j
    free_i = [i for i in range(len(people)) if i not in kept]
    free_j = [j for j in range(len(names)) if j not in kept.values()]
    free = distance[np.ix_(free_i, free_j)]
    # A pair out of reach costs more than all pairs within reach together, so that as many as possible are within.
    beyond = gate_m * (min(free.shape, default=0) + 1) * 2
    chosen = zip(*linear_sum_assignment(np.where(free <= gate_m, free, beyond)), strict=True)
    return [*kept.items(), *((free_i[a], free_j[b]) for a, b in chosen if free[a, b] <= gate_m)]


def _identified(truth: FloorTracks, estimate: FloorTracks, gate_m: float) -> int:
    """Rows under the right identity, where every person has one identity throughout, the best such assignment.

    Ristani et al. 2016, section 4: least misses and false positives is the same as most rows in common, since
    assigning a person to nobody costs what it leaves unmatched on both sides.
    """
    common: dict[tuple[int, int], int] = defaultdict(int)
    rows_of_truth, rows_of_estimate = _rows_by_frame(truth), _rows_by_frame(estimate)
    for frame in set(rows_of_truth) & set(rows_of_estimate):
        people, found = rows_of_truth[frame], rows_of_estimate[frame]
        for i, j in np.argwhere(cdist(truth.xy_m[people], estimate.xy_m[found]) <= gate_m):
            common[int(truth.identity[people[i]]), int(estimate.identity[found[j]])] += 1
    row_of = {identity: i for i, identity in enumerate(np.unique(truth.identity).tolist())}
    name = {identity: j for j, identity in enumerate(np.unique(estimate.identity).tolist())}
    counts = np.zeros((len(row_of), len(name)), np.int64)
    for (person, identity), number in common.items():
        counts[row_of[person], name[identity]] = number
    return int(counts[linear_sum_assignment(counts, maximize=True)].sum())


def _transfers(truth: FloorTracks, estimate: FloorTracks, matches: Matches) -> int:
    """Changes of the person behind an identity that are no switch of that person's identity."""
    last: dict[int, int] = {}
    transfers = 0
    for row, found, is_switch in zip(matches.truth, matches.estimate, matches.is_switch, strict=True):
        person, name = int(truth.identity[row]), int(estimate.identity[found])
        transfers += last.get(name, person) != person and not is_switch
        last[name] = person
    return transfers


def _coverage(truth: FloorTracks, matches: Matches) -> tuple[np.ndarray, int]:
    """Share of their frames in which people are matched, and how often they are lost in between."""
    is_matched = np.zeros(len(truth.frame), bool)
    is_matched[matches.truth] = True
    histories = [is_matched[truth.identity == identity] for identity in np.unique(truth.identity)]
    losses = 0
    for history in histories:
        observed = np.flatnonzero(history)
        losses += int((np.diff(observed) > 1).sum())
    return np.array([history.mean() for history in histories]), losses


def _errors_by_sight(errors: np.ndarray, at: np.ndarray, camera_xy_m: Sequence | np.ndarray | None) -> dict[str, float]:
    if camera_xy_m is None:
        return dict.fromkeys(("radial_error_m", "lateral_error_m", "radial_bias_m", "lateral_bias_m"), float("nan"))
    away = at - np.asarray(camera_xy_m, float)
    away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    radial, lateral = (errors * away).sum(axis=1), errors[:, 1] * away[:, 0] - errors[:, 0] * away[:, 1]
    return {
        "radial_error_m": _mean(np.abs(radial)),
        "lateral_error_m": _mean(np.abs(lateral)),
        "radial_bias_m": _mean(radial),
        "lateral_bias_m": _mean(lateral),
    }


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
