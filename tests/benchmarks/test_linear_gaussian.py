"""The linear-Gaussian scenario: its comparison on made-up beliefs, and its metrics."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import linear_gaussian
from jaxfilters.benchmarks.scenarios.linear_gaussian import Belief, compare


def test_a_known_difference_from_the_truth_is_reported():
    truth = Belief(jnp.zeros((4, 2)), jnp.ones((4, 2)), jnp.full(4, -1.0))
    shift = jnp.array([3.0, 4.0])
    belief = Belief(jnp.stack([jnp.zeros((4, 2)), 0 * truth.mean + shift]), 2 * jnp.ones((2, 4, 2)), jnp.zeros((2, 4)))
    row = compare(belief, truth)
    np.testing.assert_allclose(row.rms, np.sqrt([9 / 2, 16 / 2]), rtol=1e-6)
    assert row.variance_ratio == (2.0, 2.0)
    assert (row.log_evidence, row.log_evidence_std) == (0.0, 0.0)


def test_the_kalman_filter_reaches_the_steady_spread_of_the_specification():
    # Section 2.6: posterior standard deviations 0.113 and 2.27.
    truth = linear_gaussian.kalman_filter(linear_gaussian.simulate(0))
    np.testing.assert_allclose(np.sqrt(truth.variance[-1]), [0.113, 2.27], rtol=0.004)


@pytest.mark.system
def test_every_filter_has_its_row(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(linear_gaussian, "NUM_FRAMES", 5)
    metrics = linear_gaussian.run(quick=True, seed=0, out=tmp_path)
    rows = ("exact", "plug_in", "plug_in_corrected", "joint_pf")
    quantities = ("pose_rms", "velocity_rms", "pose_variance_error", "velocity_variance_error", "log_evidence_gap")
    assert set(metrics) == {f"{quantity}_{row}" for quantity in quantities for row in rows}
    assert (tmp_path / "linear_gaussian.txt").read_text() in capsys.readouterr().out
