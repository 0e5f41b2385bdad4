"""Gestures found in a stream of points: estimated from annotated streams, and from what lies between the gestures.

A network says what each frame shows, a gesture or the background, which it knows from the frames of the streams that
have no annotation. A hidden semi-Markov model with the durations of gestures and of gaps makes segments of that. Both
need frames ahead: a gesture is reported at the earliest `LATENCY_FRAMES` after its last frame.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from scipy.stats import lognorm

from jaxfilters import hmm
from jaxfilters.filter import run
from jaxfilters.hmm import Segment, SemiMarkovModel
from jaxfilters.models.gesture import frame_classifier, poses
from jaxfilters.models.gesture.frame_classifier import UNLABELLED, Example, FrameClassifier
from jaxfilters.models.gesture.poses import RATE_HZ, PoseTemplate
from jaxfilters.typing import AnyKey

TEMPER = 0.3
"""Share of a frame's log posterior that counts: neighbouring frames say nearly the same."""
PATIENCE = 3
"""Frames for which the best segmentation has to have gone on without a gesture before it is reported."""
LOOKAHEAD = poses.REACH + frame_classifier.REACH
LATENCY_FRAMES = LOOKAHEAD + PATIENCE
"""At `RATE_HZ`."""
EXAMPLE_SHARE = 3 / 8
"""Of the windows in training, where there are examples of single gestures beside streams."""
NUM_VERSIONS = 8
"""Of each stream in training: as it is, and distorted."""
SPEEDS, TURN_RAD = (0.75, 1.35), 0.15
"""Range of speeds at which distorted streams are played, and standard deviation of their turns about each axis."""
BLURRED_ENDS = 3
"""Frames at both ends of an example of a single gesture that may be none yet."""
LONGEST = 160
"""Frames up to which durations have probabilities of their own."""
_BROADER, _GAP_SHAPE, _GAP_TAIL = 1.2, 0.6, 0.97
_BLOCK = 512
_CERTAIN = -50.0


class Stream(NamedTuple):
    """A recording of points, and where gestures are in it."""

    points: Float[np.ndarray, "t j d"]
    """NaN in frames without an observation."""
    rate_hz: float
    segments: tuple[Segment, ...] = ()
    """Labels index the names of the gestures."""
    name: str = ""

    @property
    def is_example(self) -> bool:
        """Whether it is of one gesture from its first to its last frame."""
        return len(self.segments) == 1 and self.segments[0][1:] == (0, len(self.points) - 1)


class StreamModel(NamedTuple):
    """What gestures in a stream look like, and how long they last."""

    names: tuple[str, ...]
    template: PoseTemplate
    classifier: FrameClassifier
    """Its last class is the background."""
    durations: SemiMarkovModel
    """Of the same classes."""


class Spotted(NamedTuple):
    """A gesture that was found."""

    segment: Segment
    """In frames of the stream."""
    confidence: float
    """Mean posterior probability of the gesture in its frames."""
    reported: int
    """Frame of the stream with which it is known."""


def learn_streams(
    key: AnyKey,
    streams: Sequence[Stream],
    names: tuple[str, ...],
    *,
    num_steps: int = frame_classifier.NUM_STEPS,
) -> StreamModel:
    """A model of the gestures in annotated streams; whatever is not annotated in them is background.

    Args:
        key: Random key of the training.
        streams: Annotated streams, and perhaps examples of single gestures, which say nothing of the background.
        names: Of the gestures.
        num_steps: Of the training.

    Raises:
        ValueError: If no stream has frames of background, a gesture has no example, a segment is outside of its stream,
            streams have different numbers of points or dimensions, or points do not move.
    """
    _check(streams, names)
    distortion_key, training_key = jax.random.split(key)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(distortion_key)))
    first = [_resampled(stream, len(names)) for stream in streams]
    template = poses.fit_template([points for points, _ in first])
    examples = [
        [
            Example(poses.pose_features(template, points), classes)
            for points, classes in [own, *(_distorted(rng, stream, len(names)) for _ in range(NUM_VERSIONS - 1))]
        ]
        for own, stream in zip(first, streams, strict=True)
    ]
    weights = np.array([len(classes) for _, classes in first], float)
    single = np.array([stream.is_example for stream in streams])
    share = EXAMPLE_SHARE if single.any() else 0.0
    for kind, part in ((single, share), (~single, 1 - share)):
        weights[kind] *= part / max(weights[kind].sum(), 1.0)
    classifier = frame_classifier.train(training_key, examples, weights, len(names) + 1, num_steps=num_steps)
    return StreamModel(names, template, classifier, _durations(streams, len(names)))


def spot(model: StreamModel, stream: Stream) -> list[Spotted]:
    """The gestures in a stream, each found from no frame later than the one with which it is reported.

    Raises:
        ValueError: If the stream has other points than the model, or none that is observed.
    """
    if stream.points.shape[1:] != model.template.shape.shape:
        raise ValueError(
            f"stream must have points {model.template.shape.shape} in every frame, as those of the model; "
            f"got {stream.points.shape[1:]}."
        )
    points, places, present = poses.resampled(stream.points, stream.rate_hz)
    features = poses.pose_features(model.template, points)
    num_frames = -(-(len(features) + PATIENCE) // _BLOCK) * _BLOCK
    padded = np.pad(features, ((0, num_frames - len(features)), (0, 0)), mode="edge")
    logs = np.asarray(frame_classifier.log_posteriors(model.classifier, jnp.asarray(padded)))[: len(features)]
    scores = np.full((num_frames, logs.shape[1]), _CERTAIN)
    scores[:, -1] = 0.0  # behind the end is background
    scores[: len(logs)] = np.where(present[:, None], TEMPER * logs, 0.0)
    infos = _spotted(model.durations, jnp.asarray(scores, jnp.float32))
    found = []
    for frame in np.flatnonzero(infos.reports).tolist():
        label, start, end = (int(leaf[frame]) for leaf in infos.found[:3])
        last = min(frame + LOOKAHEAD, len(places) - 1)
        own = Segment(label, *(int(np.rint(places[i])) for i in (start, end)))
        found.append(Spotted(own, float(np.exp(logs[start : end + 1, label]).mean()), int(np.ceil(places[last]))))
    return found


def leave_streams_out(
    key: AnyKey,
    streams: Sequence[Stream],
    names: tuple[str, ...],
    *,
    num_folds: int = 6,
    num_steps: int = frame_classifier.NUM_STEPS,
) -> list[list[Spotted] | None]:
    """What is found in each stream by a model of others; `None` for examples of single gestures, always trained with.

    Raises:
        ValueError: If there are fewer than two streams that are no examples, or as for `learn_streams`.
    """
    whole = [i for i, stream in enumerate(streams) if not stream.is_example]
    if len(whole) < 2:
        raise ValueError(f"streams must hold at least two with background, to leave some out; got {len(whole)}.")
    found: list[list[Spotted] | None] = [None] * len(streams)
    folds = min(num_folds, len(whole))
    for fold in range(folds):
        left_out = set(whole[fold::folds])
        others = [stream for i, stream in enumerate(streams) if i not in left_out]
        model = learn_streams(jax.random.fold_in(key, fold), others, names, num_steps=num_steps)
        for i in left_out:
            found[i] = spot(model, streams[i])
    return found


@jax.jit
def _spotted(model: SemiMarkovModel, scores: Float[jax.Array, "t q"]) -> Any:
    filter = hmm.semi_markov_spotter(model, scores.shape[1] - 1, patience=PATIENCE)
    # The filter draws nothing with its key.
    return run(filter, jnp.zeros(2, jnp.uint32), scores, collect=_info)[1]


def _info(state: Any, info: Any) -> Any:
    del state
    return info


def _check(streams: Sequence[Stream], names: tuple[str, ...]) -> None:
    shapes = {stream.points.shape[1:] for stream in streams}
    if len(shapes) != 1:
        raise ValueError(f"streams must share their points (J, D) in a frame; got {sorted(shapes)}.")
    for stream in streams:
        if not len(stream.points) > 1 or not stream.rate_hz > 0:
            raise ValueError(f"stream {stream.name} must have two frames or more and a rate above 0.")
        for label, start, end in stream.segments:
            if not (0 <= label < len(names) and 0 <= start <= end < len(stream.points)):
                raise ValueError(
                    f"segments of stream {stream.name} must have one of {len(names)} labels and lie in its "
                    f"{len(stream.points)} frames; got {(label, start, end)}."
                )
    shown = {segment.label for stream in streams for segment in stream.segments}
    if missing := [name for i, name in enumerate(names) if i not in shown]:
        raise ValueError(f"streams must show every gesture; none shows {', '.join(missing)}.")
    if not any(np.any(_classes(stream, len(names)) == len(names)) for stream in streams):
        raise ValueError("streams must have frames outside of the gestures, from which the background is estimated.")


def _classes(stream: Stream, background: int) -> Int[np.ndarray, " t"]:
    classes = np.full(len(stream.points), background)
    for label, start, end in stream.segments:
        classes[start : end + 1] = label
    if stream.is_example:
        blurred = max(1, round(BLURRED_ENDS * stream.rate_hz / RATE_HZ))
        classes[:blurred] = classes[-blurred:] = UNLABELLED
    return classes


def _resampled(stream: Stream, background: int, speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Points and classes at `RATE_HZ`."""
    points, places, present = poses.resampled(stream.points, stream.rate_hz, speed)
    classes = _classes(stream, background)[np.rint(places).astype(int)]
    return points, np.where(present, classes, UNLABELLED)


def _distorted(rng: np.random.Generator, stream: Stream, background: int) -> tuple[np.ndarray, np.ndarray]:
    """As if another person had done it: played at another speed, and turned."""
    points, classes = _resampled(stream, background, float(rng.uniform(*SPEEDS)))
    if points.shape[2] == 3:
        turn = Rotation.from_rotvec(rng.normal(0, TURN_RAD, 3)).as_matrix()
    else:
        angle = rng.normal(0, TURN_RAD)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return points @ turn.T, classes


def _durations(streams: Sequence[Stream], background: int) -> SemiMarkovModel:
    """Of all gestures alike, and of the gaps: discretised log-normal distributions, those of gaps with a tail."""
    whole = [stream for stream in streams if not stream.is_example]
    annotated = [stream for stream in whole if stream.segments] or streams
    lasting = np.array(
        [(s.end - s.start + 1) * RATE_HZ / stream.rate_hz for stream in annotated for s in stream.segments]
    )
    pairs = [
        (b.start - a.end - 1, RATE_HZ / stream.rate_hz)
        for stream in whole
        for a, b in pairwise(sorted(stream.segments, key=lambda segment: segment.start))
    ]
    gaps = np.array([gap * scale for gap, scale in pairs if gap > 0] or [float(np.median(lasting))])
    direct = (sum(gap <= 0 for gap, _ in pairs) + 1) / (len(pairs) + 2)
    frames = np.arange(1, LONGEST + 1)
    spread = max(_BROADER * float(np.log(lasting).std()), 0.2)
    densities = [
        lognorm.pdf(frames, spread, scale=float(np.exp(np.log(lasting).mean()))),
        lognorm.pdf(frames, _GAP_SHAPE, scale=float(np.exp(np.log(gaps).mean()))),
    ]
    of_gesture, of_gap = (density / density.sum() for density in densities)
    rows = np.stack([*[of_gesture] * background, of_gap])
    follows = np.zeros((background + 1, background + 1))
    follows[:-1, :-1], follows[:-1, -1], follows[-1, :-1] = direct / background, 1 - direct, 1 / background
    tail = np.append(np.full(background, 0.5), _GAP_TAIL)
    first = np.full(background + 1, 1 / (background + 1))
    return hmm.semi_markov(first, follows, rows, tail=tail)
