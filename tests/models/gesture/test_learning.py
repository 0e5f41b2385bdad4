"""Which strokes are judged by whose models, and what is made of the scores."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters import hmm
from jaxfilters.models.gesture import learning
from jaxfilters.models.gesture.calibration import Scores
from jaxfilters.models.gesture.learning import LeftOut
from jaxfilters.models.gesture.stroke import stacked, to_judge
from jaxfilters.models.gesture.symbols import Symbols, learn, recognise_all

STROKES = [([np.zeros((2, 2))], 1)] * 24
LABELS = ["a", "b"] * 12


@pytest.fixture
def asked(monkeypatch):
    """What was to be judged by models of what, in place of the models."""
    found = []

    def scores(strokes, labels, shown, own, settings):
        found.append((shown, own))
        truth = np.searchsorted(np.unique(labels), labels[own])
        return Scores(np.where(np.arange(2)[:, None] == truth, 0.0, -9.0), np.full(len(own), 0.5), truth)

    monkeypatch.setattr(learning, "_scores", scores)
    return found


@pytest.mark.parametrize("people", [["Ann"] * 24, ["Ann"] * 8 + ["Bob"] * 10 + ["Cy"] * 6, list("ABCD") * 6])
def test_every_stroke_is_judged_once_and_by_models_of_other_people(asked, people):
    scores = learning.cross_scores(STROKES, LABELS, people)
    assert len(scores.truth) == 24
    assert sorted(np.concatenate([own for _, own in asked])) == list(range(24))
    for shown, own in asked:
        assert sorted(np.concatenate([shown, own])) == list(range(24))
        if len(set(people)) > 1:
            assert not {people[i] for i in shown} & {people[i] for i in own}
        assert {LABELS[i] for i in shown} == {"a", "b"}


def test_margins_and_confidences_of_a_person_are_those_of_the_others():
    """Each symbol of the others leads by 0.5 and 0.1; these two have no spread."""
    truth = np.tile([0, 1], 10)
    log_likelihood = np.where(np.arange(2)[:, None] == truth, 0.0, -100.0)
    others = LeftOut("Ann", Scores(log_likelihood, np.array([0.5, 0.1])[truth], truth))
    own = LeftOut("Bob", Scores(log_likelihood[:, :3], np.array([0.45, 0.2, 0.6]), np.array([0, 1, 1])))
    bob = next(one for one in learning.evaluated([others, own]) if one.person == "Bob")
    np.testing.assert_array_equal(bob.right, [True, True, False])
    np.testing.assert_allclose(bob.beyond, [-0.05, 0.1, 0.1], atol=1e-9)
    assert (bob.confidence > 0.99).all()
    assert abs(learning.accuracy([bob]) - 200 / 3) < 1e-9


@pytest.mark.system
@pytest.mark.parametrize("dimensions", [2, 3])
def test_few_strokes_also_stand_for_slanted_ones(dimensions):
    """Bars with a dot, of which the examples are upright: a slanted one is likelier than by the examples alone."""
    rng = np.random.default_rng(0)
    bar, dot = np.linspace([0.0, 0, 0], [0, 9, 0], 20), np.array([[4.0, 0, 0], [5, 1, 0]])
    strokes = [([piece[:, :dimensions] + rng.normal(0, 0.1, (len(piece), dimensions)) for piece in (bar, dot)], 1)] * 6
    turn = np.eye(dimensions)
    turn[:2, :2] = [[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]]
    slanted = to_judge([([piece @ turn.T for piece in strokes[0][0]], 1)], dimensions)
    few = learning.learn_strokes(strokes, ["i"] * 6, learning.Settings(min_variance=0.01))
    alone = learn(stacked(strokes), ["i"] * 6, num_states=learning.FEW_STATES, min_variance=0.01)
    assert recognise_all(few, slanted).log_likelihood[0, 0] > recognise_all(alone, slanted).log_likelihood[0, 0] + 0.5


def test_too_few_scores_calibrate_nothing(asked):
    model = hmm.from_topology(hmm.left_right(2), hmm.DiagonalGaussian(jnp.zeros((2, 8)), jnp.ones((2, 8))))
    symbols = Symbols(model, jnp.zeros(2, jnp.int32), ("a", "b"))
    assert learning.cross_calibrated(symbols, STROKES[:19], LABELS[:19], ["Ann"] * 19) is symbols
    assert not asked
    found = learning.cross_calibrated(symbols, STROKES, LABELS, ["Ann"] * 24)
    np.testing.assert_allclose(found.margins, 0.5, atol=1e-6)
    assert found.sharpness > 0.1
    assert found.lapse < 0.01
