"""Symbols recognised from direction codes and numbers of tips, and from paths; strokes that are none; bad arguments."""

import numpy as np
import pytest

from jaxfilters.models.gesture import coded
from jaxfilters.models.gesture.codes import STILL
from jaxfilters.models.gesture.symbols import extended
from jaxfilters.models.synthetic.strokes import drawn, tracked

SHAPES = ("caret", "square", "L")


def collection(seed, num_trials, shapes=SHAPES):
    """Codes and paths, each with numbers of tips, and labels."""
    found = tracked(drawn(seed, num_trials, shapes=shapes))
    return found.codes, found.paths, list(found.labels)


def names_of(symbols, found):
    return [symbols.names[i] if i >= 0 else None for i in np.atleast_1d(found.label)]


def right(symbols, found, labels):
    return np.mean([name == label for name, label in zip(names_of(symbols, found), labels, strict=True)])


@pytest.fixture(scope="module")
def training():
    return collection(0, 12)


@pytest.fixture(scope="module")
def others():
    return collection(1, 8)


@pytest.fixture(scope="module")
def published(training):
    strokes, _, labels = training
    return coded.learn_codes(strokes, labels, num_states=6)


@pytest.fixture(scope="module")
def shapes(training):
    _, paths, labels = training
    return coded.learn_paths(paths, labels, num_states=8)


@pytest.mark.system
def test_symbols_of_another_writer_are_recognised_from_codes(published, shapes, others):
    strokes, _, labels = others
    assert right(published, coded.recognise_each(published, strokes, margin=-10.0), labels) >= 0.93
    assert right(shapes, coded.recognise_each(shapes, strokes), labels) >= 0.97


@pytest.mark.system
def test_symbols_of_another_writer_are_recognised_from_paths(shapes, others):
    _, paths, labels = others
    found = coded.recognise_paths(shapes, paths)
    assert right(shapes, found, labels) >= 0.97
    np.testing.assert_allclose(found.confidence.sum(axis=0), 1, rtol=1e-5)


@pytest.mark.system
def test_one_stroke_is_judged_as_among_many(published, shapes, others):
    strokes, paths, _ = others
    for symbols in (published, shapes):
        many, one = coded.recognise_each(symbols, strokes[:3], margin=0.0), coded.recognise(symbols, *strokes[1])
        assert one.label.shape == ()
        np.testing.assert_allclose(one.log_likelihood, many.log_likelihood[:, 1], rtol=1e-4, atol=1e-4)
    many, one = coded.recognise_paths(shapes, paths[:3]), coded.recognise_path(shapes, *paths[1])
    assert one.label == many.label[1]


def test_published_models_are_blurred_probabilities_that_fit_what_was_counted(published):
    codes, tips = published.models.emission.parts
    np.testing.assert_allclose(np.exp(codes.log_probability).sum(axis=-1), 1, rtol=1e-5)
    np.testing.assert_allclose(np.exp(tips.log_probability).sum(axis=-1), 1, rtol=1e-5)
    most = np.exp(tips.log_probability).mean(axis=1).argmax(axis=1)
    assert [int(published.names[i][-1]) for i in published.owner] == most.tolist()


@pytest.mark.system
def test_strokes_that_are_none_are_rejected(published, shapes):
    none = [((), ()), ([1], [1]), ([STILL] * 40, [1] * 40), ([1, 2, STILL, 3], [1, 1, 1, 1])]
    strokes = [(np.array(codes, int), np.array(counts, int)) for codes, counts in none]
    for symbols in (published, shapes):
        found = coded.recognise_each(symbols, strokes, margin=-1e9)
        np.testing.assert_array_equal(found.label, -1)
        assert not np.any(np.isnan(found.confidence))
        assert coded.recognise(symbols, *strokes[0]).label == -1
        assert coded.recognise_each(symbols, []).label.shape == (0,)
    for points in (np.zeros((0, 2)), np.ones((1, 2)), np.ones((30, 2)), np.full((9, 2), np.nan)):
        assert coded.recognise_path(shapes, points, np.ones(len(points), int), margin=-1e9).label == -1


@pytest.mark.system
def test_scribbles_are_rejected(shapes):
    rng = np.random.default_rng(0)
    heading = np.cumsum(rng.normal(0, 1.5, (40, 80)), axis=1)
    scribbles = np.cumsum(5 * np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=1)
    found = coded.recognise_paths(shapes, [(points, np.ones(80, int)) for points in scribbles])
    assert np.mean(found.label < 0) >= 0.85


@pytest.mark.system
def test_codes_outside_their_range_are_refused(shapes):
    five = np.ones(5, int)
    for codes, counts, word in (
        (0 * five, five, "codes"),
        (18 * five, five, "codes"),
        (five, 6 * five, "counts"),
        (five, -five, "counts"),
        (five, five[:4], "as many"),
    ):
        with pytest.raises(ValueError, match=word):
            coded.recognise(shapes, codes, counts)
    with pytest.raises(ValueError, match="counts"):
        coded.recognise_path(shapes, np.zeros((5, 2)), 9 * five)
    with pytest.raises(ValueError, match="labels"):
        coded.learn_codes([(five, five)], [])
    with pytest.raises(ValueError, match="number 1"):
        coded.learn_codes([(five, five), (five[:0], five[:0])], ["a", "b"])


def test_codes_are_a_path_of_steps_of_equal_length():
    found = coded.chained(np.array([1, 5, STILL, 9, 13]))
    np.testing.assert_allclose(found, [(0, 0), (1, 0), (1, -1), (1, -1), (0, -1), (0, 0)], atol=1e-12)
    assert coded.chained(np.zeros(0, int)).shape == (1, 2)


def test_codes_of_a_path_do_not_depend_on_its_unit():
    points = np.array([(0, 0), (4, 0), (4, 0), (4, -3), (4.1, -3), (1, -3)])
    for scale in (1e-3, 1.0, 1e4):
        found = coded.codes_of([scale * points, points[:1], points[:0]])
        np.testing.assert_array_equal(found[0], [STILL, 1, STILL, 5, STILL, 9])
        assert [len(codes) for codes in found] == [6, 1, 0]


def test_the_number_of_tips_is_the_one_most_often_seen():
    assert coded.voted(np.array([0, 0, 0, 2, 2, 1])) == 2
    assert coded.voted(np.array([0, 0])) == 0
    assert coded.voted(np.zeros(0, int)) == 0


@pytest.mark.system
def test_a_symbol_is_added_of_five_strokes(shapes, others):
    _, paths, labels = collection(2, 5, ("Z",))
    few = [label == "Z 1" for label in labels]
    more = extended(
        shapes, coded.learn_paths([p for p, is_one in zip(paths, few, strict=True) if is_one], ["Z"] * 5, num_states=8)
    )
    strokes, _, wanted = collection(3, 6, ("Z",))
    one = [stroke for stroke, label in zip(strokes, wanted, strict=True) if label == "Z 1"]
    assert np.mean([name == "Z" for name in names_of(more, coded.recognise_each(more, one))]) >= 0.8
    strokes, _, labels = others
    assert right(more, coded.recognise_each(more, strokes), labels) >= 0.95
