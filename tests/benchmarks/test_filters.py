"""The scenario of all filters: whom it asks, what it refuses to time, and what it measures without peers."""

import json
import os
import stat
import sys

import jax
import numpy as np
import pytest

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.scenarios import _filter_cases as cases
from jaxfilters.benchmarks.scenarios import _filter_models as models
from jaxfilters.benchmarks.scenarios import _filter_peers as peers
from jaxfilters.benchmarks.scenarios import filters
from jaxfilters.benchmarks.scenarios._filter_worker import Request, measure
from jaxfilters.benchmarks.timing import spent, taking_turns

TINY = Request(["resampler", "particle 1000 200"], [], rounds=1, seed=0, scale=0.05)
NAMES_OTHERS_RELY_ON = {
    "ratio_pf_n1000_to_smcx",
    "ratio_pf_n100000_to_smcx",
    "ratio_ekf_to_dynamax",
    "ratio_ekf_batched_1000_to_dynamax",
    "ratio_rbpf_shared_to_vmap",
    "ratio_rbpf_own_to_vmap",
    "ratio_resampler_n1e6_to_searchsorted",
    "ratio_hmm_forward_to_dynamax",
    "ratio_gradient_over_value",
    "repeat_call_ratio",
}


def interpreter(folder, name, script):
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.mark.system
def test_a_process_of_its_own_answers_with_metrics():
    found = filters.ask(sys.executable, TINY)
    assert found["resampler_n1e6_mismatch_ours"].value < 1e-3
    for name in ("ratio_resampler_n1e6_to_searchsorted", "pf_n1000_ns_per_particle_step", "pf_n1000_wall_ms_ours"):
        assert isinstance(found[name].value, float)
        assert found[name].value > 0
    assert not any("smcx" in name for name in found)


@pytest.mark.system
def test_a_process_that_fails_is_an_error():
    with pytest.raises(RuntimeError, match="failed to measure"):
        filters.ask(sys.executable, TINY._replace(tasks=["no_such_task"]))


def test_the_first_interpreter_that_has_a_peer_measures_it(tmp_path, monkeypatch):
    pythons = [
        interpreter(tmp_path, name, f"echo warning; echo '{json.dumps(found)}'")
        for name, found in (("a", []), ("b", ["dynamax", "smcx"]), ("c", ["smcx", "particles"]), ("d", ["smcx"]))
    ]
    monkeypatch.setattr(sys, "executable", pythons[0])
    monkeypatch.setenv("JAXFILTERS_PEERS", os.pathsep.join(pythons[1:]))
    assert filters.peers_of_interpreters() == {pythons[1]: ["dynamax", "smcx"], pythons[2]: ["particles"]}
    monkeypatch.setenv("JAXFILTERS_PEERS", "")
    assert filters.peers_of_interpreters() == {pythons[0]: []}


def test_peers_that_nobody_has_are_named_and_every_setting_is_asked_for(monkeypatch, capsys):
    asked = []

    def ask(python, request, cores=1):
        asked.append((python, request.float64, request.clock, cores, tuple(request.tasks)))
        if request.tasks[0].startswith("first_call"):
            what, library = request.tasks[0].split()[1:]
            return {f"first_call_s_{what}_{library}": Metric(2.0 if library == "ours" else 4.0, "s", "lower")}
        return {f"ratio_{len(asked)}": Metric(1.0, "", "lower")}

    monkeypatch.setattr(filters, "peers_of_interpreters", lambda: {"python": ["dynamax", "cuthbert", "particles"]})
    monkeypatch.setattr(filters, "ask", ask)
    monkeypatch.setattr(filters, "available_cores", lambda: 2)
    found = filters.run(quick=False, seed=0, out=None)
    assert "missing below: smcx" in capsys.readouterr().out
    assert set(found) >= {"ratio_1", "ratio_3_float64", "ratio_4_two_cores"}
    assert [row[1:4] for row in asked[2:4]] == [(True, "processor", 1), (False, "wall", 2)]
    first_calls = [row[4] for row in asked if row[4][0].startswith("first_call")]
    assert ("first_call ekf dynamax",) in first_calls
    assert ("first_call pf ours",) in first_calls
    assert ("first_call pf smcx",) not in first_calls
    assert found["ratio_first_call_ekf_to_dynamax"].value == 0.5
    assert "ratio_first_call_pf_to_smcx" not in found


def test_particle_filters_that_compute_something_else_are_not_timed():
    noisy = lambda key: 10 + jax.random.normal(key)
    cases._check_particles({"ours": noisy, "other": lambda key: noisy(jax.random.fold_in(key, 1))}, 8)
    with pytest.raises(RuntimeError, match="ours and other differ"):
        cases._check_particles({"ours": noisy, "other": lambda key: noisy(key) + 5}, 8)


def test_processor_time_is_not_time_that_passes(monkeypatch):
    import time

    once = spent(lambda: time.sleep(0.05))
    assert once.wall >= 0.05
    assert once.processor < once.wall
    calls = []
    turns = taking_turns({name: lambda name=name: calls.append(name) for name in "ab"}, 3)
    assert "".join(calls) == "ab" + "ba" + "ab"
    assert [len(of) for of in turns.values()] == [3, 3]
    with pytest.raises(ValueError, match="rounds must be at least 1; got 0"):
        taking_turns({}, 0)


@pytest.mark.parametrize("name", ["smcx", "cuthbert", "particles"])
def test_a_peer_that_is_installed_agrees(name):
    if name not in peers.installed():
        pytest.skip(f"{name} is not installed")
    found = measure(TINY._replace(tasks=["particle 1000 200"], peers=[name]))
    assert found[f"ratio_pf_n1000_to_{name}"][0] > 0


@pytest.mark.system
def test_tasks_compute_in_the_precision_that_is_asked_for():
    double = measure(TINY._replace(tasks=["resampler"], float64=True))
    assert double["resampler_n1e6_mismatch_searchsorted"][0] < 1e-6


@pytest.mark.system
def test_all_tasks_without_peers():
    found = measure(TINY._replace(tasks=filters.GAUSSIAN + filters.REST))
    of_peers = {name for name in NAMES_OTHERS_RELY_ON if name.endswith(("smcx", "dynamax"))}
    assert set(found) >= NAMES_OTHERS_RELY_ON - of_peers
    assert all(np.isfinite(value) for value, _, _ in found.values())


@pytest.mark.system
@pytest.mark.parametrize("what", ["ekf", "pf"])
def test_first_calls_are_timed(what):
    found = measure(TINY._replace(tasks=[f"first_call {what} ours"]))
    assert found[f"first_call_s_{what}_ours"][0] > 0


def test_readings_are_those_of_their_models():
    drift, mixed = models.drift(0, 50), models.mixed(0, 3, 6, 50)
    distances = np.linalg.norm(np.asarray(drift.model.beacons), axis=1)
    assert drift.readings.shape == (50, 3)
    assert abs(np.asarray(drift.readings)[0] - distances).max() < 5
    assert mixed.readings.shape == (50, 3)
    assert abs(np.asarray(mixed.readings)).max() < np.pi / 2 + 6 * 0.2
