"""A page of results in Markdown, made of the JSON files that `jaxfilters bench SCENARIO --json FILE` writes."""

import json
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from jaxfilters.benchmarks.claims_page import claims_tables
from jaxfilters.benchmarks.metrics import shown_better

_GROUPS = (
    ("Beside published errors", ("ratio_to_paper", "ratio_to_thesis"), "Error divided by the published one."),
    ("Against other libraries", ("ratio_",), "Processor time divided by that of the other library: 0.5 is half."),
    ("Standard deviations", ("coverage", "nees", "nis"), "A 2-sigma interval should cover 95 %."),
    ("Accuracy", (), ""),
)
"""Title, beginnings of the names of metrics, and what to know of them; the last group takes all others."""
_INTRODUCTION = """# Results

Every number below comes from a run of `jaxfilters bench`, which anybody can repeat; `jaxfilters bench --report` wrote
this page from the files of these runs, which are in `docs/results/`, with the day, the machine and the versions that
they hold for. Recordings that may not be redistributed are described on the pages about the trackers' accuracy.

Ratios to other libraries are medians over rounds in which both take turns, so that they hold on a busy machine as well.
Times in seconds hold for the machine and the load of the run: these machines were not idle. The column *better* has
the direction of an improvement, or the value that is right: 95.4 % of true values within two standard deviations, and a
normalised squared error or a sharpness of 1.

![Processor time divided by that of other libraries, by scenario](results/speed.webp)

![Share of truths within two standard deviations, by system](results/coverage.webp)
"""
_SYSTEMS = {
    "hand_depth_joints_mm": ("hand in depth images", "joints", "registration alone, of the true hand"),
    "articulated_angles_deg": ("articulated hand", "angles", "least squares of each frame"),
    "articulated_lengths_px": ("articulated hand", "lengths", "least squares of each frame"),
    "people_mota": ("people on a floor", "MOTA, higher is better", "blobs, projected back"),
    "people_error_m": ("people on a floor", "places", "blobs, projected back"),
    "head_stereo_z_mm": ("head before two cameras", "distance", "optical flow, triangulated, with the true shape"),
    "head_stereo_yaw_deg": ("head before two cameras", "yaw", "optical flow, triangulated, with the true shape"),
    "head_mono_z_mm": ("face before one camera", "distance", "optical flow and PnP with the true shape"),
    "head_mono_yaw_deg": ("face before one camera", "yaw", "optical flow and PnP with the true shape"),
    "fingertips_count": ("fingertips", "frames with the right number, higher is better", "convex hull"),
    "symbols_right": ("symbols", "right, higher is better", "nearest by dynamic time warping"),
}
"""Of the metrics of `bench systems`: the system, the quantity, and the simplest thing beside it."""
_OF_SYSTEMS = """## The six systems

Each tracker on synthetic recordings whose truth is known, beside the simplest thing that follows the same, without a
filter, and beside what its paper prints of data of its own: a comparison of size only. Where the simplest thing knows
the true hand or face, the tracker does not. `jaxfilters bench systems` says how each was measured.

| system | quantity | jaxfilters | simplest | which is | paper |
|---|---|---:|---:|---|---:|
"""


class Row(NamedTuple):
    """A system on recordings, beside the simplest thing, as a run of a scenario measured both."""

    system: str
    recording: str
    quantity: str
    simplest: str
    scenario: str
    metric: str
    metric_of_simplest: str


_ICT = "rendered people of the ICT face model, heads and faces moving as recorded"
_PNP, _MEAN_MESH = "`solvePnP` in each frame", "the mesh of a mean person, rotated onto the mesh"
ON_RECORDINGS = (
    *(
        Row(
            "hand in depth images",
            recording,
            "joints",
            "registration alone",
            "pf-vs-rbpf",
            f"joint_error_mm_real{case}_rbpf",
            f"joint_error_mm_real{case}_registration",
        )
        for recording, case in (
            ("12 motions of real hands, 11 of them rendered from scans", ""),
            ("the same, 7.5 frames a second", "_every_4"),
            ("11 of them, while the fingers are hidden", "_hidden"),
        )
    ),
    *(
        Row(
            "hand in depth images",
            recording,
            "right poses, higher is better",
            "nearest of the rendered hands that the search begins with",
            "hand-starts",
            f"found{case}",
            f"found{case}_simple",
        )
        for recording, case in (
            ("single images of 11 motions", ""),
            ("the same, turned by 42 to 55 degrees", "_turned"),
        )
    ),
    *(
        Row(
            "hand from keypoints",
            f"{name}, keypoints of a network, size unknown",
            "joints from the palm",
            simplest,
            "articulated",
            f"{name.lower()}_root_relative_mm_recommended",
            f"{name.lower()}_root_relative_mm_{variant}",
        )
        for name in ("ICVL", "NYU")
        for simplest, variant in (
            ("projection back from the estimated depth", "backprojection_estimated_depth"),
            ("fit of an average hand within its limits to each frame alone", "limits_only"),
        )
    ),
    *(
        Row("people on a floor", recording, quantity, "blobs, projected back", scenario, metric, f"{metric}_simple")
        for recording, scenario in (
            ("PETS 2009 S2.L1, view 1", "people-pets"),
            ("CAVIAR OneLeaveShop1cor", "people-corridor"),
        )
        for quantity, metric in (
            ("MOTA, higher is better", "mota"),
            ("IDF1, higher is better", "idf1"),
            ("places", "mean_error_m"),
        )
    ),
    *(
        Row(
            "head before two cameras",
            f"{_ICT}, heads turned by less than 40 degrees",
            quantity,
            "optical flow, triangulated, with the true shape",
            "head-real",
            f"ict_error_{axis}_within_40deg",
            f"ict_error_{axis}_within_40deg_simple",
        )
        for quantity, axis in (("yaw", "yaw"), ("pitch", "pitch"), ("distance", "z"))
    ),
    *(
        Row(
            "face before one camera",
            _ICT,
            f"{quantity}, in frames with a face by {detector}",
            simplest,
            "head-mono",
            f"{metric}_modelled_rendered{suffix}",
            f"{prefix}_{metric}_modelled_rendered{suffix}",
        )
        for quantity, detector, metric, suffix, prefix, simplest in (
            ("yaw", "OpenCV's cascades", "yaw_rms_deg", "", "pnp", _PNP),
            ("pitch", "OpenCV's cascades", "pitch_rms_deg", "", "pnp", _PNP),
            ("distance", "OpenCV's cascades", "z_error_mm", "", "pnp", _PNP),
            ("yaw", "MediaPipe's mesh", "yaw_rms_deg", "_mediapipe", "mesh", _MEAN_MESH),
            ("pitch", "MediaPipe's mesh", "pitch_rms_deg", "_mediapipe", "mesh", _MEAN_MESH),
            ("distance", "MediaPipe's mesh", "z_error_mm", "_mediapipe", "pnp", _PNP),
        )
    ),
    *(
        Row(
            "fingertips",
            f"`{name}`, 20 marked frames",
            quantity,
            "a threshold in colour, gaps of the convex hull",
            "fingertips",
            f"{metric}_{name}",
            f"{metric}_{name}_simple",
        )
        for name in ("desk_hand_video", "dexretarget_hand_video")
        for quantity, metric in (("found, higher is better", "found_pct"), ("false", "false_pct"))
    ),
    *(
        Row(
            "fingertips",
            "both, changed in thirteen ways: turned, mirrored, in other light",
            quantity,
            "a threshold in colour, gaps of the convex hull",
            "fingertips-changed",
            metric,
            f"{metric}_simple",
        )
        for quantity, metric in (("found, higher is better", "found_pct"), ("false", "false_pct"))
    ),
    *(
        Row(
            "symbols",
            recording,
            "right, higher is better",
            "nearest by dynamic time warping",
            "gestures",
            f"accuracy_{metric}",
            f"accuracy_{metric}_dtw",
        )
        for recording, metric in (
            ("UNIPEN, writers of other files", "unipen_unseen_donor"),
            ("drawn in the air, other people", "midair_loso"),
        )
    ),
)
_OF_RECORDINGS = """## The six systems on recordings

Each tracker on data that are not its own, beside the simplest thing that follows the same without a filter: mean
errors, of heads root mean squares, of the distance before one camera the mean over people of how far each is off on
average. What the recordings are, and on which of them constants were chosen, is on the pages about accuracy. The
numbers are those of the runs below.

| system | recording | quantity | jaxfilters | simplest | which is |
|---|---|---|---:|---:|---|
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
    parts += [_on_recordings(documents)]
    parts += [_of_systems(document["metrics"]) for document in documents if document["scenario"] == "systems"]
    for document in documents:
        name, machine = document["scenario"], document["environment"]
        described = f"{descriptions.get(name, '')}\n\n`jaxfilters bench {name}`"
        if machine.get("backend", "cpu") != "cpu":
            name = f"{name} on {machine['device']}"
        parts.append(f"## {name}\n\n{described}. {_conditions(machine)}\n")
        tables, metrics = claims_tables(name, document["metrics"])
        parts += [tables] if tables else []
        ordered = sorted(metrics.items(), key=lambda item: _group(item[0]))
        for index, group in groupby(ordered, key=lambda item: _group(item[0])):
            title, _, note = _GROUPS[index]
            parts.append(f"### {title}: {name}\n" + (f"\n{note}\n" if note else "") + f"\n{_table(dict(group))}")
    return "\n".join(parts)


def _on_recordings(documents: Sequence[Mapping[str, Any]]) -> str:
    """The first table of the page, of what the runs measured; nothing where none did."""
    metrics = {document["scenario"]: document["metrics"] for document in documents}
    rows = []
    for row in ON_RECORDINGS:
        of = metrics.get(row.scenario, {})
        if row.metric in of and row.metric_of_simplest in of:
            values = " | ".join(_valued(of[name]) for name in (row.metric, row.metric_of_simplest))
            rows.append(f"| {row.system} | {row.recording} | {row.quantity} | {values} | {row.simplest} |\n")
    return _OF_RECORDINGS + "".join(rows) if rows else ""


def _valued(metric: Mapping[str, Any]) -> str:
    return f"{float(metric['value']):.3g} {metric['unit']}"


def _of_systems(metrics: Mapping[str, Mapping[str, Any]]) -> str:
    """The table at the beginning of the page, from the run of `bench systems`."""
    rows = []
    for name, (system, quantity, simplest) in _SYSTEMS.items():
        if name not in metrics:
            continue
        values = [
            _valued(found) if (found := metrics.get(f"{name}{suffix}")) else "-" for suffix in ("", "_simple", "_paper")
        ]
        rows.append(f"| {system} | {quantity} | {values[0]} | {values[1]} | {simplest} | {values[2]} |\n")
    return _OF_SYSTEMS + "".join(rows)


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
        rows.append(
            f"| `{name}` | {float(metric['value']):.4g} | {metric['unit'] or '-'} | {shown_better(metric['better'])} |"
        )
    return "\n".join(rows) + "\n"
