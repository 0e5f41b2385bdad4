import json
import math
import sys
import time

import jax.numpy as jnp
import pytest

from jaxfilters.benchmarks import scenarios
from jaxfilters.benchmarks.harness import descriptions, main
from jaxfilters.benchmarks.metrics import Metric, report, table
from jaxfilters.benchmarks.timing import interleaved

SCENARIO = '''"""Two numbers, quickly.

More about them.
"""
from jaxfilters.benchmarks.metrics import Metric


def run(*, quick, seed, out):
    if out is not None:
        (out / "plot.txt").write_text("plot")
    return {"frame_ms": Metric(12.5 if quick else 25.0, "ms", "lower"), "seed_given": Metric(float(seed), "", "higher")}
'''


@pytest.fixture(autouse=True)
def only_these_scenarios(tmp_path, monkeypatch):
    folder = tmp_path / "scenarios"
    folder.mkdir()
    (folder / "two_numbers.py").write_text(SCENARIO)
    (folder / "needs_more.py").write_text('"""Needs a package."""\nimport a_package_that_nobody_has\n')
    monkeypatch.setattr(scenarios, "__path__", [str(folder)])
    monkeypatch.setenv("XLA_FLAGS", "")
    yield
    for name in ("two_numbers", "needs_more"):
        sys.modules.pop(f"{scenarios.__name__}.{name}", None)


def test_scenarios_are_found_by_their_files():
    assert descriptions() == {"needs-more": "Needs a package.", "two-numbers": "Two numbers, quickly."}


def test_a_scenario_prints_its_table_and_writes_its_numbers(tmp_path, capsys):
    arguments = ["two-numbers", "--quick", "--seed", "7", "--json", str(tmp_path / "r.json"), "--out", str(tmp_path)]
    assert main(arguments) == 0
    assert "frame_ms     12.5  ms    lower" in capsys.readouterr().out
    document = json.loads((tmp_path / "r.json").read_text())
    assert document["scenario"] == "two-numbers"
    assert document["metrics"] == {
        "frame_ms": {"value": 12.5, "unit": "ms", "better": "lower"},
        "seed_given": {"value": 7.0, "unit": "", "better": "higher"},
    }
    assert {"python", "jax", "numpy", "cpu", "cores", "device"} <= set(document["environment"])
    assert (tmp_path / "plot.txt").exists()


def test_numbers_that_are_not_finite_are_words_in_json():
    document = report("a", {"gap": Metric(float("inf"), "m", "lower"), "share": Metric(float("nan"), "", 1.0)}, {})
    found = json.loads(json.dumps(document, allow_nan=False))["metrics"]
    assert [float(one["value"]) for one in found.values()] == pytest.approx([math.inf, math.nan], nan_ok=True)


def test_files_of_runs_become_a_page(tmp_path, capsys):
    assert main(["two-numbers", "--json", str(tmp_path / "r.json")]) == 0
    capsys.readouterr()
    assert main(["--report", str(tmp_path)]) == 0
    page = capsys.readouterr().out
    assert "## two-numbers\n\nTwo numbers, quickly.\n\n`jaxfilters bench two-numbers`. 20" in page
    assert "| `frame_ms` | 25 | ms | lower |" in page
    assert "| `seed_given` | 0 | - | higher |" in page


def test_runs_on_a_cpu_and_on_a_gpu_stand_apart(tmp_path, capsys):
    assert main(["two-numbers", "--json", str(tmp_path / "r.json")]) == 0
    document = json.loads((tmp_path / "r.json").read_text())
    document["environment"] |= {"backend": "gpu", "device": "NVIDIA H200"}
    (tmp_path / "r-h200.json").write_text(json.dumps(document))
    capsys.readouterr()
    assert main(["--report", str(tmp_path)]) == 0
    headings = [line for line in capsys.readouterr().out.splitlines() if line.startswith("## two")]
    assert sorted(headings) == ["## two-numbers", "## two-numbers on NVIDIA H200"]


def test_a_page_of_nothing_or_of_other_files_is_refused(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "other.json").write_text("[1, 2]")
    for path, words in (("empty", "found none"), ("other.json", "expected the file of a run"), ("none", "cannot be")):
        assert main(["--report", str(tmp_path / path)]) == 2
        assert words in capsys.readouterr().err
    for arguments in ([], ["two-numbers", "--report", str(tmp_path)]):
        with pytest.raises(SystemExit, match="2"):
            main(arguments)


def test_help_lists_the_scenarios(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "two-numbers      Two numbers, quickly." in capsys.readouterr().out


def test_mistakes_are_named(tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["three-numbers"])
    assert "invalid choice: 'three-numbers'" in capsys.readouterr().err
    assert main(["needs-more"]) == 2
    expected = "needs-more needs a_package_that_nobody_has: pip install 'jaxfilters[bench]'"
    assert expected in capsys.readouterr().err
    assert main(["two-numbers", "--json", str(tmp_path / "missing" / "r.json")]) == 2
    assert "--json: no folder" in capsys.readouterr().err
    (tmp_path / "taken").touch()
    assert main(["two-numbers", "--out", str(tmp_path / "taken")]) == 2
    assert "--out: no folder" in capsys.readouterr().err


def test_the_columns_of_the_table_are_aligned():
    lines = table({"a": Metric(1.0, "ms", "lower"), "much_longer": Metric(123456.0, "frames/s", "higher")}).splitlines()
    assert lines == [
        "metric           value  unit      better",
        "-----------  ---------  --------  ------",
        "a                    1  ms        lower",
        "much_longer  1.235e+05  frames/s  higher",
    ]


def test_times_are_medians_of_awaited_calls_in_alternating_order(monkeypatch):
    calls, now = [], [0.0]
    durations = {"a": [100, 1, 2, 9, 3, 4], "b": [100, 10, 20, 90, 30, 40]}

    def make(name):
        def call():
            calls.append(name)
            now[0] += durations[name].pop(0)
            return jnp.zeros(2)

        return call

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    assert interleaved({"a": make("a"), "b": make("b")}, 5) == {"a": 3.0, "b": 30.0}
    assert "".join(calls) == "ab" + "ab" + "ba" + "ab" + "ba" + "ab"
    with pytest.raises(ValueError, match="rounds must be at least 1; got 0"):
        interleaved({}, 0)
