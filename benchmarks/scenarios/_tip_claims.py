"""Claimed standard deviations of fingertips: rendered hands through detection, and tips marked by hand in a real video.

A tip belongs to the nearest true one, at most half the width of a finger away: what is farther off is a false tip, and
no error of a true one. The claims were chosen on another marked video. Errors of marked tips include that of the person
who marked them.
"""

import jax
import numpy as np

from jaxfilters.benchmarks.recordings import recording_folder
from jaxfilters.benchmarks.scenarios import fingertips
from jaxfilters.benchmarks.scenarios._claims import Claims, Recording
from jaxfilters.benchmarks.scenarios._marked_tips import NAMES, images_of, marks, pairs_of, pairs_within, tips_of
from jaxfilters.models.fingertip.observation import MAX_TIPS
from jaxfilters.trackers.fingertips.images import track
from jaxfilters.trackers.fingertips.state import FingertipConfig
from jaxfilters.trackers.fingertips.tracker import MODERN

COORDINATES = ("x_px", "y_px")
NUM_FRAMES, QUICK_NUM_FRAMES = 300, 12
HELD, QUICK_MARKED = "dexretarget_hand_video", 4
"""The marked video on which the claims were not chosen, which is `desk_hand_video`; and how many frames of it."""
HALF_WIDTH_PX = 12.0
"""Of a rendered finger near its tip."""


def rendered_claims(quick: bool, seed: int) -> Claims:
    """Fingers of rendered hands with one to five out, blurred by lens and motion; one recording a finger."""
    key = jax.random.key(seed)
    parameters, recordings = fingertips.open_hand(key), list[Recording]()
    for count in range(1, MAX_TIPS + 1):
        frames = fingertips.render(key, count, QUICK_NUM_FRAMES if quick else NUM_FRAMES)
        observed = fingertips.stacked([fingertips.detected(frame.image, parameters) for frame in frames])
        report = fingertips.follow(FingertipConfig(), MODERN, jax.tree.map(lambda leaf: leaf[None], observed))
        position, is_tip, sd = (np.asarray(part[0]) for part in (report.position, report.is_tip, report.sd))
        recordings += by_finger(position, is_tip, sd, np.stack([frame.tips[frame.extended] for frame in frames]))
    return Claims("fingertips", "rendered", COORDINATES, recordings)


def marked_claims(quick: bool, seed: int) -> Claims:
    """Fingers of a real video in its 20 marked frames, one recording a finger."""
    del seed
    marked = marks(HELD)
    of_frames = dict(list(marked["frames"].items())[: QUICK_MARKED if quick else None])
    images = images_of(recording_folder(HELD) / marked["file"])
    images = images[: max(map(int, of_frames)) + 1]
    report, _ = track(images, np.arange(len(images)) / 30, "colour")
    rows = {finger: list[tuple[np.ndarray, float]]() for finger in NAMES}
    for frame, own in of_frames.items():
        tips = tips_of(report, int(frame))
        deviations = np.asarray(report.sd[int(frame), 0])[np.asarray(report.is_tip[int(frame), 0])]
        for finger, i in pairs_of(own, tips, float(marked["half_width_px"])).items():
            if finger in own["tips"]:
                rows[finger].append((tips.position[i] - np.array(own["tips"][finger]), deviations[i]))
    recordings = [_recording(of_finger) for of_finger in rows.values() if of_finger]
    return Claims("fingertips", "marked", COORDINATES, recordings)


def by_finger(position: np.ndarray, is_tip: np.ndarray, sd: np.ndarray, truth: np.ndarray) -> list[Recording]:
    """Errors of what is reported of one hand, one recording a finger.

    Args:
        position: (frames, slots, 2) pixels.
        is_tip: (frames, slots) which of them are reported.
        sd: (frames, slots) pixels, claimed of either coordinate.
        truth: (frames, fingers, 2) pixels.

    Returns:
        NaN where a true tip has none within `HALF_WIDTH_PX`.
    """
    errors, deviations = np.full(truth.shape, np.nan), np.full(truth.shape, np.nan)
    for frame, own in enumerate(truth):
        tips, claimed = position[frame][is_tip[frame]], sd[frame][is_tip[frame]]
        for finger, tip in pairs_within(own, tips, HALF_WIDTH_PX):
            errors[frame, finger], deviations[frame, finger] = tips[tip] - own[finger], claimed[tip]
    return [Recording(errors[:, i], deviations[:, i]) for i in range(truth.shape[1])]


def _recording(rows: list[tuple[np.ndarray, float]]) -> Recording:
    errors = np.array([error for error, _ in rows], float)
    return Recording(errors, np.repeat(np.array([deviation for _, deviation in rows], float)[:, None], 2, axis=1))


SYSTEMS = {
    "fingertips, rendered hands": rendered_claims,
    "fingertips, marked by hand": marked_claims,
}
"""As in `honesty`."""
