"""Twelve shapes, drawn with one finger or with two: estimated from one writer, recognised of others (P, table 2).

The protocol is the paper's: 80 symbols of each of 24 kinds by one person, 20 of each by six others. A symbol is right
if both its shape and its number of fingers are, and wrong if it is rejected. Writers are not those with whom settings
were chosen.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxfilters.benchmarks.metrics import Metric
from jaxfilters.models.gesture.coded import learn_codes, learn_paths, recognise_each, recognise_paths
from jaxfilters.models.gesture.symbols import Recognition
from jaxfilters.models.synthetic.strokes import Tracked, drawn, tracked

FIRST_TRAINER, FIRST_TESTER = 30_000, 40_000
"""Seeds of writers."""


class Scale(NamedTuple):
    """How much is drawn."""

    trainers: int
    training_trials: int
    testers: int
    trials: int


FULL, QUICK = Scale(4, 80, 6, 20), Scale(1, 10, 2, 3)
METHODS: dict[str, tuple[str, Callable[..., Recognition], float]] = {
    "": ("paths", recognise_paths, 0.3),
    "_codes": ("paths", recognise_each, 0.3),
    "_published": ("codes", recognise_each, -np.inf),
    "_published_rejecting": ("codes", recognise_each, 0.0),
}
"""By what names of metrics end in: what is estimated, how it is recognised, and the margin over the threshold model."""


def drawn_metrics(scale: Scale, seed: int) -> dict[str, Metric]:
    """Accuracy with one finger and with two, mean and standard deviation over people, of each method."""
    others = [tracked(drawn(FIRST_TESTER + 100 * seed + i, scale.trials)) for i in range(scale.testers)]
    found: dict[str, list[np.ndarray]] = {name: [] for name in METHODS}
    for i in range(scale.trainers):
        shown = tracked(drawn(FIRST_TRAINER + 100 * seed + i, scale.training_trials))
        models = {"paths": learn_paths(shown.paths, shown.labels), "codes": learn_codes(shown.codes, shown.labels)}
        for name, (kind, judge, margin) in METHODS.items():
            scores = []
            for other in others:
                strokes = other.paths if judge is recognise_paths else other.codes
                scores.append(scored(models[kind].names, judge(models[kind], strokes, margin=margin), other))
            found[name].append(np.array(scores))
    metrics: dict[str, Metric] = {}
    for name, of_trainers in found.items():
        over_trainers = np.mean(of_trainers, axis=0)
        for k, fingers in enumerate(("one_finger", "two_fingers")):
            metrics[f"accuracy_{fingers}{name}"] = Metric(float(over_trainers[:, k].mean()), "%", "higher")
            metrics[f"sd_{fingers}{name}"] = Metric(float(over_trainers[:, k].std()), "%", "lower")
    return metrics


def scored(names: tuple[str, ...], evaluated: Recognition, drawings: Tracked) -> list[float]:
    """Percent of a person's symbols that are right, of those with one finger and of those with two."""
    labels = np.array(drawings.labels)
    right = np.array([*names, ""])[evaluated.label] == labels
    return [100 * float(right[np.char.endswith(labels, fingers)].mean()) for fingers in ("1", "2")]
