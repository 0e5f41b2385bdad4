"""What a scenario measures, as a table for people and as JSON for comparisons."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Metric:
    """One measured number."""

    value: float
    unit: str
    """As in "ms", "mm", "frames/s"; empty for ratios and probabilities."""
    better: Literal["lower", "higher"]
    """Which direction is an improvement."""


def table(metrics: Mapping[str, Metric]) -> str:
    """One aligned line a metric: name, value, unit, better direction."""
    header = ("metric", "value", "unit", "better")
    cells = [(name, f"{m.value:.4g}", m.unit, m.better) for name, m in metrics.items()]
    widths = [max(len(row[i]) for row in [header, *cells]) for i in range(len(header))]
    lines = [_line(row, widths) for row in [header, *cells]]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def report(scenario: str, metrics: Mapping[str, Metric], environment: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON document of one run."""
    return {
        "scenario": scenario,
        "metrics": {n: {"value": float(m.value), "unit": m.unit, "better": m.better} for n, m in metrics.items()},
        "environment": dict(environment),
    }


def _line(row: tuple[str, ...], widths: list[int]) -> str:
    name, value, *words = row
    padded = [word.ljust(width) for word, width in zip(words, widths[2:], strict=True)]
    return "  ".join([name.ljust(widths[0]), value.rjust(widths[1]), *padded]).rstrip()
