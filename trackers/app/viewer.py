"""`jaxfilters view`: the results of a run as one page for a browser, which needs nothing else and no network."""

import argparse
import base64
import csv
import json
import math
import re
import webbrowser
from collections.abc import Iterator, Sequence
from pathlib import Path
from pkgutil import get_data
from typing import Any, NamedTuple

import cv2
import numpy as np

from jaxfilters.trackers.app.output_folder import reason
from jaxfilters.trackers.io.errors import InputError, OutputError, shown
from jaxfilters.trackers.io.input_files import exists, read_text
from jaxfilters.trackers.io.json_files import parse_json

TABLE = "track.csv"
MOST_PICTURES, MOST_WIDTH, QUALITY = 900, 720, 60
"""Of a page: longer videos are thinned out, wider pictures made smaller; quality of WebP."""
_UNIT = re.compile(r"_((?:m|mm|rad|px|s)(?:_per_(?:frame|s))?|per_frame)$")
_NOT_DRAWN = {"frame", "time_s", "hand", "id", "slot"}
_FALLBACK_FPS = 30.0
_MOST_FRAMES = 4_000_000
"""Of a page, which has a time for each: a day and a half of video."""


class _Rows(NamedTuple):
    """A table of results by column."""

    names: list[str]
    cells: list[list[str]]

    def column(self, name: str) -> list[str]:
        place = self.names.index(name)
        return [row[place] for row in self.cells]

    def numbers(self, name: str) -> list[float | None]:
        return [_number(cell) for cell in self.column(name)]


def view(options: argparse.Namespace) -> str:
    """Write the page of a folder of results, open it in a browser if wanted, and say where it is.

    The folder that it is written into is made if need be.

    Raises:
        InputError: The folder holds no results, or damaged ones.
        OutputError: The page cannot be written.
    """
    out = options.out or options.folder / "view.html"
    text = page_of(options.folder)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {out}: {reason(error)}.") from None
    if options.open:
        webbrowser.open_new_tab(out.resolve().as_uri())
    return f"{out}: {len(text) / 1e6:.1f} MB"


def page_of(folder: Path) -> str:
    """The page: pictures of the overlay, charts with two standard deviations, floor plan, table and report.

    Args:
        folder: Of the results of any tracker.

    Raises:
        InputError: The folder holds no table of results, or a damaged one.
    """
    rows = _read_rows(folder)
    videos = _overlays(folder)
    frames = _integers(rows, "frame")
    count = max([*frames, *(first + length - 1 for _, first, length, _ in videos), -1]) + 1
    times_s = _times(rows, frames, count, videos)
    data: dict[str, Any] = {
        "title": folder.resolve().name,
        "times_s": times_s,
        "pictures": list(_pictures(videos, count)),
        "columns": rows.names,
        "rows": [[frame, *row[1:]] for frame, row in zip(frames, rows.cells, strict=True)],
        "report": _report(folder),
    }
    data |= _drawn(rows, frames, times_s)
    template = get_data(__package__, "viewer.html")
    assert template is not None, "The package has no viewer.html."
    # Nothing in the data may end the element that holds it.
    return template.decode().replace("/*DATA*/", json.dumps(data, allow_nan=False).replace("<", "\\u003c"))


def _read_rows(folder: Path) -> _Rows:
    found, wanted = folder / TABLE, f"expected a folder of results, with {TABLE}"
    if not exists(found):
        raise InputError(f"{folder}: {wanted}.")
    try:
        table = list(csv.reader(read_text(found, wanted).splitlines(), strict=True))
    except csv.Error as error:
        raise InputError(f"{found}: no CSV ({error}); {wanted}.") from None
    if not table or table[0][:1] != ["frame"] or any(len(row) != len(table[0]) for row in table):
        raise InputError(f"{found}: no table of results with rows of one length; {wanted}.")
    return _Rows(table[0], table[1:])


def _integers(rows: _Rows, name: str) -> list[int]:
    wanted = f"{name}: expected whole numbers from 0 to {_MOST_FRAMES} in the table of results"
    found = []
    for cell in rows.column(name):
        if not re.fullmatch(r"\d{1,18}", cell, re.ASCII) or int(cell) > _MOST_FRAMES:
            raise InputError(f"{wanted}; got {shown(cell)}.")
        found.append(int(cell))
    return found


def _overlays(folder: Path) -> list[tuple[Path, int, int, float]]:
    """Videos with their first frames, lengths and rates, in order; a resumed run has several."""
    found = []
    for path in folder.glob("overlay*.mp4"):
        match = re.fullmatch(r"overlay(?:_from_(\d+))?", path.stem)
        video = cv2.VideoCapture(str(path))
        if match and video.isOpened():
            length, rate = (video.get(what) for what in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
            found.append((path, int(match[1] or 0), max(int(length), 0), rate if rate > 0 else _FALLBACK_FPS))
        video.release()
    return sorted(found, key=lambda one: one[1])


def _times(
    rows: _Rows, frames: Sequence[int], count: int, videos: Sequence[tuple[Path, int, int, float]]
) -> list[float]:
    """Of every frame, seconds: those of the table, between which others lie evenly."""
    rate = videos[0][3] if videos else _FALLBACK_FPS
    if "time_s" not in rows.names or not frames:
        return [round(i / rate, 6) for i in range(count)]
    known = {frame: time for frame, time in zip(frames, rows.numbers("time_s"), strict=True) if time is not None}
    places = sorted(known)
    times = np.interp(np.arange(count), places, [known[i] for i in places])
    late = np.arange(count) > places[-1]
    times[late] += (np.arange(count)[late] - places[-1]) / rate
    return [round(float(time), 6) for time in times]


def _pictures(videos: Sequence[tuple[Path, int, int, float]], count: int) -> Iterator[dict[str, Any]]:
    every = max(1, math.ceil(count / MOST_PICTURES))
    for path, first, _, _ in videos:
        video, frame = cv2.VideoCapture(str(path)), first
        while video.grab():
            if frame % every == 0:
                yield {"frame": frame, "uri": _uri(video.retrieve()[1])}
            frame += 1
        video.release()


def _uri(image: np.ndarray) -> str:
    height, width = image.shape[:2]
    if width > MOST_WIDTH:
        image = cv2.resize(image, (MOST_WIDTH, round(height * MOST_WIDTH / width)), interpolation=cv2.INTER_AREA)
    coded = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])[1]
    return "data:image/webp;base64," + base64.b64encode(coded.tobytes()).decode()


def _drawn(rows: _Rows, frames: Sequence[int], times_s: Sequence[float]) -> dict[str, Any]:
    """The charts, a line for each column and identity, and the plan of those who have places on a floor."""
    ids = rows.column("id") if "id" in rows.names else [""] * len(frames)
    members = {one: [i for i, other in enumerate(ids) if other == one] for one in dict.fromkeys(ids)}
    charts: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name in rows.names:
        values = rows.numbers(name)
        if name in _NOT_DRAWN or "_std" in name or all(value is None for value in values):
            continue
        stds = rows.numbers(std) if (std := _std_of(name, rows.names)) else None
        for one, places in members.items():
            line: dict[str, Any] = {"name": " ".join(filter(None, [_label(name), one])), "std": None}
            line |= {"t": [times_s[frames[i]] for i in places], "frame": [frames[i] for i in places]}
            line["y"] = [values[i] for i in places]
            if stds is not None:
                line["std"] = [stds[i] for i in places]
            charts.setdefault(_chart_of(name, grouped=len(members) == 1), []).append(line)
    specs = [{"title": _title(*key, lines), "lines": lines} for key, lines in charts.items()]
    plan = None
    if {"id", "x_m", "y_m"} <= set(rows.names):
        x, y = rows.numbers("x_m"), rows.numbers("y_m")
        plan = [
            {
                "name": one,
                "frame": [frames[i] for i in places],
                "x": [x[i] for i in places],
                "y": [y[i] for i in places],
            }
            for one, places in members.items()
        ]
    return {"charts": specs, "plan": plan}


def _std_of(name: str, names: Sequence[str]) -> str | None:
    """The column of standard deviations that belongs to a column: `x_std_m` to `x_m`."""
    unit = _UNIT.search(name)
    candidates = [f"{name}_std", *([f"{name[: unit.start()]}_std{unit[0]}"] if unit else [])]
    return next((candidate for candidate in candidates if candidate in names), None)


def _label(name: str) -> str:
    return _UNIT.sub("", name).replace("_", " ")


def _chart_of(name: str, *, grouped: bool) -> tuple[str, str]:
    """What columns of one chart share: the first word of several, and the unit; of many identities each is alone."""
    unit = found[1] if (found := _UNIT.search(name)) else ""
    words = _UNIT.sub("", name).split("_")
    if not grouped:
        return " ".join(words), unit
    rate = " rate" if "rate" in words else ""
    return (words[0] if len(words) > 1 else "") + rate, unit


def _title(stem: str, unit: str, lines: Sequence[dict[str, Any]]) -> str:
    name = stem or (lines[0]["name"] if len(lines) == 1 else "")
    return ", ".join(filter(None, [name, unit.replace("_per_", " / ")])) or "numbers without a unit"


def _report(folder: Path) -> list[list[str]]:
    """Names and values of `report.json`, nested ones with dots; empty while a run goes on."""
    path = folder / "report.json"
    if not exists(path):
        return []
    wanted = "expected the report of a run"
    report = parse_json(read_text(path, wanted), str(path), wanted)
    return [[name, value] for name, value in _flat(report if isinstance(report, dict) else {}, "")]


def _flat(values: dict[str, Any], before: str) -> Iterator[tuple[str, str]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value if isinstance(value, str) else json.dumps(value)


def _number(cell: str) -> float | None:
    try:
        value = float(cell)
    except ValueError:
        return None
    return float(f"{value:.6g}") if math.isfinite(value) else None
