"""What a run of the people tracker leaves: `tracks.csv`, MOT-challenge text, `report.json`."""

import csv
import json
import time
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.models.person.ellipsoid import VISIBLE, Outline, outline
from jaxfilters.trackers.app.output_folder import OutputFolder
from jaxfilters.trackers.app.progress import note
from jaxfilters.trackers.app.results import CHECKPOINT_EVERY_S, can_resume
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.checkpoints import load, save
from jaxfilters.trackers.people.recorded import Sighting, height_of, spreads
from jaxfilters.trackers.people.session import PeopleSession
from jaxfilters.trackers.people.silhouettes import body_of, observed_place
from jaxfilters.trackers.people.state import PeopleScene

COLUMNS = ("frame", "id", "x_m", "y_m", "radial_std_m", "lateral_std_m", "height_m", "score", "mode")


OUTLINE_POINTS = 64
"""Of an outline, from which the box in the video follows."""


class TracksWriter:
    """`tracks.csv`, one row a person and frame, and `checkpoint/` to continue from.

    Every row is on disk when `append` returns. The cost of a checkpoint does not depend on how many came before it.
    """

    def __init__(self, folder: Path, scene: PeopleScene, run: dict[str, Any], *, resume: bool):
        """Begin a table, or open that of an interrupted run.

        Args:
            folder: Where the results go.
            scene: Whose cameras tell along the line of sight from across it.
            run: What must be equal for a run to be continued, JSON-able.
            resume: Whether an interrupted run is continued, where there is one.

        Raises:
            OutputError: The folder cannot be written, holds tracks already, or another run writes into it.
        """
        self._output, self.path = OutputFolder(folder), folder / "tracks.csv"
        self._scene, self._run, self._centers = scene, run, np.asarray(scene.centers())
        self._unsaved: list[tuple[int, Sighting]] = []
        self._num_parts, self._saved_at = 0, time.monotonic()
        self._resumes = resume and can_resume(folder)
        try:
            if self.path.exists() and not self._resumes:
                raise OutputError(f"{self.path}: holds the tracks of another run; choose another --out, or --resume.")
            self._file: TextIO = self.path.open("a" if self._resumes else "w", newline="")
            if not self._resumes:
                csv.writer(self._file).writerow(COLUMNS)
        except OSError as error:
            self._output.close()
            if isinstance(error, OutputError):
                raise
            raise OutputError(f"cannot write {self.path}: {error.strerror}.") from None

    def restore(self, session: PeopleSession) -> None:
        """Continue the interrupted run, if there is one, in a new session.

        Raises:
            CheckpointError: The interrupted run is another one, or its checkpoint is damaged.
        """
        if not self._resumes:
            return
        saved = load(self.path.parent, self._run)
        session.restore(saved.state, saved.tracks)
        note(f"continuing after frame {session.tracks.frames} of {self.path.parent}")
        self._num_parts = saved.num_parts
        self._file.truncate(0)
        csv.writer(self._file).writerow(COLUMNS)
        self._write(saved.tracks)

    def append(self, sightings: list[tuple[int, Sighting]]) -> None:
        """Add rows.

        Raises:
            OutputError: The disk is full or the folder gone; what was appended before is kept.
        """
        self._unsaved += sightings
        self._write(sightings)

    def checkpoint(self, session: PeopleSession) -> None:
        """Save what the next images need, unless that was done a moment ago.

        Raises:
            OutputError: As for `append`.
        """
        if time.monotonic() - self._saved_at < CHECKPOINT_EVERY_S:
            return
        try:
            save(self.path.parent, self._run, session.state(), self._unsaved, self._num_parts)
        except OSError as error:
            raise OutputError(f"cannot write a checkpoint: {error.strerror}; {self.path} is kept.") from None
        self._unsaved, self._num_parts, self._saved_at = [], self._num_parts + 1, time.monotonic()

    def replace(self, tracks: dict[int, list[Sighting]]) -> None:
        """Put other tracks into the table of a finished run, ordered by frame, all or nothing.

        Raises:
            OutputError: It cannot be written; the old one is kept.
        """
        partial = self.path.with_name(self.path.name + ".partial")
        try:
            with partial.open("w", newline="") as file:
                rows = csv.writer(file)
                rows.writerow(COLUMNS)
                rows.writerows(_row(self._centers, identity, seen) for identity, seen in by_frame(tracks))
            partial.replace(self.path)
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}; the filtered tracks are kept.") from None

    def close(self) -> None:
        """Nothing more comes; other runs may write into the folder."""
        self._file.close()
        self._output.close()

    def _write(self, sightings: list[tuple[int, Sighting]]) -> None:
        try:
            csv.writer(self._file).writerows(_row(self._centers, identity, seen) for identity, seen in sightings)
            self._file.flush()
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}; earlier rows are kept.") from None


def write_mot(
    path: Path, scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]], camera: int = 0
) -> None:
    """MOT-challenge text: `frame,id,left,top,width,height,confidence,x,y,z`, counted from 1, floor points in metres.

    Boxes are of the ellipsoid in one camera, in pixels of its video.

    Raises:
        OutputError: it cannot be written.
    """
    lines = [
        f"{seen.frame + 1},{identity + 1},{left:.2f},{top:.2f},{width:.2f},{height:.2f},"
        f"{np.clip(seen.score, 0, 1):.3f},{seen.mean[0]:.3f},{seen.mean[1]:.3f},0\n"
        for identity, seen, (left, top, width, height) in _boxes(scene, undistortion, tracks, camera)
    ]
    _write_text(path, "".join(lines))


def write_coco(
    path: Path, scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]], camera: int = 0
) -> None:
    """COCO annotations with `track_id`, `floor_xy_m` and `score`; images are frames from 0, boxes as of `write_mot`.

    Raises:
        OutputError: it cannot be written.
    """
    rows, cols = scene.cameras[camera].shape
    found = _boxes(scene, undistortion, tracks, camera)
    document = {
        "images": [{"id": i, "width": cols, "height": rows} for i in sorted({seen.frame for _, seen, _ in found})],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [
            {
                "id": number,
                "image_id": seen.frame,
                "category_id": 1,
                "track_id": identity,
                "bbox": [round(float(edge), 2) for edge in box],
                "area": round(float(box[2] * box[3]), 2),
                "iscrowd": 0,
                "score": round(float(np.clip(seen.score, 0, 1)), 3),
                "floor_xy_m": [round(float(x), 3) for x in seen.mean[:2]],
            }
            for number, (identity, seen, box) in enumerate(found, 1)
        ],
    }
    _write_text(path, json.dumps(document, allow_nan=False) + "\n")


def _boxes(
    scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]], camera: int
) -> list[tuple[int, Sighting, np.ndarray]]:
    """By frame: identity, sighting, and left, top, width and height in the video of a camera, of all who are in it."""
    everyone = by_frame(tracks)
    if not everyone:
        return []
    # One compilation for each power of two.
    length = 1 << (len(everyone) - 1).bit_length()
    means = np.stack([seen.mean for _, seen in everyone] + [everyone[0][1].mean] * (length - len(everyone)))
    shown = jax.device_get(_outlines(scene, jnp.asarray(means, jnp.float32), camera))
    turns = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)])
    found = []
    for (identity, seen), code, center, shape in zip(everyone, shown.code, shown.center, shown.shape, strict=False):
        if code == VISIBLE:
            points = undistortion.distorted(center + (_root(shape) @ circle).T)
            low, high = points.min(axis=0), points.max(axis=0)
            found.append((identity, seen, np.concatenate([low, high - low])))
    return found


@partial(jax.jit, static_argnums=2)
def _outlines(scene: PeopleScene, means: Array, camera: int) -> Outline:
    def one(mean):
        return outline(scene.cameras[camera].P, body_of(observed_place(scene, mean)))

    return jax.vmap(one)(means)


def _root(shape: np.ndarray) -> np.ndarray:
    """A square root of the matrix of an ellipse, symmetric so that points at right angles are its extremes."""
    values, vectors = np.linalg.eigh(np.asarray(shape, float))
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write `report.json`.

    Raises:
        OutputError: it cannot be written.
    """
    _write_text(path, json.dumps(report, indent=2, allow_nan=False) + "\n")


def by_frame(tracks: dict[int, list[Sighting]]) -> list[tuple[int, Sighting]]:
    """All sightings with their identities, by frame and identity."""
    everything = [(identity, seen) for identity, track in tracks.items() for seen in track]
    return sorted(everything, key=lambda item: (item[1].frame, item[0]))


def _row(centers: np.ndarray, identity: int, seen: Sighting) -> list[Any]:
    radial, lateral = spreads(centers, seen)
    numbers = (seen.mean[0], seen.mean[1], radial, lateral, height_of(seen), seen.score)
    return [seen.frame, identity, *(f"{number:.4f}" for number in numbers), seen.mode]
