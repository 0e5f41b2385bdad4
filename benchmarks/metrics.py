"""What a scenario measures, as a table for people and as JSON for comparisons."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

Direction = Literal["lower", "higher"]
WITHIN_TWO_SIGMA = 0.954
"""Share of a normal distribution within two standard deviations of its mean."""


@dataclass(frozen=True)
class Metric:
    """One measured number."""

    value: float
    unit: str
    """As in "ms", "mm", "frames/s"; empty for ratios and probabilities."""
    better: Direction | float
    """Which direction is an improvement, or the value that is right, as for the coverage of standard deviations."""


def table(metrics: Mapping[str, Metric]) -> str:
    """One aligned line a metric: name, value, unit, better direction or right value."""
    header = ("metric", "value", "unit", "better")
    cells = [(name, f"{m.value:.4g}", m.unit, shown_better(m.better)) for name, m in metrics.items()]
    return aligned([header, *cells], numbers=(1,))


def shown_better(better: Direction | float) -> str:
    """A direction as it is, a right value with the digits that it needs."""
    return better if isinstance(better, str) else f"{better:g}"


def aligned(rows: Sequence[tuple[str, ...]], *, numbers: Collection[int]) -> str:
    """Rows of words below one another, the first one underlined; `numbers` are the columns that end flush."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [_line(row, widths, numbers) for row in rows]
    return "\n".join([lines[0], "  ".join("-" * width for width in widths), *lines[1:]])


def report(scenario: str, metrics: Mapping[str, Metric], environment: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON document of one run."""
    return {
        "scenario": scenario,
        "metrics": {n: {"value": _as_json(m.value), "unit": m.unit, "better": m.better} for n, m in metrics.items()},
        "environment": dict(environment),
    }


def _as_json(value: float) -> float | str:
    """JSON has no infinity and no NaN: they are the words that `float` reads."""
    return float(value) if math.isfinite(value) else str(float(value))


def _line(row: tuple[str, ...], widths: Sequence[int], numbers: Collection[int]) -> str:
    padded = [
        word.rjust(width) if i in numbers else word.ljust(width)
        for i, (word, width) in enumerate(zip(row, widths, strict=True))
    ]
    return "  ".join(padded).rstrip()
