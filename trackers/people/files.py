"""Tracks of people in the formats of others: MOT-challenge text and COCO annotations."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxfilters.models.person.ellipsoid import VISIBLE, Outline, outline
from jaxfilters.trackers.io.errors import OutputError
from jaxfilters.trackers.io.undistortion import Undistortion
from jaxfilters.trackers.people.recorded import NO_IMAGE, Sighting
from jaxfilters.trackers.people.silhouettes import body_of, observed_place
from jaxfilters.trackers.people.state import PeopleScene

OUTLINE_POINTS = 64
"""Of an outline, from which the box in the video follows."""
BLOCK = 4096
"""Boxes that are computed in one call: the points of their outlines take 20 MB."""


def write_mot(path: Path, scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]]) -> None:
    """MOT-challenge text: `frame,id,left,top,width,height,confidence,x,y,z`, counted from 1, floor points in metres.

    Boxes are of the ellipsoid in the first camera, in pixels of its video, and frames are the images of this camera:
    there are no lines of the moments at which only others had an image.

    Raises:
        OutputError: it cannot be written.
    """
    lines = [
        f"{sighting.image + 1},{identity + 1},{left:.2f},{top:.2f},{width:.2f},{height:.2f},"
        f"{np.clip(sighting.score, 0, 1):.3f},{sighting.mean[0]:.3f},{sighting.mean[1]:.3f},0\n"
        for identity, sighting, (left, top, width, height) in _boxes(scene, undistortion, tracks)
    ]
    _write_text(path, "".join(lines))


def write_coco(path: Path, scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]]) -> None:
    """COCO annotations with `track_id`, `floor_xy_m` and `score`; images count from 0, boxes are as of `write_mot`.

    All images up to the last one with a box are listed: a reader may count them.

    Raises:
        OutputError: it cannot be written.
    """
    rows, cols = scene.cameras[0].shape
    found = _boxes(scene, undistortion, tracks)
    images = 1 + max((sighting.image for _, sighting, _ in found), default=-1)
    document = {
        "images": [{"id": i, "width": cols, "height": rows} for i in range(images)],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": [
            {
                "id": number,
                "image_id": sighting.image,
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
    scene: PeopleScene, undistortion: Undistortion, tracks: dict[int, list[Sighting]]
) -> list[tuple[int, Sighting, np.ndarray]]:
    """By image: identity, sighting, and left, top, width and height of all who are in the video of the first camera."""
    everyone = [(identity, sighting) for identity, sighting in by_frame(tracks) if sighting.image != NO_IMAGE]
    if not everyone:
        return []
    # One compilation for each power of two.
    length = 1 << (len(everyone) - 1).bit_length()
    means = np.stack([sighting.mean for _, sighting in everyone] + [everyone[0][1].mean] * (length - len(everyone)))
    shown = jax.device_get(_outlines(scene, jnp.asarray(means, jnp.float32)))
    visible = np.flatnonzero(shown.code[: len(everyone)] == VISIBLE)
    found: list[tuple[int, Sighting, np.ndarray]] = []
    for some in np.split(visible, range(BLOCK, len(visible), BLOCK)):
        boxes = _boxes_around(undistortion, shown.center[some], shown.shape[some])
        found += [(*everyone[i], box) for i, box in zip(some, boxes, strict=True)]
    return found


def _boxes_around(undistortion: Undistortion, center: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """(n, 4) left, top, width and height of ellipses (n, 2) and (n, 2, 2), in pixels with the lens distortion."""
    if not len(center):
        return np.zeros((0, 4))
    turns = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)])
    points = undistortion.distorted(center[:, None] + (_roots(shape) @ circle).swapaxes(1, 2))
    low, high = points.min(axis=1), points.max(axis=1)
    return np.concatenate([low, high - low], axis=1)


@jax.jit
def _outlines(scene: PeopleScene, means: Array) -> Outline:
    def one(mean):
        return outline(scene.cameras[0].P, body_of(observed_place(scene, mean)))

    return jax.vmap(one)(means)


def _roots(shapes: np.ndarray) -> np.ndarray:
    """Square roots of the matrices (n, 2, 2) of ellipses, symmetric so that points at right angles are extremes."""
    values, vectors = np.linalg.eigh(np.asarray(shapes, float))
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ vectors.swapaxes(1, 2)


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}.") from None


def by_frame(tracks: dict[int, list[Sighting]]) -> list[tuple[int, Sighting]]:
    """All sightings with their identities, by frame and identity."""
    everything = [(identity, sighting) for identity, track in tracks.items() for sighting in track]
    return sorted(everything, key=lambda item: (item[1].frame, item[0]))
