"""A page of results in Markdown, made of the JSON files that `jaxfilters bench SCENARIO --json FILE` writes."""

import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

_GROUPS = (
    ("Against other libraries", ("ratio_",), "Processor time divided by that of the other library: 0.5 is half."),
    ("Standard deviations", ("coverage", "nees", "nis"), "A 2-sigma interval should cover 95 %."),
    ("Accuracy", (), ""),
)
"""Title, beginnings of the names of metrics, and what to know of them; the last group takes all others."""
_INTRODUCTION = """# Results

Every number below comes from a run of `jaxfilters bench`, which anybody can repeat; `jaxfilters bench --report` wrote
this page from the files of these runs, which are in `docs/results/`, with the day, the machine and the versions that
they hold for. Recordings that may not be redistributed are described on the pages of the trackers.

Ratios to other libraries are medians over rounds in which both take turns, so that they hold on a busy machine as well.
Times in seconds hold for the machine and the load of the run: these machines were not idle.

![Processor time divided by that of other libraries, by scenario](results/speed.webp)

![Share of truths within two standard deviations, by system](results/coverage.webp)
"""


def read_results(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The documents of runs, by scenario.

    Args:
        paths: JSON files, or folders of them.

    Raises:
        ValueError: A path does not exist, holds no such file, or one that `bench --json` has not written.
    """
    files = [file for path in paths for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    if not files:
        raise ValueError(f"{', '.join(map(str, paths))}: expected JSON files of runs; found none.")
    return sorted((_document(file) for file in files), key=lambda document: document["scenario"])


def results_page(documents: Sequence[Mapping[str, Any]], descriptions: Mapping[str, str]) -> str:
    """The page.

    Args:
        documents: As `read_results` gives them.
        descriptions: What scenarios measure, by their names.
    """
    parts = [_INTRODUCTION]
    for document in documents:
        name = document["scenario"]
        described = f"{descriptions.get(name, '')}\n\n`jaxfilters bench {name}`"
        parts.append(f"## {name}\n\n{described}. {_conditions(document['environment'])}\n")
        ordered = sorted(document["metrics"].items(), key=lambda item: _group(item[0]))
        for index, metrics in groupby(ordered, key=lambda item: _group(item[0])):
            title, _, note = _GROUPS[index]
            parts.append(f"### {title}: {name}\n" + (f"\n{note}\n" if note else "") + f"\n{_table(dict(metrics))}")
    return "\n".join(parts)


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read ({error}).") from None
    wanted = {"scenario", "metrics", "environment"}
    if not isinstance(document, dict) or not wanted <= set(document):
        raise ValueError(f"{path}: expected the file of a run, with {', '.join(sorted(wanted))}.")
    return document


def _conditions(environment: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{name} {environment[name]}" for name in ("jaxfilters", "jax", "numpy", "python"))
    load = "" if environment.get("load") is None else f", load {environment['load']} at its end"
    peers = "".join(f", {name} {found}" for name, found in environment.get("peers", {}).items())
    date = f"{environment['date']}, on" if "date" in environment else "On"
    machine = f"{environment['cpu']}, {environment['cores']} cores, {environment['device']}"
    return f"{date} {machine}{load}; {versions}{peers}."


def _group(metric: str) -> int:
    return next((i for i, (_, begins, _) in enumerate(_GROUPS) if metric.startswith(begins)), len(_GROUPS) - 1)


def _table(metrics: Mapping[str, Mapping[str, Any]]) -> str:
    rows = ["| metric | value | unit | better |", "|---|---:|---|---|"]
    for name, metric in metrics.items():
        rows.append(f"| `{name}` | {metric['value']:.4g} | {metric['unit'] or '-'} | {metric['better']} |")
    return "\n".join(rows) + "\n"
