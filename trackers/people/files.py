"""Tracks of people in the formats of others: MOT-challenge text and COCO annotations."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.models.person.ellipsoid import VISIBLE, Outline, outline
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.recorded import Sighting
from jaxfilters.trackers.people.silhouettes import body_of, observed_place
from jaxfilters.trackers.people.state import PeopleScene

OUTLINE_POINTS = 64
"""Of an outline, from which the box in the video follows."""


def write_mot(
    path: Path, scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]], camera: int = 0
) -> None:
    """MOT-challenge text: `frame,id,left,top,width,height,confidence,x,y,z`, counted from 1, floor points in metres.

    Boxes are of the ellipsoid in one camera, in pixels of its video.

    Raises:
        OutputError: it cannot be written.
    """
    lines = [
        f"{sighting.frame + 1},{identity + 1},{left:.2f},{top:.2f},{width:.2f},{height:.2f},"
        f"{np.clip(sighting.score, 0, 1):.3f},{sighting.mean[0]:.3f},{sighting.mean[1]:.3f},0\n"
        for identity, sighting, (left, top, width, height) in _boxes(scene, undistortion, tracks, camera)
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
        "images": [
            {"id": i, "width": cols, "height": rows} for i in sorted({sighting.frame for _, sighting, _ in found})
        ],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [
            {
                "id": number,
                "image_id": sighting.frame,
                "category_id": 1,
                "track_id": identity,
                "bbox": [round(float(edge), 2) for edge in box],
                "area": round(float(box[2] * box[3]), 2),
                "iscrowd": 0,
                "score": round(float(np.clip(sighting.score, 0, 1)), 3),
                "floor_xy_m": [round(float(x), 3) for x in sighting.mean[:2]],
            }
            for number, (identity, sighting, box) in enumerate(found, 1)
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
    means = np.stack([sighting.mean for _, sighting in everyone] + [everyone[0][1].mean] * (length - len(everyone)))
    shown = jax.device_get(_outlines(scene, jnp.asarray(means, jnp.float32), camera))
    turns = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)])
    found = []
    for (identity, sighting), code, center, shape in zip(everyone, shown.code, shown.center, shown.shape, strict=False):
        if code == VISIBLE:
            points = undistortion.distorted(center + (_root(shape) @ circle).T)
            low, high = points.min(axis=0), points.max(axis=0)
            found.append((identity, sighting, np.concatenate([low, high - low])))
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


def by_frame(tracks: dict[int, list[Sighting]]) -> list[tuple[int, Sighting]]:
    """All sightings with their identities, by frame and identity."""
    everything = [(identity, sighting) for identity, track in tracks.items() for sighting in track]
    return sorted(everything, key=lambda item: (item[1].frame, item[0]))
