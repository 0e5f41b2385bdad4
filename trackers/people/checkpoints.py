"""An interrupted run of the people tracker on disk: what the next images need, and the tracks so far."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.io.errors import CheckpointError
from jaxfilters.trackers.people.recorded import Sighting, as_arrays, from_arrays
from jaxfilters.trackers.people.session import PeopleSession
from jaxfilters.trackers.people.state import People

_UNCONFIRMED, _BACKGROUND = "unconfirmed.", "background_"


class SavedTracks(NamedTuple):
    """What a checkpoint holds."""

    arrays: dict[str, np.ndarray]
    """All but the people, whose structure a new session knows."""
    people: People
    tracks: list[tuple[int, Sighting]]
    """By identity."""
    num_parts: int
    """Files with tracks."""

    @property
    def state(self) -> dict[str, Any]:
        """As `PeopleSession.state` gave it."""
        cameras = sorted({name.split(".")[0] for name in self.arrays if name.startswith(_BACKGROUND)})
        return {
            "people": self.people,
            "clock": self.arrays["clock"],
            "unconfirmed": _part_of(self.arrays, _UNCONFIRMED),
            "backgrounds": [_part_of(self.arrays, f"{camera}.") for camera in cameras],
        }


def has_checkpoint(folder: Path) -> bool:
    """Whether an interrupted run lies in a folder of results."""
    return _state_path(folder).exists()


def save(
    folder: Path, run: dict[str, Any], state: dict[str, Any], added: list[tuple[int, Sighting]], num_parts: int
) -> None:
    """Save the state, and what was added to the tracks since `num_parts` other parts were saved.

    Raises:
        OSError: The disk is full, or the folder gone; the last checkpoint is as it was.
    """
    _state_path(folder).parent.mkdir(exist_ok=True)
    checkpoint.write_npz(_part_path(folder, num_parts), as_arrays(added))
    # The state comes last: a part without it is written again.
    arrays = {
        "clock": state["clock"],
        **{f"{_UNCONFIRMED}{name}": array for name, array in state["unconfirmed"].items()},
        **{
            f"{_BACKGROUND}{camera:03d}.{name}": array
            for camera, background in enumerate(state["backgrounds"])
            for name, array in ({"is_primed": np.asarray(bool(background))} | background).items()
        },
    }
    meta = {"run": run, "num_parts": num_parts + 1}
    checkpoint.save(_state_path(folder), {"people": state["people"], "arrays": arrays}, meta)


def load(folder: Path, run: dict[str, Any], session: PeopleSession) -> SavedTracks:
    """What `save` was given, all parts together.

    Args:
        folder: Of the results.
        run: Must equal that of the interrupted run.
        session: Of the same scene, for the structure of its people.

    Raises:
        CheckpointError: The run is another one, or a file is damaged.
    """
    path = _state_path(folder)
    names, meta = checkpoint.load_names(path)
    was = meta.get("run", {})
    if different := sorted(key for key in run | was if run.get(key) != was.get(key)):
        changes = ", ".join(f"{key} was {was.get(key)!r} and is {run.get(key)!r}" for key in different)
        raise CheckpointError(f"{folder} cannot be resumed: {changes}.")
    prefix = "tree['arrays']['"
    arrays = {name[len(prefix) : -2]: array for name, array in names.items() if name.startswith(prefix)}
    template = {"people": jax.device_get(session.tracks.people), "arrays": arrays}
    people = checkpoint.load(path, template)[0]["people"]
    parts = [checkpoint.read_arrays(_part_path(folder, i)) for i in range(int(meta["num_parts"]))]
    return SavedTracks(arrays, people, [one for part in parts for one in from_arrays(part)], len(parts))


def _part_of(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    found = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
    return {name: array for name, array in found.items() if name != "is_primed"}


def _state_path(folder: Path) -> Path:
    return folder / "checkpoint" / "state.npz"


def _part_path(folder: Path, index: int) -> Path:
    return folder / "checkpoint" / f"tracks_{index:06d}.npz"
