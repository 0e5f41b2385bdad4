"""Depths beside colours: what they change in a run, and what is refused."""

import csv
import json

import cv2
import numpy as np
import pytest

from jaxfilters.trackers import fingertips
from jaxfilters.trackers.app.cli import main

SHAPE, NUM_FRAMES, RADIUS = (240, 320), 20, 6.5
OPEN, CLOSED = (60, 110, 160, 210, 260), (60, 110, 160, 174, 260)
"""Columns of five parallel fingers; then the fourth touches the third, which ends 25 mm before it."""


def silhouette(columns):
    """Grey image of bars with round ends on a palm with a forearm, and its depths in millimetres."""
    image, depth = np.full(SHAPE, 40, np.uint8), np.full(SHAPE, 700, np.uint16)
    for target, value in ((image, 200), (depth, 600)):
        cv2.circle(target, (160, 150), 45, value, -1)
        cv2.rectangle(target, (135, 150), (185, 239), value, -1)
    for i in (0, 1, 3, 4, 2):
        begin, end = np.array([160 + (columns[i] - 160) / 4, 130]), np.array([columns[i], (95, 55, 40, 48, 80)[i]])
        for t in np.linspace(0, 1, 60):
            place = tuple(np.rint(begin + t * (end - begin)).astype(int).tolist())
            cv2.circle(image, place, 6, 200, -1)
            cv2.circle(depth, place, 6, round(600 - 25 * t) if i == 2 else 600, -1)
    return image, depth


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A folder of colour images, an open hand at first, and `.npz` with the depths of each."""
    folder = tmp_path_factory.mktemp("rgbd")
    (folder / "colour").mkdir()
    frames = [silhouette(OPEN if i < 3 else CLOSED) for i in range(NUM_FRAMES)]
    for i, (image, _) in enumerate(frames):
        cv2.imwrite(str(folder / "colour" / f"{i}.png"), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    K = np.array([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]])
    depth = np.stack([depth for _, depth in frames])
    np.savez(folder / "depth.npz", depth_mm=depth, K=K)
    np.savez(folder / "short.npz", depth_mm=depth[1:], K=K)
    np.savez(folder / "small.npz", depth_mm=depth[:, :120], K=K)
    np.savez(folder / "tenths.npz", depth_mm=depth // 10, K=K)
    return folder, frames


@pytest.mark.system
def test_fingers_that_touch_are_parted_by_the_depths_beside_a_video(recording, tmp_path):
    folder, _ = recording
    tips = {}
    for name, more in (("contour", []), ("edges", ["--depth", str(folder / "depth.npz")])):
        out = tmp_path / name
        assert main(["track", "fingertips", str(folder / "colour"), *more, "--no-video", "--out", str(out)]) == 0
        with (out / "track.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if row["frame"] == str(NUM_FRAMES - 1)]
        places = [(row["x_px"], row["y_px"]) for row in rows if row["status"] == "tracking"]
        tips[name] = np.array(places, float)
        assert json.loads((out / "report.json").read_text())["frames"] == NUM_FRAMES
    assert len(tips["contour"]) == 4
    assert len(tips["edges"]) == 5
    for place in ((160, 40), (174, 48)):
        assert np.linalg.norm(tips["edges"] - place, axis=1).min() < RADIUS


def test_depths_that_do_not_belong_to_the_video_are_refused(recording, tmp_path, capsys):
    folder, _ = recording
    out = ["--out", str(tmp_path / "out")]
    video, depth = str(folder / "colour"), str(folder / "depth.npz")
    for arguments, message in (
        ([video, "--depth", str(folder / "none.npz")], "no such file"),
        ([video, "--depth", str(folder / "short.npz")], "19 depth images beside 20 colour images"),
        ([video, "--depth", str(folder / "small.npz")], "320x120 pixels beside colour images of 320x240"),
        ([video, "--depth", str(folder / "tenths.npz")], "depth must be in metres"),
        ([depth, "--mask", "depth", "--depth", depth], "of no use with --mask depth"),
        (["--depth", depth], "expected VIDEO"),
        (["0", "--depth", depth], "expected VIDEO"),
        ([video, "--depth", depth, "--keypoints", "k.json"], "of no use with --keypoints"),
    ):
        assert main(["track", "fingertips", *arguments, *out]) == 2
        assert message in capsys.readouterr().err


def test_depths_in_memory_are_checked(recording):
    _, frames = recording
    images, depths = [image for image, _ in frames], [depth / 1000 for _, depth in frames]
    times = np.arange(NUM_FRAMES) / 30
    for wrong, mask, message in (
        (depths[1:], "infrared", "expected one for each of the 20 images; got 19"),
        (depths, "depth", "of no use with the mask 'depth'"),
        ([depth[1:] for depth in depths], "infrared", "depth must have the shape of mask"),
        ([1000 * depth for depth in depths], "infrared", "depth must be in metres"),
        ([depth for _, depth in frames], "infrared", "floats; got uint16"),
    ):
        with pytest.raises(ValueError, match=message):
            fingertips.track(images, times, mask, depths=wrong)
