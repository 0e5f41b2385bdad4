"""The render scenario: its comparison on made-up images, and its metrics on a small workload."""

import numpy as np
import pytest

from jaxfilters.benchmarks.scenarios import render
from jaxfilters.benchmarks.scenarios.render import agreement

NAMES = ("capsules", "mesh", "triangles")


def test_known_disagreement_is_reported():
    ours, theirs = np.full((4, 5), np.inf), np.full((4, 5), np.inf)
    ours[:2] = 1.0
    theirs[1:3] = 1.5
    assert agreement([(ours, theirs), (ours, ours)]) == (pytest.approx(0.5 * 5 / 15), pytest.approx(15 / 25))


@pytest.mark.system
def test_fine_capsules_have_the_volume_of_capsules():
    mesh = render.hand_mesh(render.GEOMETRY)
    capsules = render.cloud(0, 2, mesh).capsules
    one = type(capsules)(*(leaf[..., 0] for leaf in (capsules.start, capsules.end, capsules.radius)))
    length = np.linalg.norm(np.asarray(one.end - one.start, float), axis=1)
    radius = np.asarray(one.radius, float)
    expected = np.pi * radius**2 * length + 4 / 3 * np.pi * radius**3
    # Merging of close vertices costs the smallest some volume: 1e-3 of it is a micrometre or two of radius.
    np.testing.assert_allclose([solid.volume for solid in render.fine_capsules(one)], expected, rtol=1e-3)


@pytest.mark.system
def test_every_metric_is_there(monkeypatch):
    pytest.importorskip("embreex")
    monkeypatch.setattr(render, "NUM_POSES", 8)
    monkeypatch.setattr(render, "ACCURACY_POSES", 1)
    metrics = render.run(quick=True, seed=0, out=None)
    expected = {f"frame_ms_{name}" for name in (*NAMES, "embree")} | {f"ratio_to_embree_{name}" for name in NAMES}
    expected |= {f"{kind}_{name}" for kind in ("depth_mean_abs_error_mm", "silhouette_iou") for name in NAMES[:2]}
    assert set(metrics) == expected
    assert metrics["depth_mean_abs_error_mm_capsules"].value < 0.1
    assert metrics["silhouette_iou_mesh"].value > 0.995


@pytest.mark.system
def test_without_embree_only_our_own_times_remain(monkeypatch, capsys):
    monkeypatch.setattr(render, "NUM_POSES", 8)  # as above: the same programs
    monkeypatch.setattr(render, "QUICK_ROUNDS", 1)
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    metrics = render.run(quick=True, seed=0, out=None)
    assert set(metrics) == {f"frame_ms_{name}" for name in NAMES}
    assert "embreex is not installed" in capsys.readouterr().out
