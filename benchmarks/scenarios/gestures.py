"""Symbols: drawn ones of other writers (table 2), recorded ones of unseen people, and gestures spotted in a stream.

Models are trained on symbols of one synthetic writer and tested on six others, in percent; `_codes` is with the same
models from direction codes alone, `_published` with the paper's models of codes, whose best symbol counts, and
`_published_rejecting` with its threshold model. Oka, Sato and Koike report 99.2 and 97.5 % of people and shapes of
their own.

Recordings are read from the folder JAXFILTERS_DATA; what is missing there is said and left out. `midair_leap_gestures`
holds 26 symbols that fingertips drew in the air, with approach and retreat: every person is recognised from the strokes
of the others. `unipen_digits` holds digits by pens of several donors: each is recognised from at most 120 examples a
digit of each of the others. Settings are the same for both and were chosen with these recordings. An accuracy is
that of the best symbol of all strokes; `accepted` is the share that also beats the threshold model by the margin of the
symbol, and `accepted_right` the share of these that is right. Margins, and the temperature of the confidences whose
`calibration_error` is given, are fitted to the strokes of the other people, as `jaxfilters fit gestures` does.
`calibration_error_by_chance` is the mean of that error where every stroke is right with the probability that its
confidence says, and `_dtw` is the accuracy of the nearest stroke of the others by dynamic time warping, over every
twentieth stroke of `unipen_digits`.

`sfinge3d_gestures` holds streams of hands with 13 gestures to spot; `_sfinge.py` says what counts as detected. Settings
were chosen with these streams.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.benchmarks.recordings import RecordingError, recording_folder
from jaxfilters.benchmarks.scenarios._drawn_symbols import FULL, QUICK, drawn_metrics
from jaxfilters.benchmarks.scenarios._sfinge import sfinge_metrics
from jaxfilters.benchmarks.scenarios._simplest import nearest_by_warping
from jaxfilters.models.gesture.calibration import calibration_error
from jaxfilters.models.gesture.learning import accuracy, evaluated, leave_one_out, shown_of_others
from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.strokes import StrokeSet, read_strokes

RECORDINGS = {
    "midair_loso": ("midair_leap_gestures", "midair_leap.npz", None, 1),
    "unipen_unseen_donor": ("unipen_digits", "unipen_1a_digits.npz", 120, 20),
}
"""By the names of metrics: folder, file, most examples of a symbol that are estimated from one person, and of how many
strokes one is compared by time warping."""
CHANCES = 1000
"""Draws of what is right, for the calibration error by chance."""
SFINGE = "sfinge3d_gestures"
QUICK_PEOPLE, QUICK_SEQUENCES = 1, 3


def run(*, quick: bool, seed: int, out: Path | None) -> dict[str, Metric]:
    """Draw, learn and recognise; `out` is not used."""
    del out
    metrics = drawn_metrics(QUICK if quick else FULL, seed)
    missing = []
    for name in RECORDINGS:
        try:
            metrics |= recorded_metrics(name, quick=quick)
        except RecordingError as error:
            missing.append(str(error))
    try:
        metrics |= sfinge_metrics(recording_folder(SFINGE), most=QUICK_SEQUENCES if quick else None)
    except RecordingError as error:
        missing.append(str(error))
    for reason in missing:
        sys.stdout.write(f"left out: {reason}\n")
    return metrics


def recorded_metrics(name: str, *, quick: bool) -> dict[str, Metric]:
    """Accuracy of recorded strokes of people who were left out.

    Raises:
        RecordingError: if the recording is not there, or cannot be read.
    """
    folder, file, most, every = RECORDINGS[name]
    path = recording_folder(folder) / file
    try:
        recorded = read_strokes(path)
    except InputError as error:
        raise RecordingError(str(error)) from None
    people = sorted(set(recorded.people))[: QUICK_PEOPLE if quick else None]
    found = evaluated(leave_one_out(recorded.strokes, recorded.labels, recorded.people, most=most, left_out=people))
    right, confidence, beyond = (
        np.concatenate([getattr(one, field) for one in found]) for field in ("right", "confidence", "beyond")
    )
    accepted = beyond >= 0
    return {
        f"accuracy_{name}": Metric(accuracy(found), "%", "higher"),
        f"accuracy_{name}_worst_person": Metric(min(accuracy([one]) for one in found), "%", "higher"),
        f"accepted_{name}": Metric(100 * float(accepted.mean()), "%", "higher"),
        f"accepted_right_{name}": Metric(100 * float(right[accepted].mean()), "%", "higher"),
        f"calibration_error_{name}": Metric(calibration_error(confidence, right), "", "lower"),
        f"calibration_error_by_chance_{name}": Metric(_error_by_chance(confidence), "", "lower"),
        f"accuracy_{name}_dtw": Metric(_by_warping(recorded, people, most, every), "%", "higher"),
    }


def _error_by_chance(confidence: Float[np.ndarray, " n"]) -> float:
    """The mean calibration error of confidences that are true."""
    drawn = np.random.default_rng(0).uniform(size=(CHANCES, len(confidence))) < confidence
    return float(np.mean([calibration_error(confidence, right) for right in drawn]))


def _by_warping(recorded: StrokeSet, people: list[str], most: int | None, every: int) -> float:
    """Percent of the strokes of each person that are as the nearest of the others' by dynamic time warping."""
    paths = [np.concatenate(pieces) for pieces, _ in recorded.strokes]
    labels, writers = np.array(recorded.labels), np.array(recorded.people)
    right = []
    for person in people:
        known = shown_of_others(labels, writers, person, most)
        own = np.flatnonzero(writers == person)[::every]
        near = nearest_by_warping([paths[i] for i in known], labels[known].tolist(), [paths[i] for i in own])
        right.append(np.array(near) == labels[own])
    return 100 * float(np.concatenate(right).mean())
