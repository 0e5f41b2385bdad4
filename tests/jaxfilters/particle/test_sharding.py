"""Particles on several devices against the exact Kalman filter, and against one device."""

import json
import os
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.system

SCRIPT = Path(__file__).with_name("sharded_runs.py")
QUICK_TO_COMPILE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
DT, Q_N, Q_L, STD = 0.1, 0.3, 4.0, 0.4
NUM_DEVICES = 4


def simulate(length=8):
    rng = np.random.default_rng(0)
    x, ys = rng.normal(size=2), []
    for noise in rng.normal(size=(length, 3)):
        x = x + np.array([DT * x[1] + np.sqrt(DT * Q_N) * noise[0], np.sqrt(DT * Q_L) * noise[1]])
        ys.append(x[0] + STD * noise[2])
    return ys


def kalman(ys, std=STD):
    """Textbook filter: log evidence, and the last mean of the pose."""
    F, Q = np.array([[1, DT], [0, 1]]), np.diag([DT * Q_N, DT * Q_L])
    m, P, total = np.zeros(2), np.eye(2), 0.0
    for y in ys:
        m, P = F @ m, F @ P @ F.T + Q
        S = P[0, 0] + std**2
        total -= 0.5 * ((y - m[0]) ** 2 / S + np.log(2 * np.pi * S))
        m, P = m + P[:, 0] / S * (y - m[0]), P - np.outer(P[:, 0], P[0]) / S
    return total, m[0]


def start(num_devices, *arguments):
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={num_devices} {QUICK_TO_COMPILE}"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(SCRIPT), json.dumps(simulate()), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def finish(process):
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    return json.loads(output.splitlines()[-1])


@pytest.fixture(scope="module")
def found():
    """What a process with four devices says."""
    return finish(start(NUM_DEVICES))


def check_unbiased(runs):
    """Evidence, and the posterior mean weighted by it, have the exact expectation: z-tests at 4 sigma."""
    log_evidence, mean = kalman(simulate())
    ratio = np.exp(np.asarray(runs["log_evidence"]) - log_evidence)
    assert ratio.std() < 1
    for unbiased in (ratio - 1, ratio * (np.asarray(runs["mean"]) - mean)):
        assert abs(unbiased.mean()) < 4 * unbiased.std(ddof=1) / np.sqrt(ratio.size)


@pytest.mark.parametrize("which", ["islands_0.0", "islands_0.5", "islands_1.0", "marginalised"])
def test_evidence_and_posterior_are_unbiased_however_often_islands_exchange(found, which):
    check_unbiased(found[which])


def test_placement_gives_the_numbers_of_one_device(found):
    placed = found["placement"]
    assert placed["ancestors"]
    assert placed["error"] < 1e-5
    assert placed["evidence_error"] < 1e-5
    assert placed["shard"] == [1, 1200 // NUM_DEVICES]


def test_an_exchange_is_a_permutation_of_particles_that_weigh_the_same(found):
    assert found["exchanges"]["permutation"]
    assert found["exchanges"]["moved"]


def test_an_exchange_sends_no_more_than_a_device_has(found):
    traffic = found["traffic"]
    assert set(traffic) == {"2", str(NUM_DEVICES)}
    for num_devices, of_one in traffic.items():
        # Of every particle, with its weight and its index, all but the part that stays.
        assert of_one["sent"] == pytest.approx(of_one["has"] * (1 - 1 / int(num_devices)))


def test_islands_of_like_weight_do_not_exchange_and_keep_their_shares(found):
    assert found["exchanges"]["stay"]
    # Effective number of islands of shares 1, 2, 3, 4: 10/3, above half of 4.
    np.testing.assert_allclose(found["exchanges"]["kept"], [0.1, 0.2, 0.3, 0.4], rtol=1e-5)


def test_an_island_with_all_the_weight_shares_it(found):
    assert found["exchanges"]["from_one"] == [1]
    # Of the 10 particles of an island 2 go to each device and 2 stay.
    np.testing.assert_allclose(found["exchanges"]["shares"], [0.2, 0.4, 0.2, 0.2], rtol=1e-5)


def test_when_nothing_explains_the_observation_weights_become_equal_and_evidence_says_so(found):
    dead = found["dead"]
    assert dead["log_evidence"][1] == "-inf"
    assert np.isfinite(float(dead["log_evidence"][2]))
    assert dead["effective"][1] == pytest.approx(100, rel=1e-5)
    assert dead["finite"]
    assert dead["invalid"] == [100, 100, 100]


def test_score_matches_the_exact_one(found):
    ys, step = simulate(), 1e-5
    exact = (kalman(ys, STD + step)[0] - kalman(ys, STD - step)[0]) / (2 * step)
    scores = np.asarray(found["scores"])
    # 200 estimates at N = 800; their bias is O(1/N), below the 4 sigma of the z-test.
    assert abs(scores.mean() - exact) < 4 * scores.std(ddof=1) / np.sqrt(scores.size)


def test_devices_filter_their_own_sequences_without_talking(found):
    assert found["sequences"]["devices"] == NUM_DEVICES
    assert found["sequences"]["collectives"] == []
    assert found["sequences"]["error"] < 1e-4


def test_what_does_not_fit_the_devices_is_refused(found):
    refusals = found["refusals"]
    assert "num_particles must be a multiple of the 4 devices along 'particles'; got 41" in refusals["number"]
    assert refusals["placed_number"] == refusals["number"]
    assert "axis must be one of those of the mesh, particles; got 'rows'" in refusals["axis"]
    assert "island_threshold must be a fraction of the number of devices, at least 0; got -1.0" in refusals["threshold"]
    assert "filter must not be tempered" in refusals["temper"]
    assert "multiple of the 4 devices along 'particles'; got the shape (5, 3)" in refusals["sequences"]
    assert "filter must be made by bootstrap, rao_blackwell or rao_blackwell_shared" in refusals["kind"]


def test_the_example_of_the_page_runs(root):
    page = (root / "docs" / "scale.md").read_text()
    example = {}
    exec(page.partition("<!-- example -->\n```python\n")[2].partition("```")[0], example)
    # On one device, too: the readings rise to 1 with the time.
    pose = np.average(example["state"].particles[0], weights=np.exp(example["state"].log_weights))
    assert abs(pose - 1) < 0.3


def test_two_processes_give_the_same_posterior():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = str(free.getsockname()[1])
    both = [start(2, str(rank), port) for rank in range(2)]
    with ThreadPoolExecutor() as pool:
        first, second = pool.map(finish, both)
    assert first == second
    assert first["num_devices"] == NUM_DEVICES
    check_unbiased(first["islands_0.5"])
