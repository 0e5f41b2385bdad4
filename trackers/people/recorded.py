"""Tracks as they are kept: collected while the tracker runs, and smoothed when a recording has ended."""

import itertools
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilters._xla.compiled_quickly import compiled_quickly
from jaxfilters._xla.from_host import from_host
from jaxfilters.gaussian.arithmetic import joseph
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.trackers.people.lifecycle import HIDDEN_SHARE
from jaxfilters.trackers.people.state import STATE, TENTATIVE, TRACKED, People, PeopleConfig, Report
from jaxfilters.trackers.people.tracker import motion

NO_IMAGE = -1
"""In place of the number of an image, where a camera had none."""
MOST_UNCONFIRMED = 1000
"""Frames of a candidate that follow its confirmation; older ones are forgotten. Candidates are confirmed or given up
within a few seconds, so this bounds the memory and nothing else."""


class Sighting(NamedTuple):
    """One person in one frame, which is one moment for all cameras."""

    frame: int
    time_s: float
    mean: np.ndarray
    """(9,): X, Y, velocity along X and Y, height, width, metres and metres per second; biases of the silhouette."""
    covariance: np.ndarray
    """(9, 9)."""
    score: float
    slot: int
    """Where the tracker kept this person: another one after a change of identities."""
    mode: str
    """`tentative`, `tracked`, `hidden` (occluded) or `no_depth` (not measurable along the line of sight)."""
    image: int = NO_IMAGE
    """Of the first camera: the number of its image, from 0; it has none in some frames if another camera is faster."""
    innovations: tuple[int, int] = (0, 0)
    """How many coordinates were compared with their prediction, and how many of these lie within its 95 % band."""


MODES = ("tentative", "tracked", "hidden", "no_depth")
"""Words in `Sighting.mode`."""


class Recorder:
    """Names sightings by identity; those from before a confirmation follow once there is an identity.

    Its memory depends on the capacity of the tracker and not on the length of the run, unless tracks are kept.
    """

    def __init__(self, *, keep_tracks: bool = True) -> None:
        """Nothing yet.

        Args:
            keep_tracks: Whether `tracks` collects all that `add` returns, about a kilobyte a person and frame.
        """
        self.tracks: dict[int, list[Sighting]] = {}
        """By identity; empty where they are not kept."""
        self.unconfirmed: dict[int, deque[Sighting]] = {}
        """By slot, at most `MOST_UNCONFIRMED` each."""
        self.ended: dict[int, int] = {}
        """The last frame of everybody who has a slot, by identity: who has none cannot come back."""
        self._keep_tracks = keep_tracks

    def add(self, frame: int, image: int, time_s: float, people: People, report: Report) -> list[tuple[int, Sighting]]:
        """The sightings of a frame and, for the newly confirmed, of the frames before.

        Args:
            frame: Its number.
            image: Number of the image of the first camera; `NO_IMAGE` without one.
            time_s: Seconds since the first frame.
            people: After the frame, NumPy leaves.
            report: Of the frame, NumPy leaves.
        """
        added: list[tuple[int, Sighting]] = []
        for slot, (mode, identity) in enumerate(zip(people.mode, people.identity, strict=True)):
            if mode not in (TENTATIVE, TRACKED):
                self.unconfirmed.pop(slot, None)
                continue
            sighting = _sighting(frame, image, time_s, slot, people, report)
            if mode == TENTATIVE:
                # A slot that was given up and taken again within one frame holds another person.
                if people.log_odds[slot] == 0:
                    self.unconfirmed.pop(slot, None)
                self.unconfirmed.setdefault(slot, deque(maxlen=MOST_UNCONFIRMED)).append(sighting)
                continue
            # Whoever comes back was perhaps followed anew, unconfirmed, before the old track had ended.
            ended = self.ended.get(int(identity), -1)
            added += [(int(identity), one) for one in [*self.unconfirmed.pop(slot, ()), sighting] if one.frame > ended]
        last = self.ended | {identity: sighting.frame for identity, sighting in added}
        self.ended = {identity: last[identity] for identity in map(int, people.identity) if identity in last}
        if self._keep_tracks:
            self.tracks = by_identity(added, self.tracks)
        return added

    def state(self) -> dict[str, dict[str, np.ndarray]]:
        """All but the tracks, as arrays to save."""
        ended = np.array([*self.ended.items()], np.int64).reshape(-1, 2)
        return {
            "unconfirmed": as_arrays([(slot, one) for slot, some in self.unconfirmed.items() for one in some]),
            "ended": {"identity": ended[:, 0], "frame": ended[:, 1]},
        }

    def restore(self, state: Mapping[str, Mapping[str, np.ndarray]], tracks: Sequence[tuple[int, Sighting]]) -> None:
        """Continue from what `state` gave; with the tracks up to then, where they are kept."""
        self.unconfirmed = {
            slot: deque(some, MOST_UNCONFIRMED) for slot, some in by_identity(from_arrays(state["unconfirmed"])).items()
        }
        ended = state["ended"]
        self.ended = dict(zip(ended["identity"].tolist(), ended["frame"].tolist(), strict=True))
        self.tracks = by_identity(tracks) if self._keep_tracks else {}


def by_identity(
    sightings: Sequence[tuple[int, Sighting]], tracks: dict[int, list[Sighting]] | None = None
) -> dict[int, list[Sighting]]:
    """Sightings at the ends of the tracks of their identities.

    Args:
        sightings: With their identities, in the order in which they became known.
        tracks: To which they are added in place; none by default.
    """
    tracks = {} if tracks is None else tracks
    for identity, sighting in sightings:
        tracks.setdefault(identity, []).append(sighting)
    return tracks


def as_arrays(sightings: Sequence[tuple[int, Sighting]]) -> dict[str, np.ndarray]:
    """Sightings with an integer each, as arrays to save."""
    columns = list(zip(*[(key, *sighting) for key, sighting in sightings], strict=True)) or [()] * (
        1 + len(Sighting._fields)
    )
    arrays = dict(zip(("key", *Sighting._fields), columns, strict=True))
    modes = [MODES.index(mode) for mode in arrays.pop("mode")]
    n = len(modes)
    return {
        **{name: np.asarray(arrays[name], np.int64) for name in ("key", "frame", "slot", "image")},
        **{name: np.asarray(arrays[name], np.float64) for name in ("time_s", "score")},
        "mean": np.reshape(np.asarray(arrays["mean"], np.float64), (n, STATE)),
        "covariance": np.reshape(np.asarray(arrays["covariance"], np.float64), (n, STATE, STATE)),
        "mode": np.asarray(modes, np.int64),
        "innovations": np.reshape(np.asarray(arrays["innovations"], np.int64), (n, 2)),
    }


def from_arrays(arrays: Mapping[str, np.ndarray]) -> list[tuple[int, Sighting]]:
    """Sightings as `as_arrays` was given them."""
    return [
        (
            int(arrays["key"][i]),
            Sighting(
                int(arrays["frame"][i]),
                float(arrays["time_s"][i]),
                arrays["mean"][i],
                arrays["covariance"][i],
                float(arrays["score"][i]),
                int(arrays["slot"][i]),
                MODES[int(arrays["mode"][i])],
                int(arrays["image"][i]),
                (int(arrays["innovations"][i, 0]), int(arrays["innovations"][i, 1])),
            ),
        )
        for i in range(len(arrays["key"]))
    ]


def _sighting(frame, image, time_s, slot, people, report) -> Sighting:
    mode = "tentative" if people.mode[slot] == TENTATIVE else "tracked"
    if mode == "tracked" and report.share_seen[slot] < HIDDEN_SHARE:
        mode = "hidden"
    elif mode == "tracked" and not report.has_depth[slot]:
        mode = "no_depth"
    return Sighting(
        frame,
        time_s,
        np.array(people.belief.mean[slot], np.float64),
        np.array(people.belief.covariance[slot], np.float64),
        float(report.score[slot]),
        slot,
        mode,
        image,
        (int(report.innovations[slot, 0]), int(report.innovations[slot, 1])),
    )


def spreads(centers: np.ndarray, sighting: Sighting) -> tuple[float, float]:
    """Standard deviations along and across the line of sight of the nearest camera, metres.

    Args:
        centers: (cameras, 2) where the cameras are above the floor, metres.
        sighting: Of whom.
    """
    away = sighting.mean[:2] - centers[np.argmin(np.sum((sighting.mean[:2] - centers) ** 2, axis=1))]
    distance = np.linalg.norm(away)
    x, y = away / distance if distance > 0.1 else np.array([0.0, 1.0])
    axes = np.array([[x, y], [y, -x]])
    radial, lateral = np.einsum("ai,ij,aj->a", axes, sighting.covariance[:2, :2], axes)
    return float(np.sqrt(max(radial, 0.0))), float(np.sqrt(max(lateral, 0.0)))


def smoothed(config: PeopleConfig, tracks: dict[int, list[Sighting]]) -> dict[int, list[Sighting]]:
    """The same tracks, every belief given all frames of its piece (H. Rauch, F. Tung, C. Striebel 1965).

    A gap longer than `hidden_s` seconds ends one piece and begins another, and so does a change of slots or a person
    who was lost and found again.
    """
    return {
        identity: [sighting for piece in pieces(track, config.hidden_s) for sighting in _smoothed(config, piece)]
        for identity, track in tracks.items()
    }


def pieces(track: list[Sighting], longest_s: float) -> list[list[Sighting]]:
    """A track cut where nothing ties the places before to those after: parts of it by frame, as `smoothed` has them."""
    ordered = sorted(track, key=lambda sighting: sighting.frame)
    pairs = enumerate(itertools.pairwise(ordered), 1)
    cuts = [i for i, (a, b) in pairs if b.time_s - a.time_s > longest_s or b.slot != a.slot or _is_found_again(a, b)]
    return [ordered[a:b] for a, b in zip([0, *cuts], [*cuts, len(ordered)], strict=True)]


def _is_found_again(before: Sighting, now: Sighting) -> bool:
    return now.mode == "tentative" and before.mode != "tentative"


def _smoothed(config: PeopleConfig, piece: list[Sighting]) -> list[Sighting]:
    length = len(piece)
    # One compilation for each power of two.
    padding = (1 << (length - 1).bit_length()) - length
    beliefs = Gaussian(
        from_host(np.stack([sighting.mean for sighting in piece] + [piece[-1].mean] * padding)),
        from_host(np.stack([sighting.covariance for sighting in piece] + [piece[-1].covariance] * padding)),
    )
    steps = np.diff([sighting.time_s for sighting in piece], append=piece[-1].time_s)
    found = _backward(config, beliefs, from_host(np.append(steps, np.zeros(padding))), length)
    mean, covariance = np.asarray(found.mean, np.float64), np.asarray(found.covariance, np.float64)
    return [sighting._replace(mean=mean[i], covariance=covariance[i]) for i, sighting in enumerate(piece)]


@partial(compiled_quickly, static_argnums=0)
def _backward(config: PeopleConfig, beliefs: Gaussian, steps: jax.Array, length: jax.Array) -> Gaussian:
    def back(following: Gaussian, inputs):
        belief, dt, is_last = inputs
        F, Q = motion(config, dt)
        given = joseph.rts(belief, following, F, Q)
        chosen = jax.tree.map(lambda now, smooth: jnp.where(is_last, now, smooth), belief, given)
        return chosen, chosen

    is_last = jnp.arange(len(steps)) >= length - 1
    last = jax.tree.map(lambda leaf: leaf[-1], beliefs)
    return jax.lax.scan(back, last, (beliefs, steps, is_last), reverse=True)[1]
