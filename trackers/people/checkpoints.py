"""An interrupted run of the people tracker on disk: what the next images need, and the tracks so far."""

from pathlib import Path
from typing import Any, NamedTuple

from jaxfilters.trackers.io import checkpoint
from jaxfilters.trackers.people.recorded import Sighting, as_arrays, from_arrays


class SavedTracks(NamedTuple):
    """What a checkpoint holds."""

    state: dict[str, Any]
    """As `PeopleSession.state` gave it."""
    tracks: list[tuple[int, Sighting]]
    """By identity."""
    num_parts: int
    """Files with tracks."""


def save(
    folder: Path, run: dict[str, Any], state: dict[str, Any], added: list[tuple[int, Sighting]], num_parts: int
) -> None:
    """Save the state, and what was added to the tracks since `num_parts` other parts were saved.

    Raises:
        OSError: The disk is full, or the folder gone; the last checkpoint is as it was.
    """
    checkpoint.state_path(folder).parent.mkdir(exist_ok=True)
    checkpoint.write_npz(_part_path(folder, num_parts), as_arrays(added))
    # The state comes last: a part without it is written again.
    checkpoint.save(checkpoint.state_path(folder), state, {"run": run, "num_parts": num_parts + 1})


def load(folder: Path, run: dict[str, Any]) -> SavedTracks:
    """What `save` was given, all parts together.

    Args:
        folder: Of the results.
        run: Must equal that of the interrupted run.

    Raises:
        CheckpointError: The run is another one, or a file is damaged.
    """
    checkpoint.check_same_run(folder, run)
    state, meta = checkpoint.load(checkpoint.state_path(folder))
    parts = [checkpoint.read_arrays(_part_path(folder, i)) for i in range(int(meta["num_parts"]))]
    return SavedTracks(state, [one for part in parts for one in from_arrays(part)], len(parts))


def _part_path(folder: Path, index: int) -> Path:
    return folder / "checkpoint" / f"tracks_{index:06d}.npz"
