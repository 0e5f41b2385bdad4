import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import _smoother_peers as peers
from jaxfilters.benchmarks.scenarios import smoothers


@pytest.mark.system
def test_without_peers_it_times_this_library(monkeypatch):
    monkeypatch.setattr(peers, "installed", list)
    found = smoothers.run(quick=True, seed=0, out=None, sizes=smoothers.Sizes(8, 2, 50, 5))
    assert {f"{name}_ms_ours" for name in ("parallel_smoother", "posterior_samples", "em", "backward_sampling")} <= set(
        found
    )
    assert all(metric.value > 0 for metric in found.values())


def test_libraries_that_compute_something_else_are_not_timed():
    samples = np.random.default_rng(0).normal(size=(2, 3, 1000))
    smoothers.check_agreement("samples", {"ours": samples, "other": samples[..., ::-1] + 0.1}, None)
    with pytest.raises(RuntimeError, match="samples: ours and other differ"):
        smoothers.check_agreement("samples", {"ours": samples, "other": samples + 0.5}, None)
    with pytest.raises(RuntimeError, match="means: ours and other differ"):
        smoothers.check_agreement("means", {"ours": samples, "other": samples + 1e-2}, 1e-3)
