"""Over Ray: the shares of a cluster, and a batch on the one of this machine where Ray is installed."""

import json
import os
import sys

import pytest

from jaxfilters.trackers.app.cli import main
from jaxfilters.trackers.batch.over_ray import shares_of


def test_a_task_for_each_gpu_or_for_each_machine_without_one():
    node = lambda name, alive=True, **resources: {"NodeID": name, "Alive": alive, "Resources": resources}
    nodes = [node("a", CPU=8.0), node("b", CPU=16.0, GPU=4.0), node("c", CPU=8.0, alive=False), node("d", memory=1e9)]
    assert shares_of(nodes) == [("a", {"num_cpus": 8}), *4 * [("b", {"num_cpus": 4, "num_gpus": 1})]]


def test_without_ray_the_extra_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"])
    monkeypatch.setitem(sys.modules, "ray", None)
    (tmp_path / "manifest.json").write_text(json.dumps([{"name": "a", "tracker": "fingertips"}]))
    assert main(["batch", str(tmp_path / "manifest.json"), "--out", str(tmp_path / "out"), "--ray", "auto"]) == 2
    assert "jaxfilters[ray]" in capsys.readouterr().err


@pytest.mark.system
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_of_one_machine_tracks_and_reports(tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="needs the extra ray")
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"])
    rows = [
        {"name": "drawn", "tracker": "fingertips", "options": "--no-video --seconds 2"},
        {"name": "missing", "tracker": "hand-depth", "input": "nothing.npz"},
    ]
    (tmp_path / "manifest.json").write_text(json.dumps(rows))
    out = tmp_path / "out"
    assert main(["batch", str(tmp_path / "manifest.json"), "--out", str(out), "--ray", "local"]) == 2
    found = {row["name"]: row for row in json.loads((out / "report.json").read_text())}
    assert (found["drawn"]["status"], found["missing"]["status"]) == ("done", "failed")
    assert "nothing.npz" in found["missing"]["error"]
    assert (out / "drawn" / "track.csv").read_text().count("\n") > 10
