"""What a run of the people tracker leaves: `tracks.csv`, MOT-challenge text, `report.json`."""

import csv
import json
from pathlib import Path
from typing import Any, TextIO

import jax.numpy as jnp
import numpy as np

from jaxfilters.models.person.ellipsoid import VISIBLE, ellipse_of, outline
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.people.recorded import Sighting, height_of, spreads
from jaxfilters.trackers.people.silhouettes import body_of, place_of
from jaxfilters.trackers.people.state import PeopleScene

COLUMNS = ("frame", "id", "x_m", "y_m", "sd_radial_m", "sd_lateral_m", "height_m", "score", "mode")


class TrackTableWriter:
    """`tracks.csv`, one row a person and frame; every row is on disk when `append` returns."""

    def __init__(self, folder: Path, scene: PeopleScene, *, overwrite: bool):
        """Begin a table.

        Raises:
            OutputError: the folder cannot be written, or holds tracks already.
        """
        self.path, self._centers = folder / "tracks.csv", np.asarray(scene.centers())
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self.path.exists() and not overwrite:
                raise OutputError(f"{self.path}: holds the tracks of another run; choose another --out.")
            self._file: TextIO = self.path.open("w", newline="")
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}.") from None
        self._rows = csv.writer(self._file)
        self._rows.writerow(COLUMNS)

    def append(self, sightings: list[tuple[int, Sighting]]) -> None:
        """Add rows.

        Raises:
            OutputError: the disk is full or the folder gone; what was appended before is kept.
        """
        try:
            self._rows.writerows(_row(self._centers, identity, seen) for identity, seen in sightings)
            self._file.flush()
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}; earlier rows are kept.") from None

    def close(self) -> None:
        """Nothing more comes."""
        self._file.close()


def replace_tracks(path: Path, scene: PeopleScene, tracks: dict[int, list[Sighting]]) -> None:
    """Put other tracks into a finished `tracks.csv`, ordered by frame, all or nothing.

    Raises:
        OutputError: it cannot be written; the old one is kept.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(COLUMNS)
            centers = np.asarray(scene.centers())
            rows.writerows(_row(centers, identity, seen) for identity, seen in by_frame(tracks))
        partial.replace(path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; the tracks as they were found are kept.") from None


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
