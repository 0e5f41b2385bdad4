"""The scenario of gradients through resampling: its comparison on made-up gradients, its oracle, its metrics."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxfilters.benchmarks.scenarios import particle_gradients
from jaxfilters.benchmarks.scenarios.particle_gradients import AT, DT, exact_log_evidence, row, simulate


def test_bias_and_spread_are_relative_to_the_true_gradient():
    exact = np.array([3.0, 4.0, 0.0])
    found = exact + np.array([[2.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    measured = row(found, exact, 7.0)
    assert measured.bias == pytest.approx(1 / 5)
    assert measured.spread == pytest.approx(np.sqrt(2 + 2) / 5)
    assert measured.milliseconds == 7.0


@pytest.mark.system
def test_the_exact_log_evidence_is_that_of_the_joint_gaussian(x64):
    ys = simulate(1)[:6]
    rate, power, noise = AT[0], np.exp(AT[1]), np.exp(AT[2])
    F, Q = np.array([[1, DT], [0, 1 - DT * rate]]), np.diag(DT * power**2 * np.array([0.01, 1.0]))
    P, rows = np.eye(2), np.zeros((6, 6))
    for t in range(6):
        P = F @ P @ F.T + Q
        for s in range(t, 6):
            rows[t, s] = rows[s, t] = (np.linalg.matrix_power(F, s - t) @ P)[0, 0]
    expected = multivariate_normal(np.zeros(6), rows + noise**2 * np.eye(6)).logpdf(np.asarray(ys))
    np.testing.assert_allclose(exact_log_evidence(jnp.asarray(AT), ys), expected, rtol=1e-10)


@pytest.mark.system
def test_ways_have_their_rows(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(particle_gradients, "NUM_FRAMES", 3)
    monkeypatch.setattr(particle_gradients, "QUICK_SIZES", {8: 4})
    two = {name: particle_gradients.WAYS[name] for name in ("stop_gradient", "transport_0.5")}
    monkeypatch.setattr(particle_gradients, "WAYS", two)
    metrics = particle_gradients.run(quick=True, seed=0, out=tmp_path)
    assert set(metrics) == {f"{what}_{name}_n8" for what in ("bias", "spread", "time") for name in two}
    assert (tmp_path / "particle_gradients.txt").read_text() in capsys.readouterr().out
