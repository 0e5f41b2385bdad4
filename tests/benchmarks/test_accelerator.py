"""The scenario of accelerators: its programs can be compiled for CUDA, stay on the device, and have their metrics."""

import jax
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _accelerator_profile, _accelerator_tasks, accelerator

# Other libraries warn of JAX's deprecations where they are installed and imported.
pytestmark = [pytest.mark.system, pytest.mark.filterwarnings("ignore::DeprecationWarning")]

TASKS = _accelerator_tasks.tasks(0)


@pytest.mark.parametrize("name", TASKS)
def test_programs_are_lowered_for_cuda_without_a_call_to_the_host(name):
    text = accelerator.lowered_for("cuda", TASKS[name].work(TASKS[name].quick))
    assert "callback" not in text


@pytest.mark.parametrize("name", ["resampling", "bootstrap"])
def test_a_task_has_times_and_rates(name):
    size = TASKS[name].quick
    found = accelerator.measured(name, TASKS[name], quick=True)
    wanted = {f"{name}_{what}_{size}" for what in ("ms", "gflop_per_s", "gb_per_s", "mb")}
    assert wanted <= set(found)
    assert all(found[metric].value > 0 for metric in wanted)


def test_a_task_ends_with_the_size_that_takes_too_long(monkeypatch):
    monkeypatch.setattr(accelerator, "LONGEST_S", 0.0)
    found = accelerator.measured("resampling", TASKS["resampling"]._replace(sizes=(100, 200)), quick=False)
    assert "resampling_ms_100" in found
    assert "resampling_ms_200" not in found


def test_poses_in_chunks_have_the_costs_of_all_at_once(monkeypatch):
    monkeypatch.setattr(_accelerator_tasks, "CHUNK", 2)
    work = TASKS["depth_capsules"].work(4)
    in_chunks = jax.jit(work.function)(*work.arguments)
    monkeypatch.setattr(_accelerator_tasks, "CHUNK", 4)
    np.testing.assert_allclose(jax.jit(TASKS["depth_capsules"].work(4).function)(*work.arguments), in_chunks, rtol=1e-5)
    assert in_chunks.shape == (4,)


def test_a_profile_counts_the_launches_in_the_streams_of_devices_alone(tmp_path):
    name = lambda kind, pid, tid, of: {"ph": "M", "name": kind, "pid": pid, "tid": tid, "args": {"name": of}}
    ran = lambda pid, tid, kernel, us: {"ph": "X", "name": kernel, "pid": pid, "tid": tid, "ts": 0, "dur": us}
    trace = [
        {"ph": "M", "name": "process_name", "pid": 1, "args": {"name": "/device:GPU:0"}},
        {"ph": "M", "name": "process_name", "pid": 7, "args": {"name": "/host:CPU"}},
        name("thread_name", 1, 13, "Stream #13(Compute)"),
        name("thread_name", 1, 2, "XLA Modules"),
        name("thread_name", 7, 13, "Stream #13(Compute)"),
        *(ran(1, 13, "scatter", 500.0) for _ in range(4)),
        *(ran(1, 13, "fusion", 250.0) for _ in range(2)),
        ran(1, 2, "module", 9000.0),
        ran(7, 13, "python", 9000.0),
    ]
    found = _accelerator_profile.on_device(trace, calls=2)
    assert found == [("scatter", 2.0, 1.0), ("fusion", 1.0, 0.25)]
    _accelerator_profile.append(tmp_path / "profile.txt", "resampling 8", found)
    assert (tmp_path / "profile.txt").read_text().splitlines()[0] == "resampling 8: 1.2500 ms in 3 launches"


def test_a_run_goes_on_after_the_tasks_that_it_had_finished(tmp_path, monkeypatch):
    two = {name: TASKS[name] for name in ("resampling", "hidden_markov")}
    monkeypatch.setattr(accelerator, "tasks", lambda seed: two)
    found = accelerator.run(quick=True, seed=0, out=tmp_path)
    monkeypatch.setattr(accelerator, "measured", lambda *_, **__: pytest.fail("measured again"))
    assert accelerator.run(quick=True, seed=0, out=tmp_path) == found
