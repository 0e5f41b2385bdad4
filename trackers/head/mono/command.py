"""`jaxfilters track head-mono`."""

import argparse
import dataclasses
from contextlib import closing
from functools import partial
from typing import Any

import numpy as np

from jaxfilters.models.face.gallery import Gallery
from jaxfilters.models.face.landmarks import NAMES
from jaxfilters.models.face.multilinear import MultilinearFace
from jaxfilters.models.face.person_prior import Person, eyes_apart
from jaxfilters.models.face.rig import CameraRig
from jaxfilters.trackers.app.options import config_from_args
from jaxfilters.trackers.app.progress import warn
from jaxfilters.trackers.app.results import finite
from jaxfilters.trackers.app.stream import StreamRun, check_unused
from jaxfilters.trackers.head.common.input import Places, setup_of_one
from jaxfilters.trackers.head.common.outcome import format_report, run_report
from jaxfilters.trackers.head.common.run import HeadStream, RowsOf, stream_spec
from jaxfilters.trackers.head.common.summary import Labels, write_summary
from jaxfilters.trackers.head.common.table import TABLE_STATUS
from jaxfilters.trackers.head.mono.config import VARIANTS, MonoConfig
from jaxfilters.trackers.head.mono.dense import tracked
from jaxfilters.trackers.head.mono.detectors import DETECTORS, Detector, best_detector
from jaxfilters.trackers.head.mono.session import MonoSession
from jaxfilters.trackers.head.mono.table import empty_mono_rows, mono_table
from jaxfilters.trackers.io.enrolled_people import People, read_people, write_people
from jaxfilters.trackers.io.errors import InputError, as_input_error
from jaxfilters.trackers.io.face_models import FaceModelFile, default_face_model, load_face_model, people_face_model
from jaxfilters.trackers.io.landmark_sets import NAMES_68
from jaxfilters.trackers.io.video_input import is_live

PERSON_FILE = "person.npz"
_GIVEN = ("model", "camera", "points", "known", "detector")
"""Options that the report repeats as they were given."""
LABELS = Labels("expression, standard deviations", 1.0, "a", "mode ", "how this face changes with expressions")
"""Of the summary: what is a parameter of the expression, and what moves the most."""


def track(options: argparse.Namespace) -> str:
    """Follow a head, leave the results in `options.out`, and say in a few lines what came of it.

    Raises:
        InputError: the source, a file or an option cannot be used. What was tracked before is written.
        OutputError: the results cannot be written.
        KeyboardInterrupt: with what is kept as its text; what was tracked before is written.
    """
    check_unused(options)
    settings = as_input_error(partial(config_from_args, VARIANTS[options.variant], options))
    model = _model(options)
    face = tracked(model.model)
    known = None if options.known is None else read_people(options.known, face)
    places = Places(camera=options.camera, points=options.points, fps=options.fps)
    place = setup_of_one(options.video_source, places, options.seed or 0)
    if any(map(is_live, place.sources)):
        settings = dataclasses.replace(settings, chunk=1, live=True)
    gallery = None if known is None else known.gallery
    detected_by, detector = _detector(options)
    session = as_input_error(
        lambda: MonoSession(
            place.rig,
            model.model,
            settings,
            place.points,
            detector=detector,
            gallery=gallery,
            focal_log_std=place.focal_log_std,
        )
    )
    rows = RowsOf(mono_table(face), partial(empty_mono_rows, face))
    stream = HeadStream(place, session, rows, settings.chunk)
    files = {name: getattr(options, name) for name in _GIVEN} | {"detector": detected_by}
    contents = {"model": model.model, "people": gallery}
    with closing(StreamRun(options, stream_spec(stream, rows, settings, files, contents))) as run:
        return _tracked(options, settings, stream, run, session, model, known, detected_by)


def _tracked(
    options: argparse.Namespace,
    settings: MonoConfig,
    stream: HeadStream,
    run: StreamRun,
    session: MonoSession,
    model: FaceModelFile,
    known: People | None,
    detected_by: str,
) -> str:
    place, face = stream.place, tracked(model.model)
    if place.note:
        warn(place.note)
    followed = run.follow()
    report = run_report(stream, run.writer.results, followed) | {
        "focal_length_px": np.asarray(place.rig.focal[0], float).tolist(),
        "is_focal_length_assumed": place.focal_log_std > 0,
        "focal_length_log_std": place.focal_log_std,
        "eyes_apart_mm": _eyes_apart_mm(face, session.gallery),
        "adjusted_frames": int(np.nansum(run.writer.results.is_adjusted)),
        "taken_for": _taken_for(run, known),
        "detector": detected_by,
        "face_model": {"source": model.source, "parameters": model.parameters},
        "config": dataclasses.asdict(settings),
        "options": {
            name: None if value is None else [str(one) for one in value] if isinstance(value, list) else str(value)
            for name, value in ((name, getattr(options, name)) for name in _GIVEN)
        },
    }
    focal = _focal(session, place.rig) if options.estimate_focal else None
    report |= {"focal_length_estimate": focal}
    run.writer.finish(report, **_learned(session))
    if session.gallery is not None:
        write_people(options.out / PERSON_FILE, People((options.out.resolve().name,), session.gallery), face)
    truth = None if place.truth is None else place.truth.poses
    write_summary(options.out / "summary.png", run.writer.results, session.model, truth, LABELS)
    lines = format_report(report, options.out, has_video=options.video)
    return run.conclude(followed, lines if focal is None else f"{lines}\n{_in_words(focal)}")


def _model(options: argparse.Namespace) -> FaceModelFile:
    if options.model is None:
        return default_face_model() if options.video_source is None else people_face_model()
    file = load_face_model(options.model)
    if file.names not in (NAMES, NAMES_68):
        other = next((name for name in NAMES if name not in file.names), "their order")
        raise InputError(
            f"{options.model}: {len(file.names)} landmarks, which differ in {other}; the tracker follows the "
            f"{len(NAMES)} that `jaxfilters fit face-model --points 10` makes a model of, and starts from those or "
            f"from the {len(NAMES_68)} of iBUG (--points 68)."
        )
    return file


def _detector(options: argparse.Namespace) -> tuple[str, Detector]:
    """Name of the detector, and the detector."""
    name = options.detector
    if name is None:
        return best_detector()
    try:
        return name, DETECTORS[name]()
    except ImportError as error:
        raise InputError(f"--detector {name}: {error}") from error


def _focal(session: MonoSession, rig: CameraRig) -> dict[str, Any] | None:
    """What the face tells of the focal length along x, for the report; nothing without a face."""
    found = session.focal_length()
    if found is None:
        return None
    mean = float(rig.focal[0, 0] * found.factor)
    return {"px": finite(mean), "std_px": finite(mean * float(found.log_std)), "is_determined": found.is_determined}


def _in_words(focal: dict[str, Any]) -> str:
    if not focal["is_determined"]:
        return "the focal length is not determined by these images: heads that turn further tell more"
    return f"the focal length looks like {focal['px']:.0f} px, give or take {focal['std_px']:.0f}"


def _eyes_apart_mm(face: MultilinearFace, followed: Gallery | None) -> float | None:
    """Of the person who was followed, without what the detector misplaces; None without a face."""
    if followed is None:
        return None
    return finite(float(eyes_apart(face, Person(followed.identity[0], followed.offset[0]))))


def _taken_for(run: StreamRun, known: People | None) -> dict[str, int]:
    """In how many frames each of those who are known was before the camera; nobody without frames."""
    index = np.asarray(run.writer.results.person_index)
    names = () if known is None else known.names
    return {name: int(np.sum(index == i)) for i, name in enumerate(names) if np.any(index == i)}


def _learned(session: MonoSession) -> dict[str, np.ndarray]:
    """What `track.npz` holds beside the track, metres."""
    learned = {"status_names": np.asarray(TABLE_STATUS)}
    if session.person is not None:
        person = session.person
        learned |= {"person_identity": np.asarray(person.identity), "person_offset": 1e-3 * np.asarray(person.offset)}
    return learned
