"""Tables of the page of results with a row for each system or coordinate and a column for each kind of metric."""

from collections.abc import Mapping
from typing import Any, NamedTuple

_NOTE = """
A metric has the name of its column, followed by that of its row. Right are 68.3, 95.4 and 99.7 % within one, two and
three standard deviations (`coverage1_` to `coverage3_`), 1 for `nees_` and `sharpness_`, and a positive
`log_score_gain_`. `lower_` and `upper_` are the ends of the interval of a coverage, and of the band of `nees_` if the
claims are true.
"""


class _Wide(NamedTuple):
    title: str
    rows: str
    """What a row is."""
    key: str
    """Beginning of the metric that each row has."""
    columns: tuple[str, ...]
    """Beginnings of the names of metrics."""


_TABLES = (
    _Wide(
        "Standard deviations by system",
        "system and data",
        "effective_frames_",
        (
            *(f"coverage{sigma}_" for sigma in (1, 2, 3)),
            *("nees_", "lower_nees_", "upper_nees_", "log_score_", "log_score_gain_", "rmse_", "effective_frames_"),
        ),
    ),
    _Wide(
        "Standard deviations by coordinate",
        "coordinate",
        "crps_",
        (
            *("coverage1_", "coverage2_", "lower_coverage2_", "upper_coverage2_", "coverage3_"),
            *("autocorrelation_", "sharpness_", "crps_", "rmse_"),
        ),
    ),
)


def claims_tables(scenario: str, metrics: Mapping[str, Mapping[str, Any]]) -> tuple[str, dict[str, Mapping[str, Any]]]:
    """Tables of what a run says of claimed standard deviations, and its metrics that are in none of them.

    Args:
        scenario: For the titles.
        metrics: Of the run, as in its file.

    Returns:
        Markdown, empty where the run has no such metrics, and the other metrics.
    """
    left = dict(metrics)
    parts: list[str] = []
    for table in _TABLES:
        rows = [name.removeprefix(table.key) for name in metrics if name.startswith(table.key)]
        columns = [column for column in table.columns if any(column + row in metrics for row in rows)]
        if not rows:
            continue
        titles = " | ".join(f"`{column}`" for column in columns)
        lines = [f"| {table.rows} | {titles} |", f"|---|{'---:|' * len(columns)}"]
        for row in rows:
            cells = (_cell(left.pop(column + row, None)) for column in columns)
            lines.append(f"| `{row}` | {' | '.join(cells)} |")
        parts.append(f"### {table.title}: {scenario}\n{'' if parts else _NOTE}\n" + "\n".join(lines) + "\n")
    return "\n".join(parts), left


def _cell(metric: Mapping[str, Any] | None) -> str:
    return "-" if metric is None else f"{float(metric['value']):.4g} {metric['unit']}".rstrip()
