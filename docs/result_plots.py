"""Charts of the page of results, from the files of runs in `docs/results/`.

    python docs/result_plots.py

writes `docs/results/speed.webp`, ratios of processor times to other libraries, and `docs/results/coverage.webp`, how
often the truth lies within two standard deviations of the six systems.
"""

import json
import re
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt

RESULTS = Path(__file__).parent / "results"
PEERS = ("blackjax", "cuthbert", "dynamax", "filterpy", "hmmlearn", "numpy", "particles", "scipy", "smcx")
LEFT_OUT = re.compile(r"float64|first_call|cost_to|two_cores")
"""Other precisions, compilation, and times at equal error, of which the tables tell."""


def metrics(name: str) -> dict[str, float]:
    """Values of the run of a scenario, by metric."""
    document = json.loads((RESULTS / f"{name}.json").read_text())
    return {key: float(metric["value"]) for key, metric in document["metrics"].items()}


def ratios() -> dict[str, float]:
    """Those of all runs to a library in `PEERS`, by a name that says what of what."""
    found = {}
    for path in sorted(RESULTS.glob("*.json")):
        for key, value in metrics(path.stem).items():
            parts = re.fullmatch(r"ratio_(?:(.+)_)?to_([a-z]+)(.*)", key)
            if parts and parts[2] in PEERS and not LEFT_OUT.search(key):
                which = f" ({parts[3].replace('_', ' ').strip()})" if parts[3] else ""
                found[f"{label(path.stem, parts[1] or '')} / {parts[2]}{which}"] = value
    return dict(sorted(found.items(), key=lambda item: item[1]))


def label(scenario: str, metric: str) -> str:
    """Name of a ratio: the scenario, then what else its metric's name says."""
    words = metric.replace("_", " ").removeprefix(scenario).strip()
    return f"{scenario}: {words}" if words else scenario


def coverages() -> dict[str, float]:
    """Share of truths within two standard deviations by system and recording, percent."""
    found = {}
    for key, value in metrics("honesty").items():
        if key.startswith("coverage2_") and not re.search(r"_(mm|m|deg|px)$", key):
            found[key.removeprefix("coverage2_").replace("_", " ")] = value
    return found


def dots(path: Path, values: dict[str, float], goal: float, label: str, *, log: bool = False) -> None:
    """One dot for each name, with a line at `goal`."""
    figure, ax = plt.subplots(figsize=(9, 1 + 0.19 * len(values)), layout="constrained")
    ax.plot(list(values.values()), list(values), "o", markersize=5)
    ax.grid(alpha=0.3)
    ax.axvline(goal, color="0.2", linewidth=1)
    ax.set(xlabel=label, ylim=(-0.6, len(values) - 0.4), xscale="log" if log else "linear")
    ax.tick_params(axis="y", labelsize=7)
    ax.invert_yaxis()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Write both charts."""
    mpl.use("Agg")
    dots(RESULTS / "speed.webp", ratios(), 1.0, "processor time / that of the other library", log=True)
    dots(RESULTS / "coverage.webp", coverages(), 95.0, "truth within 2 standard deviations (%)")


if __name__ == "__main__":
    main()
