"""Ratios just measured against those of a committed baseline, `jaxfilters bench SCENARIO --gate`.

The file has an object for each scenario, of metrics with a `value` and a `tolerance`, the share of the value by which a
measurement may be worse: `{"filters": {"repeat_call_ratio": {"value": 1.2, "tolerance": 0.15}}}`. Ratios and shares
belong there; seconds depend on the machine.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from jaxfilters.benchmarks.metrics import Metric, aligned

BASELINE = Path(__file__).with_name("baseline.json")


class Bound(NamedTuple):
    """What a metric was, and how much worse it may become."""

    value: float
    tolerance: float
    """Share of `value`, at least 0."""


class Row(NamedTuple):
    """One metric of the baseline."""

    name: str
    bound: Bound
    limit: float
    """The worst that passes; NaN where nothing was measured."""
    measured: float
    """NaN where it was not."""
    verdict: Literal["ok", "worse", "missing"]


def load(path: Path, scenario: str) -> dict[str, Bound]:
    """The bounds of one scenario.

    Raises:
        ValueError: If the file cannot be read, has no such scenario, or an entry is not what it should be.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error
    bounds = found.get(scenario) if isinstance(found, dict) else None
    if not isinstance(bounds, dict) or not bounds:
        raise ValueError(f"{path}: nothing about {scenario}.")
    return {name: _bound(path, name, entry) for name, entry in bounds.items()}


def compare(bounds: Mapping[str, Bound], measured: Mapping[str, Metric]) -> list[Row]:
    """A row for every metric of the baseline; a number that is none is worse."""
    return [_row(name, bound, measured.get(name)) for name, bound in bounds.items()]


def passes(rows: list[Row]) -> bool:
    """Whether nothing is worse and something was measured; what a missing peer leaves out does not count."""
    verdicts = {row.verdict for row in rows}
    return "worse" not in verdicts and "ok" in verdicts


def table(rows: list[Row]) -> str:
    """One aligned line a metric: name, baseline, the worst that passes, what was measured, verdict."""
    header = ("metric", "baseline", "limit", "measured", "verdict")
    cells = [(r.name, *(_number(x) for x in (r.bound.value, r.limit, r.measured)), r.verdict) for r in rows]
    return aligned([header, *cells], numbers=(1, 2, 3))


def _bound(path, name, entry):
    numbers = [entry.get(field) for field in Bound._fields] if isinstance(entry, dict) else []
    proper = [isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) for x in numbers]
    if len(proper) != 2 or not all(proper) or numbers[1] < 0:
        raise ValueError(f"{path}: {name} must have a value and a tolerance of at least 0; got {entry!r}.")
    return Bound(float(numbers[0]), float(numbers[1]))


def _row(name, bound, metric):
    if metric is None:
        return Row(name, bound, math.nan, math.nan, "missing")
    right = metric.better
    sign = 1 if right == "lower" or (not isinstance(right, str) and bound.value >= right) else -1
    limit = bound.value + sign * bound.tolerance * abs(bound.value)
    if isinstance(right, str):
        passes = sign * metric.value <= sign * limit
    else:
        passes = abs(metric.value - right) <= abs(limit - right)
    return Row(name, bound, limit, metric.value, "ok" if passes else "worse")


def _number(value):
    return "" if math.isnan(value) else f"{value:.4g}"
