"""The scenario of accelerators: its programs can be compiled for CUDA, stay on the device, and have their metrics."""

import jax
import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _accelerator_tasks, accelerator

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
