"""The gate: what counts as worse, and what the command makes of it."""

import json
import math
import sys

import pytest

from jaxfilters.benchmarks import gate, scenarios
from jaxfilters.benchmarks.gate import Bound
from jaxfilters.benchmarks.harness import descriptions, main
from jaxfilters.benchmarks.metrics import Metric

SCENARIO = '''"""One ratio."""
from jaxfilters.benchmarks.metrics import Metric


def run(*, quick, seed, out):
    return {"ratio": Metric(seed / 10, "", "lower")}
'''


@pytest.mark.parametrize(
    ("better", "value", "verdict"),
    [
        ("lower", 0.5, "ok"),
        ("lower", 1.2, "ok"),
        ("lower", 1.201, "worse"),
        ("lower", math.nan, "worse"),
        ("higher", 2.0, "ok"),
        ("higher", 0.8, "ok"),
        ("higher", 0.799, "worse"),
        (0.5, 1.201, "worse"),
        (0.5, 0.1, "ok"),
        (0.5, -0.201, "worse"),
        (2.0, 0.799, "worse"),
        (2.0, 2.5, "ok"),
        (2.0, 3.201, "worse"),
    ],
)
def test_worse_by_more_than_the_tolerance_is_worse(better, value, verdict):
    (row,) = gate.compare({"a": Bound(1.0, 0.2)}, {"a": Metric(value, "", better), "other": Metric(9.0, "", "lower")})
    assert row.verdict == verdict
    assert gate.passes([row]) == (verdict == "ok")


def test_what_is_missing_is_said_and_does_not_fail_alone():
    rows = gate.compare({"a": Bound(1.0, 0.1), "b": Bound(1.0, 0.1)}, {"a": Metric(1.0, "", "lower")})
    assert [row.verdict for row in rows] == ["ok", "missing"]
    assert gate.passes(rows)
    assert not gate.passes(rows[1:])
    assert gate.table(rows).splitlines() == [
        "metric  baseline  limit  measured  verdict",
        "------  --------  -----  --------  -------",
        "a              1    1.1         1  ok",
        "b              1                   missing",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not JSON", "Expecting value"),
        ('{"other": {}}', "nothing about filters"),
        ('{"filters": {"a": {"value": 1}}}', "a must have a value and a tolerance"),
        ('{"filters": {"a": {"value": 1, "tolerance": -0.1}}}', "at least 0"),
        ('{"filters": {"a": {"value": NaN, "tolerance": 0.1}}}', "a must have a value"),
        ('{"filters": {"a": 1.0}}', "got 1.0"),
    ],
)
def test_a_baseline_that_cannot_be_used_is_refused(tmp_path, text, message):
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        gate.load(path, "filters")
    with pytest.raises(ValueError, match=r"missing\.json"):
        gate.load(tmp_path / "missing.json", "filters")


def test_the_committed_baseline_names_scenarios_that_there_are():
    for scenario in json.loads(gate.BASELINE.read_text()):
        assert scenario in descriptions()
        assert gate.load(gate.BASELINE, scenario)


def test_the_command_says_by_its_exit_code_whether_something_is_worse(tmp_path, monkeypatch, capsys):
    (tmp_path / "one_ratio.py").write_text(SCENARIO)
    baseline = tmp_path / "baseline.json"
    baseline.write_text('{"one-ratio": {"ratio": {"value": 0.5, "tolerance": 0.1}}}')
    monkeypatch.setattr(scenarios, "__path__", [str(tmp_path)])
    monkeypatch.setenv("XLA_FLAGS", "")
    arguments = ["one-ratio", "--gate", "--baseline", str(baseline), "--seed"]
    assert main([*arguments, "5"]) == 0
    assert "ratio        0.5   0.55       0.5  ok" in capsys.readouterr().out
    assert main([*arguments, "6"]) == 1
    assert "worse" in capsys.readouterr().out
    baseline.write_text("{}")
    assert main([*arguments, "5"]) == 2
    assert "--gate: " in capsys.readouterr().err
    sys.modules.pop(f"{scenarios.__name__}.one_ratio", None)
