"""`jaxfilters track head-stereo`."""

import argparse
import dataclasses
from functools import partial

import numpy as np

from jaxfilters.models.face.landmarks import FROM_68, NUM_LANDMARKS
from jaxfilters.trackers.app.track_command import given, refusing
from jaxfilters.trackers.head.common.input import Place, place_of
from jaxfilters.trackers.head.common.outcome import finite, run_report, told
from jaxfilters.trackers.head.common.run import HeadRun, warn
from jaxfilters.trackers.head.common.state import HeadOptions
from jaxfilters.trackers.head.common.summary import write_summary
from jaxfilters.trackers.head.common.table import STATUS_WORDS, head_table
from jaxfilters.trackers.head.stereo.session import HeadSession
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.video_input import LiveCamera


def track_head(options: argparse.Namespace) -> str:
    """Follow a head, leave the results in `options.out`, and say in a few lines what came of it.

    Raises:
        InputError: a source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: before anything was tracked.
    """
    settings = refusing(partial(given, HeadOptions, options))
    place = place_of(options)
    if any(isinstance(source, LiveCamera) for source in place.sources):
        settings = dataclasses.replace(settings, chunk=1, live=True)
    session = refusing(lambda: _session(place, settings))
    run = HeadRun(options, place, session, head_table(place.rig.num_cameras), chunk=settings.chunk)
    if place.note:
        warn(place.note)
    followed = run.follow()
    report = run_report(run, followed) | {
        "learnt_contribution": finite(float(session.contribution)),
        "config": dataclasses.asdict(settings),
        "options": {
            name: str(value) if value is not None else None
            for name, value in (("rig", options.rig), ("camera", options.camera), ("points", options.points))
        },
    }
    run.writer.finish(report, **_learnt(session))
    truth = None if place.truth is None else place.truth.poses
    write_summary(options.out / "summary.png", run.writer.results, session.model, truth)
    run.conclude(followed)
    return told(report, options)


def _session(place: Place, settings: HeadOptions) -> HeadSession:
    points = place.points
    if points is not None and len(points) > NUM_LANDMARKS:
        points = points[list(FROM_68)]
    try:
        return HeadSession(place.rig, settings, points)
    except ImportError as error:
        raise InputError(f"--detector {settings.detector}: {error}") from error


def _learnt(session: HeadSession) -> dict[str, np.ndarray]:
    """What `track.npz` holds beside the track."""
    learnt = {"status_names": np.asarray(STATUS_WORDS)}
    if session.model is not None:
        names = ("mean", "basis", "deviation", "templates")
        learnt |= {f"model_{name}": np.asarray(getattr(session.model, name)) for name in names}
    return learnt
