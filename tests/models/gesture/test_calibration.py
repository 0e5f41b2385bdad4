"""Confidences and margins from scores of which everything is known."""

import numpy as np
from scipy.special import softmax

from jaxfilters.models.gesture import calibration
from jaxfilters.models.gesture.calibration import Scores


def drawn(num_strokes, share, seed=0):
    """Scores whose softmax, tempered by `share`, is the probability of every symbol."""
    rng = np.random.default_rng(seed)
    log_likelihood = rng.normal(0, 3 / share, (4, num_strokes))
    probability = softmax(share * log_likelihood, axis=0)
    truth = (rng.random(num_strokes) > np.cumsum(probability, axis=0)).sum(axis=0)
    return Scores(log_likelihood, rng.normal(0.5, 0.1, num_strokes), truth)


def test_the_temperature_that_strokes_were_drawn_with_is_found():
    """Of 20 000 strokes its standard deviation over seeds is 1.1 %, so that 6 % are five of them."""
    for share in (0.02, 0.3, 1.5):
        found, lapse = calibration.softness(drawn(20_000, share))
        assert abs(found / share - 1) < 0.06
        assert lapse < 0.01


def test_strokes_that_are_any_symbol_do_not_change_the_temperature():
    """One in ten: a binomial deviation of that share is 0.2 %."""
    scores = drawn(20_000, 0.3)
    rng = np.random.default_rng(1)
    truth = np.where(rng.random(20_000) < 0.1, rng.integers(0, 4, 20_000), scores.truth)
    share, lapse = calibration.softness(scores._replace(truth=truth))
    assert abs(share / 0.3 - 1) < 0.1
    assert abs(lapse - 0.1) < 0.02


def test_confidences_of_the_right_temperature_are_calibrated_and_others_are_not():
    scores = drawn(20_000, 0.1)
    error = lambda share: calibration.calibration_error(calibration.confidences(scores, share), scores.is_right)
    # Of calibrated strokes it is sqrt(2 p (1 - p) 15 / (pi n)) at most, 0.011 for p = 0.5.
    assert error(0.1) < 0.015
    assert error(0.25) > 0.05
    assert error(0.04) > 0.05


def test_margins_are_those_of_each_symbols_own_leads():
    """Quantiles of 4000 Gaussian leads; the error of the mean less 2.5 deviations is 0.003."""
    rng = np.random.default_rng(0)
    truth = np.repeat([0, 1], 4000)
    lead = rng.normal(np.array([0.5, -0.2])[truth], np.array([0.1, 0.05])[truth])
    log_likelihood = np.where(np.arange(3)[:, None] == truth, 0.0, -1.0)
    # Strokes that are taken for another symbol do not count.
    log_likelihood[:, :10], lead[:10] = np.array([-1.0, 0.0, -1.0])[:, None], -50.0
    margins = calibration.lead_margins(Scores(log_likelihood, lead, truth))
    np.testing.assert_allclose(margins[:2], [0.5 - 2.5 * 0.1, -0.2 - 2.5 * 0.05], atol=0.015)
    # A symbol without strokes has the margin of all.
    all_leads = lead[10:]
    np.testing.assert_allclose(margins[2], all_leads.mean() - 2.5 * all_leads.std(), rtol=1e-6)


def test_impossible_strokes_do_not_count():
    scores = drawn(500, 0.1)
    worse = Scores(
        np.concatenate([scores.log_likelihood, np.full((4, 3), -np.inf)], axis=1),
        np.append(scores.lead, [-np.inf, np.nan, 0.0]),
        np.append(scores.truth, [0, 1, 2]),
    )
    np.testing.assert_allclose(calibration.fitted(worse)[0], calibration.fitted(scores)[0], rtol=1e-9)
