"""What a run of the people tracker leaves: `tracks.csv`, MOT-challenge text, `report.json`."""

import csv
import json
import time
from pathlib import Path
from typing import Any, TextIO

import jax.numpy as jnp
import numpy as np

from jaxfilters.models.person.ellipsoid import VISIBLE, ellipse_of, outline
from jaxfilters.trackers.app.results import CHECKPOINT_EVERY_S, OutputFolder, can_resume
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.people.checkpoints import load, save
from jaxfilters.trackers.people.recorded import Sighting, height_of, spreads
from jaxfilters.trackers.people.session import PeopleSession
from jaxfilters.trackers.people.silhouettes import body_of, place_of
from jaxfilters.trackers.people.state import PeopleScene

COLUMNS = ("frame", "id", "x_m", "y_m", "radial_std_m", "lateral_std_m", "height_m", "score", "mode")


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


def write_mot(path: Path, scene: PeopleScene, tracks: dict[int, list[Sighting]], camera: int = 0) -> None:
    """MOT-challenge text: `frame,id,left,top,width,height,confidence,x,y,z`, counted from 1, floor points in metres.

    Boxes are of the ellipsoid in one camera, in pixels without lens distortion.

    Raises:
        OutputError: it cannot be written.
    """
    lines = []
    for identity, seen in by_frame(tracks):
        shown = outline(scene.cameras[camera].P, body_of(place_of(jnp.asarray(seen.mean, jnp.float32))))
        if int(shown.code) != VISIBLE:
            continue
        left, top, right, bottom = (float(edge) for edge in ellipse_of(shown).box)
        lines.append(
            f"{seen.frame + 1},{identity + 1},{left:.2f},{top:.2f},{right - left:.2f},{bottom - top:.2f},"
            f"{np.clip(seen.score, 0, 1):.3f},{seen.mean[0]:.3f},{seen.mean[1]:.3f},0"
        )
    try:
        path.write_text("".join(line + "\n" for line in lines))
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def write_report(path: Path, report: dict[str, Any]) -> None:
    """Write `report.json`.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        path.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def by_frame(tracks: dict[int, list[Sighting]]) -> list[tuple[int, Sighting]]:
    """All sightings with their identities, by frame and identity."""
    everything = [(identity, seen) for identity, track in tracks.items() for seen in track]
    return sorted(everything, key=lambda item: (item[1].frame, item[0]))


def _row(centers: np.ndarray, identity: int, seen: Sighting) -> list[Any]:
    radial, lateral = spreads(centers, seen)
    numbers = (seen.mean[0], seen.mean[1], radial, lateral, height_of(seen), seen.score)
    return [seen.frame, identity, *(f"{number:.4f}" for number in numbers), seen.mode]
