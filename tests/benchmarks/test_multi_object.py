import itertools

import numpy as np
import pytest

from jaxfilters.benchmarks.multi_object import evaluate, floor_tracks, match

SEEDS = range(12)


def random_case(seed, *, people=3, frames=6, spread=2.0, lost=0.25):
    """People and estimates of them that are noisy, incomplete, sometimes exchanged and sometimes invented."""
    rng = np.random.default_rng(seed)
    truth, estimate = [], []
    paths = rng.uniform(0, spread, (people, 1, 2)) + np.cumsum(rng.normal(0, 0.2, (people, frames, 2)), axis=1)
    names = np.arange(people) + 10
    for t in range(frames):
        if rng.random() < 0.3:
            names[rng.permutation(people)[:2]] = names[rng.permutation(people)[:2]] if rng.random() < 0.5 else names[:2]
            names = np.where(np.bincount(names, minlength=200)[names] > 1, 100 * (t + 1) + np.arange(people), names)
        for i in rng.permutation(people):
            if rng.random() > 0.1:
                truth.append((t, i, *paths[i, t]))
            if rng.random() > lost:
                estimate.append((t, names[i], *(paths[i, t] + rng.normal(0, 0.4, 2))))
        if rng.random() < 0.3:
            estimate.append((t, 10**6 + t, *rng.uniform(0, spread, 2)))
    return tracks(truth), tracks(estimate)


def tracks(rows):
    table = np.array(rows, float).reshape(-1, 4)
    return floor_tracks(table[:, 0], table[:, 1], table[:, 2:])


def all_pairings(n, m):
    """Every one-to-one pairing of some of n with some of m, as lists of (i, j)."""
    for size in range(min(n, m) + 1):
        for left in itertools.combinations(range(n), size):
            for right in itertools.permutations(range(m), size):
                yield list(zip(left, right, strict=True))


def enumerated_scores(truth, estimate, gate_m):
    """MOTA in counts and the distances of pairs by trying every pairing of every frame."""
    last, switches, distances = {}, 0, []
    misses = false_positives = 0
    for t in np.union1d(truth.frame, estimate.frame):
        people, found = np.flatnonzero(truth.frame == t), np.flatnonzero(estimate.frame == t)
        kept, best = [], []
        for i in people:
            for j in found:
                near = np.hypot(*(truth.xy_m[i] - estimate.xy_m[j])) <= gate_m
                if near and last.get(truth.identity[i]) == estimate.identity[j] and j not in [b for _, b in kept]:
                    kept.append((i, j))
        people = [i for i in people if i not in [a for a, _ in kept]]
        found = [j for j in found if j not in [b for _, b in kept]]
        for pairing in all_pairings(len(people), len(found)):
            pairs = [(people[a], found[b]) for a, b in pairing]
            lengths = [np.hypot(*(truth.xy_m[i] - estimate.xy_m[j])) for i, j in pairs]
            if all(length <= gate_m for length in lengths):
                best.append((-len(pairs), sum(lengths), pairs))
        pairs = kept + min(best)[2]
        for i, j in pairs:
            who, name = truth.identity[i], estimate.identity[j]
            switches += who in last and last[who] != name
            last[who] = name
            distances.append(np.hypot(*(truth.xy_m[i] - estimate.xy_m[j])))
        misses += len(people) + len(kept) - len(pairs)
        false_positives += len(found) + len(kept) - len(pairs)
    return misses, false_positives, switches, np.mean(distances)


def enumerated_idf1(truth, estimate, gate_m):
    who, names = np.unique(truth.identity), np.unique(estimate.identity)
    best = 0
    for pairing in all_pairings(len(who), len(names)):
        common = 0
        for a, b in pairing:
            for i in np.flatnonzero(truth.identity == who[a]):
                for j in np.flatnonzero((estimate.identity == names[b]) & (estimate.frame == truth.frame[i])):
                    common += np.hypot(*(truth.xy_m[i] - estimate.xy_m[j])) <= gate_m
        best = max(best, common)
    return 200 * best / (len(truth.frame) + len(estimate.frame))


@pytest.mark.parametrize("seed", SEEDS)
def test_counts_are_those_of_the_best_among_all_pairings(seed):
    truth, estimate = random_case(seed)
    scores = evaluate(truth, estimate, gate_m=0.7)
    misses, false_positives, switches, mean_error_m = enumerated_scores(truth, estimate, 0.7)
    assert (scores.misses, scores.false_positives, scores.id_switches) == (misses, false_positives, switches)
    np.testing.assert_allclose(scores.mean_error_m, mean_error_m, rtol=1e-12)
    wrong = misses + false_positives + switches
    np.testing.assert_allclose(scores.mota, 100 * (1 - wrong / len(truth.frame)), rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_identities_are_those_of_the_best_assignment_throughout(seed):
    truth, estimate = random_case(seed, people=2, frames=4)
    scores = evaluate(truth, estimate, gate_m=0.7)
    np.testing.assert_allclose(scores.idf1, enumerated_idf1(truth, estimate, 0.7), rtol=1e-12)
    np.testing.assert_allclose(scores.idf1, 2 / (1 / scores.idp + 1 / scores.idr), rtol=1e-12)


# Of motmetrics 1.4.0: IDF1, IDP, IDR, MOTA in percent, MOTP in metres, switches, false positives, misses,
# fragmentations, objects, mostly tracked, mostly lost.
OF_MOTMETRICS = (
    (28.571428571, 30.4, 26.95035461, 41.134751773, 0.479945527, 50, 42, 74, 47, 8, 1, 0),
    (54.748603352, 59.036144578, 51.041666667, 53.819444444, 0.464510348, 32, 31, 70, 48, 8, 1, 0),
    (30.095238095, 32.37704918, 28.113879004, 38.790035587, 0.490604756, 57, 39, 76, 44, 8, 2, 0),
    (35.160680529, 38.429752066, 32.404181185, 36.236933798, 0.504090645, 46, 46, 91, 60, 8, 1, 0),
)


@pytest.mark.parametrize(("seed", "theirs"), list(enumerate(OF_MOTMETRICS)))
def test_scores_equal_those_of_motmetrics(seed, theirs):
    truth, estimate = random_case(seed, people=8, frames=40, spread=5.0)
    scores = evaluate(truth, estimate)
    names = ("idf1", "idp", "idr", "mota", "mean_error_m", "id_switches", "false_positives", "misses")
    names += ("fragmentations", "people", "mostly_tracked", "mostly_lost")
    np.testing.assert_allclose([getattr(scores, name) for name in names], theirs, rtol=1e-8)


def test_whoever_is_within_reach_keeps_the_identity_although_another_is_nearer():
    truth = tracks([(0, 1, 0, 0), (1, 1, 0, 0)])
    estimate = tracks([(0, 7, 0.1, 0), (1, 8, 0.1, 0), (1, 7, 0.9, 0)])
    assert estimate.identity[match(truth, estimate).estimate].tolist() == [7, 7]
    assert evaluate(truth, estimate).id_switches == 0


def test_localisation_does_not_depend_on_identities():
    """Side by side, 0.6 m apart; only identity 8 is found in the first frame, 0.7 m from person 1."""
    truth = tracks([(0, 1, 0, 0), *((t, who, t, 0.6 * (who - 1)) for t in range(1, 5) for who in (1, 2))])
    beside = [(t, who + 6, t, 0.6 * (who - 1) + 0.1) for t in range(1, 5) for who in (1, 2)]
    estimate = tracks([(0, 8, 0, 0.7), *beside])
    scores = evaluate(truth, estimate)
    np.testing.assert_allclose(scores.mean_error_m, (0.7 + 4 * (0.7 + 0.5)) / 9)
    np.testing.assert_allclose(scores.localisation_error_m, (0.7 + 8 * 0.1) / 9)
    renamed = evaluate(truth, estimate._replace(identity=np.arange(len(estimate.frame))))
    assert renamed.localisation_error_m == scores.localisation_error_m


def test_as_many_as_possible_are_paired():
    """The nearest pair alone would leave the second person without a partner."""
    truth, estimate = tracks([(0, 1, 0, 0), (0, 2, 0.9, 0)]), tracks([(0, 5, 0.1, 0), (0, 6, -0.9, 0)])
    scores = evaluate(truth, estimate)
    assert (scores.misses, scores.false_positives) == (0, 0)


def test_a_perfect_track_and_no_track():
    truth, _ = random_case(0)
    perfect = evaluate(truth, truth._replace(identity=truth.identity + 50), camera_xy_m=(-5, 0))
    assert (perfect.mota, perfect.idf1, perfect.mean_error_m, perfect.mostly_tracked) == (100, 100, 0, perfect.people)
    assert perfect.radial_error_m == perfect.lateral_error_m == 0
    nothing = evaluate(truth, tracks([]), camera_xy_m=(-5, 0))
    assert (nothing.mota, nothing.idf1, nothing.misses, nothing.mostly_lost) == (0, 0, len(truth.frame), nothing.people)
    assert np.isnan([nothing.mean_error_m, nothing.idp, nothing.radial_error_m]).all()


def test_gaps_are_counted_as_fragments_and_the_ends_are_not():
    truth = tracks([(t, 3, 0, 0) for t in range(10)])
    estimate = tracks([(t, 1, 0, 0) for t in (1, 2, 4, 5, 8)])
    scores = evaluate(truth, estimate)
    assert (scores.fragmentations, scores.mostly_tracked, scores.mostly_lost) == (2, 0, 0)


def test_errors_along_and_across_the_line_of_sight():
    """The camera looks along (3, 4) / 5; to its left lies (-4, 3) / 5."""
    truth = tracks([(0, 1, 3, 4), (1, 1, 6, 8)])
    estimate = tracks([(0, 1, 3 + 0.06, 4 + 0.08), (1, 1, 6 - 0.04 * 4, 8 + 0.04 * 3)])
    scores = evaluate(truth, estimate, camera_xy_m=(0, 0))
    np.testing.assert_allclose([scores.radial_error_m, scores.radial_bias_m], [0.05, 0.05], atol=1e-12)
    np.testing.assert_allclose([scores.lateral_error_m, scores.lateral_bias_m], [0.1, 0.1], atol=1e-12)


def test_rows_outside_the_area_count_on_neither_side():
    frame, identity, xy_m = [0, 0, 1], [1, 2, 1], [[0, 0], [5, 5], [0, 1]]
    inside = floor_tracks(frame, identity, xy_m, in_area=[True, False, True])
    assert inside.identity.tolist() == [1, 1]
    scores = evaluate(inside, floor_tracks(frame, identity, xy_m, in_area=[1, 0, 0]))
    assert (scores.misses, scores.false_positives, scores.people) == (1, 0, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 1], [1], [[0, 0], [1, 1]]), r"one row each; got \(2, 1, 2, 2\) rows"),
        (([0, 4], [1, 1], [[0, 0], [np.nan, 1]]), "xy_m must be finite; frame 4 is not"),
        (([0, 3, 3], [1, 2, 2], np.zeros((3, 2))), "identity 2 stands twice in frame 3"),
    ],
)
def test_wrong_rows_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        floor_tracks(*arguments)


def test_wrong_questions_are_named():
    truth, estimate = random_case(0)
    with pytest.raises(ValueError, match="gate_m must be positive"):
        evaluate(truth, estimate, gate_m=0.0)
    with pytest.raises(ValueError, match="truth must have at least one row"):
        evaluate(tracks([]), estimate)


@pytest.mark.data
def test_real_paths_with_one_exchange(data_dir):
    """Two people of the recording exchange names once: two switches, all else perfect."""
    rows = np.genfromtxt(data_dir / "pets09_s2l1_view001" / "gt_0_399.csv", delimiter=",", names=True, dtype=None)
    truth = floor_tracks(rows["frame"], rows["id"], np.stack([rows["x_m"], rows["y_m"]], axis=1))
    exchanged = np.select([truth.identity == 9, truth.identity == 13], [13, 9], truth.identity)
    names = np.where(truth.frame >= 200, exchanged, truth.identity)
    scores = evaluate(truth, truth._replace(identity=names), gate_m=0.05)
    assert (scores.misses, scores.false_positives, scores.mean_error_m) == (0, 0, 0)
    assert scores.id_switches == 2
    assert 100 > scores.idf1 > 100 * (1 - np.isin(truth.identity, [9, 13]).mean())


def test_an_identity_that_is_handed_to_another_person_is_a_transfer():
    """Person 1 leaves while person 2 comes: identity 7 goes over unnoticed by switches. Later 2 takes identity 8."""
    truth = tracks([(t, 1, 0.0, 0.0) for t in range(3)] + [(t, 2, 0.0, 0.0) for t in range(3, 9)])
    estimate = tracks([(t, 7, 0.1, 0.0) for t in range(6)] + [(t, 8, 0.1, 0.0) for t in range(6, 9)])
    scores = evaluate(truth, estimate)
    assert (scores.id_switches, scores.transfers, scores.misses) == (1, 1, 0)
    # An exchange of two people is two switches, and nothing more.
    both = tracks([(t, who, 3.0 * who, 0.0) for t in range(6) for who in (1, 2)])
    swapped = tracks([(t, who if t < 3 else 3 - who, 3.0 * who, 0.0) for t in range(6) for who in (1, 2)])
    scores = evaluate(both, swapped)
    assert (scores.id_switches, scores.transfers) == (2, 0)
