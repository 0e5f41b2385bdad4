"""The scenario of samplers: what it refuses, and what it measures on small problems."""

import pytest

from jaxfilters.benchmarks.scenarios import _sampling_peers, sampling
from jaxfilters.benchmarks.scenarios._sampling_problems import Sizes

SMALL = Sizes(6, 8, 3, 4, 8, 8, 1, 32, 2)


@pytest.mark.system
def test_without_peers_only_this_library_is_timed(monkeypatch, capsys):
    monkeypatch.setattr(_sampling_peers, "installed", list)
    monkeypatch.setattr(sampling, "SIZES", SMALL)
    metrics = sampling.run(quick=True, seed=0, out=None)
    assert set(metrics) == {"gibbs_ms_ours", "smc2_ms_ours", "tempered_ms_ours"}
    assert "blackjax, particles, smcx" in capsys.readouterr().out


def test_a_library_that_computes_something_else_is_not_timed():
    right = lambda seed: float(seed % 2)
    sampling.check("any", {"ours": right, "other": right})
    with pytest.raises(RuntimeError, match="any: other finds 3"):
        sampling.check("any", {"ours": right, "other": lambda seed: 3.0})
