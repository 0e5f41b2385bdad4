"""The render scenario: its comparison on made-up images, and its metrics of made-up times."""

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


@pytest.fixture
def timed(monkeypatch):
    """Seconds as if they had been measured, of nothing."""
    of = dict(zip((*NAMES, "embree"), (0.004, 0.003, 0.006, 0.001), strict=True))
    monkeypatch.setattr(render, "interleaved", lambda calls, rounds: {name: of[name] for name in calls})
    monkeypatch.setattr(render, "NUM_POSES", 8)


@pytest.mark.system
@pytest.mark.usefixtures("timed")
def test_times_are_compared_with_embrees_of_as_many_poses(monkeypatch):
    """Embree renders an eighth of them."""
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(render, "_embree_errors", lambda *arguments: None)
    monkeypatch.setattr(render, "_accuracy", lambda *arguments: {})
    value = {name: metric.value for name, metric in render.run(quick=True, seed=0, out=None).items()}
    assert value["frame_ms_embree"] == pytest.approx(8.0)
    assert [value[f"ratio_to_embree_{name}"] for name in NAMES] == pytest.approx([0.5, 0.375, 0.75])


@pytest.mark.system
@pytest.mark.usefixtures("timed")
def test_without_embree_only_our_own_times_remain(monkeypatch, capsys):
    monkeypatch.setattr(render.importlib.util, "find_spec", lambda name: None)
    metrics = render.run(quick=True, seed=0, out=None)
    assert {name: metric.value for name, metric in metrics.items()} == {
        f"frame_ms_{name}": pytest.approx(ms) for name, ms in zip(NAMES, (4.0, 3.0, 6.0), strict=True)
    }
    assert "embreex is not installed" in capsys.readouterr().out
