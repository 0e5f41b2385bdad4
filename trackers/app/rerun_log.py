"""A run for the Rerun viewer: pictures, numbers and places with their uncertainty, while it runs or in a file."""

import argparse
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from jaxfilters.trackers.app.options import VIEWER
from jaxfilters.trackers.app.output_folder import check_file, reason
from jaxfilters.trackers.app.results import TrackTable
from jaxfilters.trackers.io.errors import InputError, OutputError

SIGMAS = 2.0
"""Half axes of ellipsoids, standard deviations."""
_PLACE = re.compile(r"((?:.*_)?)x_(m|px)$")
_QUALITY = 80
"""Of the JPEG pictures."""


class RerunLog:
    """What one run sends to the viewer; its time lines are `frame` and `time`, in seconds."""

    def __init__(self, to: str, table: TrackTable):
        """Open the viewer, or a file for it.

        Args:
            to: `VIEWER`, or a file whose name ends in `.rrd`.
            table: Whose columns become time series; those of places and their standard deviations become ellipsoids.

        Raises:
            InputError, OutputError: as for `check_log`, or the viewer cannot be started.
        """
        check_log(to)
        self._rerun: Any = import_module("rerun")
        self._table, self._status = table, [*dict.fromkeys(table.status_names)]
        self._to = self._rerun.RecordingStream("jaxfilters")
        try:
            if to == VIEWER:
                self._to.spawn()
            else:
                Path(to).parent.mkdir(parents=True, exist_ok=True)
                self._to.save(to)
        except OSError as error:
            raise OutputError(f"--rerun {to}: {reason(error)}.") from None
        except RuntimeError as error:
            raise OutputError(f"--rerun {to}: {str(error).splitlines()[0]}.") from None

    def rows(self, first: int, track: Any) -> None:
        """Send rows of the table; `first` is the number of the frame of the first of them."""
        if not len(track.times_s):
            return
        frames = getattr(track, "frame", first + np.arange(len(track.times_s)))
        columns = self._columns(track)
        names = columns.pop("id", np.zeros(len(frames)))
        words = np.asarray([self._status.index(self._table.status_names[int(code)]) for code in track.status])
        for name in dict.fromkeys(names.tolist()):
            own = names == name
            below = f"/{_entity(name)}" if len(columns) and "id" in self._table.columns else ""
            index = [
                self._rerun.TimeColumn("frame", sequence=frames[own]),
                self._rerun.TimeColumn("time", duration=track.times_s[own]),
            ]
            for column, values in {**columns, "status": words}.items():
                self._send(f"numbers/{column}{below}", index, self._rerun.Scalars.columns(scalars=values[own]))
            self._places(below, index, {column: values[own] for column, values in columns.items()})

    def picture(self, frame: int, time_s: float, image: np.ndarray) -> None:
        """Send a picture (rows, cols, 3) uint8, blue green red."""
        self._to.set_time("frame", sequence=frame)
        self._to.set_time("time", duration=float(time_s))
        colours = np.ascontiguousarray(image[..., ::-1])
        self._to.log("picture", self._rerun.Image(colours).compress(jpeg_quality=_QUALITY))

    def close(self) -> None:
        """Send what waits; a file is complete then."""
        self._to.flush()
        self._to.disconnect()

    def _columns(self, track: Any) -> dict[str, np.ndarray]:
        found = {}
        for part in self._table.parts:
            values = part.values(track).reshape(len(track.times_s), len(part.names))
            for name, column in zip(part.names, values.T, strict=True):
                found[name] = column if name == "id" else column.astype(float)
        return found

    def _places(self, below: str, index: list[Any], columns: dict[str, np.ndarray]) -> None:
        """Ellipsoids of what is in metres, ellipses over the picture of what is in pixels."""
        for match in filter(None, map(_PLACE.match, columns)):
            stem, unit = match.groups()
            axes = [axis for axis in "xyz" if f"{stem}{axis}_{unit}" in columns]
            center = np.stack([columns[f"{stem}{axis}_{unit}"] for axis in axes], axis=-1)
            none = np.zeros(len(center))
            std = np.stack([columns.get(f"{stem}{axis}_std_{unit}", none) for axis in axes], axis=-1)
            half = SIGMAS * std
            if unit == "px":
                columns_of = self._rerun.Ellipses2D.columns(centers=center, half_sizes=half)
            else:
                # A place on a floor has no height.
                flat = ((0, 0), (0, 3 - len(axes)))
                columns_of = self._rerun.Ellipsoids3D.columns(
                    centers=np.pad(center, flat), half_sizes=np.pad(half, flat)
                )
            where = "picture" if unit == "px" else "places"
            self._send(f"{where}/{stem.strip('_') or 'estimate'}{below}", index, columns_of)

    def _send(self, entity: str, index: list[Any], columns: Any) -> None:
        self._to.send_columns(entity, indexes=index, columns=columns)


def check_log(to: str) -> None:
    """Refuse a log that cannot be written, before anything is computed.

    Raises:
        InputError: rerun-sdk is not installed, or the name of the file is not one of the viewer.
        OutputError: the file cannot be written.
    """
    if to != VIEWER and Path(to).suffix != ".rrd":
        raise InputError(f"--rerun {to}: expected a file whose name ends in .rrd, or nothing for the viewer.")
    try:
        import_module("rerun")
    except ImportError:
        raise InputError("--rerun: needs rerun-sdk: pip install 'jaxfilters[viz]'.") from None
    if to != VIEWER:
        check_file(Path(to))


def open_log(options: argparse.Namespace, table: TrackTable) -> RerunLog | None:
    """The log that a command was given with `--rerun`.

    Raises:
        InputError, OutputError: as for `RerunLog`.
    """
    return None if options.rerun is None else RerunLog(options.rerun, table)


def _entity(name: Any) -> str:
    return str(int(name)) if isinstance(name, float) else str(name)
