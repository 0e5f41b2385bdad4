"""`jaxfilters track head-stereo`."""

import argparse
import dataclasses
from contextlib import closing
from functools import partial

import numpy as np

from jaxfilters.models.face.landmarks import FROM_68, NUM_LANDMARKS
from jaxfilters.trackers.app.options import config_from_args
from jaxfilters.trackers.app.progress import warn
from jaxfilters.trackers.app.results import finite
from jaxfilters.trackers.app.stream import StreamRun, check_unused
from jaxfilters.trackers.head.common.config import HeadConfig
from jaxfilters.trackers.head.common.input import Places, Setup, setup_of
from jaxfilters.trackers.head.common.outcome import format_report, run_report
from jaxfilters.trackers.head.common.run import HeadStream, RowsOf, stream_spec
from jaxfilters.trackers.head.common.summary import write_summary
from jaxfilters.trackers.head.common.table import HEAD_TABLE, TABLE_STATUS, empty_rows
from jaxfilters.trackers.head.stereo.session import HeadSession
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.video_input import is_live


def track(options: argparse.Namespace) -> str:
    """Follow a head, leave the results in `options.out`, and say in a few lines what came of it.

    Raises:
        InputError: a source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text; what was tracked before is written.
    """
    check_unused(options)
    settings = as_input_error(partial(config_from_args, HeadConfig(), options))
    place = setup_of(
        options.sources, Places(options.rig, options.camera, options.points, options.fps), options.seed or 0
    )
    if any(map(is_live, place.sources)):
        settings = dataclasses.replace(settings, chunk=1, live=True)
    session = as_input_error(lambda: _session(place, settings))
    rows = RowsOf(HEAD_TABLE, partial(empty_rows, place.rig.num_cameras))
    stream = HeadStream(place, session, rows, settings.chunk)
    files = {name: getattr(options, name) for name in ("camera", "rig", "points", "detector")}
    with closing(StreamRun(options, stream_spec(stream, rows, settings, files))) as run:
        return _tracked(options, settings, stream, run, session)


def _tracked(
    options: argparse.Namespace, settings: HeadConfig, stream: HeadStream, run: StreamRun, session: HeadSession
) -> str:
    if stream.place.note:
        warn(stream.place.note)
    followed = run.follow()
    report = run_report(stream, run.writer.results, followed) | {
        "explained_contribution": finite(float(session.contribution)),
        "config": dataclasses.asdict(settings),
        "options": {
            name: str(value) if value is not None else None
            for name, value in (("rig", options.rig), ("camera", options.camera), ("points", options.points))
        },
    }
    run.writer.finish(report, **_learned(session))
    truth = None if stream.place.truth is None else stream.place.truth.poses
    write_summary(options.out / "summary.png", run.writer.results, session.model, truth)
    return run.conclude(followed, format_report(report, options.out, has_video=options.video))


def _session(place: Setup, settings: HeadConfig) -> HeadSession:
    points = place.points
    if points is not None and len(points) > NUM_LANDMARKS:
        points = points[list(FROM_68)]
    try:
        return HeadSession(place.rig, settings, points, focal_log_std=place.focal_log_std)
    except ImportError as error:
        raise InputError(f"--detector {settings.detector}: {error}") from error


def _learned(session: HeadSession) -> dict[str, np.ndarray]:
    """What `track.npz` holds beside the track, metres."""
    learned = {"status_names": np.asarray(TABLE_STATUS)}
    if session.model is not None:
        scales = {"mean": 1e-3, "basis": 1.0, "deviation": 1e-3, "templates": 1.0}
        learned |= {f"model_{name}": scale * np.asarray(getattr(session.model, name)) for name, scale in scales.items()}
    return learned
