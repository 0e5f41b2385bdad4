"""What came of a run of a head: `report.json`, and a few lines for a person."""

from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.app.results import finite, versions
from jaxfilters.trackers.app.stream import RunResult
from jaxfilters.trackers.head.common.report import errors, shares
from jaxfilters.trackers.head.common.run import HeadStream
from jaxfilters.trackers.head.common.table import DISPLAYED, TABLE_STATUS, TRACKED, HeadRows, displayed
from jaxfilters.trackers.innovations import contradiction, innovation_share


def run_report(stream: HeadStream, results: HeadRows, followed: RunResult) -> dict[str, Any]:
    """What `report.json` says of any run of a head."""
    place, frame_of = stream.place, stream.frame_of
    events = [{"frame": frame_of[min(i, len(frame_of) - 1)], "what": what} for i, what in stream.session.events]
    return {
        "input": [source.name for source in place.sources],
        **shares(results),
        "frames_per_second": finite(followed.frames_per_second),
        "tracking_ms_per_frame": finite(followed.tracking_ms),
        "interrupted": followed.interrupt is not None,
        "trouble": followed.trouble,
        "note": place.note,
        "events": events,
        "innovations": innovation_share(results.innovations).report(),
        "errors": errors(results, place.truth),
        "versions": versions(),
    }


def format_report(report: dict[str, Any], out: Path, *, has_video: bool) -> str:
    """The report of results in the folder `out` in a few lines for a person."""
    speed, share = report["frames_per_second"], report["share_tracked"]
    lines = [
        f"{report['frames']} frames"
        + (f" at {speed:.0f} frames/s" if speed else "")
        + (f", {100 * share:.0f} % tracked" if share is not None else "")
        + f", longest stretch without loss {report['longest_stretch_s']:.1f} s"
        + (", interrupted" if report["interrupted"] else "")
    ]
    if text := contradiction(report["innovations"]):
        lines.append(text.strip())
    if report["errors"]:
        values = displayed(np.asarray(list(report["errors"]["rmse"].values())))
        named = zip((axis.replace(",", " in") for axis in DISPLAYED), values, strict=True)
        rmse = ", ".join(f"{axis} {value:.2f}" for axis, value in named)
        lines.append(f"errors, root mean square: {rmse}")
    if not any(report["status"][TABLE_STATUS[code]] for code in TRACKED):
        last = f"; last: {report['events'][-1]['what']}" if report["events"] else ""
        lines.append(f"no face was followed{last}")
    lines.append(
        f"results in {out}: track.csv, track.npz, report.json, summary.png" + (", overlay.mp4" if has_video else "")
    )
    return "\n".join(lines)
