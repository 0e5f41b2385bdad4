"""The side of the thumb from fingertips: mirrored, turned and scaled hands, and an oracle that sums over fingers."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from jaxfilters.models.fingertip.side import (
    ANGLE_SD,
    ANGLES,
    LENGTH_SD,
    LENGTHS,
    SCALE_SD,
    TURN_SD,
    side_log_odds,
)


def log_odds(angles, lengths, there):
    return float(jax.jit(side_log_odds)(*(jnp.asarray(values) for values in (angles, lengths, there))))


def by_marginals(angles, lengths):
    """The same from the joint Gaussian densities of all tips, for every choice of fingers in their order."""

    def fit(side):
        order = np.argsort(-side * angles)
        own = side * angles[order], np.log(lengths[order])
        scores = []
        for way in combinations(range(5), len(angles)):
            expected = np.array(ANGLES)[list(way)], np.log(LENGTHS)[list(way)]
            scores.append(
                sum(
                    multivariate_normal.logpdf(x, mean, sd**2 * np.eye(len(x)) + common**2)
                    for x, mean, sd, common in zip(
                        own, expected, (ANGLE_SD, LENGTH_SD), (TURN_SD, SCALE_SD), strict=True
                    )
                )
            )
        return logsumexp(scores)

    return fit(1) - fit(-1)


@pytest.mark.parametrize("fingers", [(0, 1, 2, 3, 4), (1, 2, 3, 4), (0, 1, 2, 4)])
def test_log_odds_are_those_of_gaussian_densities(fingers):
    rng = np.random.default_rng(len(fingers))
    angles = np.array(ANGLES)[list(fingers)] + rng.normal(0, 0.1, len(fingers))
    lengths = 40 * np.array(LENGTHS)[list(fingers)] * np.exp(rng.normal(0, 0.1, len(fingers)))
    order = rng.permutation(7)[: len(fingers)]
    shown = np.zeros((2, 7))
    shown[:, order] = angles, lengths
    there = np.isin(np.arange(7), order)
    found = log_odds(*shown, there)
    assert found == pytest.approx(by_marginals(angles, lengths), abs=1e-3)
    assert found > 0
    assert log_odds(-shown[0], shown[1], there) == pytest.approx(-found, abs=1e-3)


def test_three_fingers_have_no_side():
    there = np.array([True, True, True, False, False])
    assert log_odds(ANGLES, LENGTHS, there) == 0
