"""The scenario of scale: its ways agree before they are timed, and every measurement has its metrics."""

import pytest

from jaxfilters.benchmarks.scenarios import scale

pytestmark = pytest.mark.system


def test_filters_in_parallel_and_one_frame_after_the_other_agree_and_are_compared():
    metrics = scale.in_time(0, 8, 1)
    expected = {f"in_time_{name}_{what}_t8" for name in ("filter", "smoother") for what in ("ratio", "ms")}
    assert set(metrics) == expected | {"in_time_smoother_to_covariances_t8"}
    assert all(metric.value > 0 for metric in metrics.values())


def test_ways_that_disagree_are_not_timed(monkeypatch):
    wrong = lambda *arguments: scale.parallel_kalman(*arguments)[1] + 1.0
    monkeypatch.setattr(scale, "_log_evidences", wrong)
    with pytest.raises(RuntimeError, match="differ"):
        scale.in_time(0, 8, 1)


def test_transport_has_its_time_with_and_without_a_derivative():
    assert set(scale.transported(0, 12, 1)) == {"transport_ms_n12", "transport_gradient_ms_n12"}


def test_two_devices_are_asked_in_a_process_of_their_own():
    metrics = scale.on_two_devices(0, 64, 1)
    assert {"sharded_wall_ms_one_n64", "sharded_wall_ratio_two_n64", "sharded_wall_ratio_exchanging_n64"} <= set(
        metrics
    )
