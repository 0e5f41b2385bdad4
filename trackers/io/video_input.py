"""Where images come from: video files, folders of images, and live cameras; several of them on one clock."""

import itertools
import math
import re
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np

from jaxfilters.trackers.io.errors import InputError
from jaxfilters.trackers.io.images import check_num_pixels, images_in, read_image
from jaxfilters.trackers.io.input_files import check_rate, check_regular, exists, is_folder

DEFAULT_FPS = 30.0
_Item = TypeVar("_Item")
_SLOWEST_FPS, _FASTEST_FPS = 1e-3, 1e6
_MOST_DIGITS = 4
"""Of a live camera's number: OpenCV's largest ones, which begin with that of a backend, have as many."""
SILENT_S = 2.0
"""A live camera that delivers nothing for so long has stopped."""
_SAME_STEP = 0.1
"""Names of two folders count alike if their usual steps differ by no more than this share."""


@runtime_checkable
class VideoSource(Protocol):
    """One camera's images in their order."""

    name: str
    image_size: tuple[int, int]
    """Columns and rows."""
    fps: float

    def sample(self, most: int) -> list[np.ndarray]:
        """Up to `most` images spread over the recording; none of a live camera."""

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        """Seconds and the image (rows, cols, 3); None where a live camera has nothing new.

        Recordings begin at 0; live cameras share a clock, which began some time before.
        """

    def trouble(self) -> str | None:
        """What went wrong while it was read, for a person; None if nothing did."""


def open_video(place: str, *, fps: float | None = None) -> VideoSource:
    """A video file, a folder of images, or the number of a live camera.

    Args:
        place: A path, or a number such as 0. Longer numbers, such as times, name files and folders.
        fps: Frames per second of a recording, in place of what it says of itself.

    Raises:
        InputError: nothing there, nothing that OpenCV can read, or a rate that is not finite and positive.
    """
    if fps is not None:
        check_rate(fps)
    if re.fullmatch(rf"\d{{1,{_MOST_DIGITS}}}", place, re.ASCII):
        return LiveCamera(int(place))
    path = Path(place)
    if is_folder(path):
        return ImageFolder(path, fps or DEFAULT_FPS)
    if not exists(path):
        number = f"its number, of at most {_MOST_DIGITS} digits, as in 0"
        raise InputError(f"{path}: no such file or folder; a live camera is given by {number}.")
    return VideoFile(path, fps)


def spread(items: Sequence[_Item], most: int) -> list[_Item]:
    """At most so many of the items, from the first to the last of them at equal distances."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


class VideoFile:
    """A video that OpenCV can decode."""

    def __init__(self, path: Path, fps: float | None = None):
        self.name, self._path, self._is_stamped = str(path), path, fps is None
        check_regular(path, "expected a video file; a live camera is given by its number, as in 0")
        capture = self._open()
        self.image_size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.fps = _rate(float(capture.get(cv2.CAP_PROP_FPS))) if fps is None else check_rate(fps)
        self.frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        """As the file claims; there may be more or fewer."""
        capture.release()
        check_num_pixels(*self.image_size, self.name)
        self._trouble: str | None = None

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened() or not capture.get(cv2.CAP_PROP_FRAME_WIDTH):
            raise InputError(f"{self.name}: not a video that can be decoded (damaged, empty, or an unknown codec).")
        return capture

    def sample(self, most: int) -> list[np.ndarray]:
        """Every n-th image; decoded in order, since seeking is not exact in all containers.

        Where the file has more frames than it claims, every second of the images is dropped whenever there are twice
        too many.
        """
        every, kept = max(1, self.frames // most), []
        for i, (_, image) in enumerate(self.images()):
            if i % every == 0 and image is not None:
                kept.append(image)
            if len(kept) > 2 * most:
                every, kept = 2 * every, kept[::2]
        return spread(kept, most)

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        capture, done = self._open(), 0
        stamps = _Stamps(1 / self.fps)
        try:
            while True:
                image = _next_image(capture)
                if image is None:
                    break
                stamp_s = 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC)
                yield (stamps.next(stamp_s) if self._is_stamped else done / self.fps), image
                done += 1
        finally:
            capture.release()
        if done == 0:
            raise InputError(f"{self.name}: no frame can be decoded.")
        said = []
        if self.frames > 0 and done < self.frames:
            said.append(f"ends after {done} of {self.frames} frames (cut off or damaged)")
        if stamps.late and self._is_stamped:
            said.append(
                f"{stamps.late} time stamps do not increase; these frames were taken to follow the one before by "
                f"1/{self.fps:g} s (--fps takes the place of all stamps)"
            )
        self._trouble = f"{self.name}: {', and '.join(said)}" if said else None

    def trouble(self) -> str | None:
        return self._trouble


def _rate(claimed: float) -> float:
    """Frames per second as a file or a camera claims them, or the usual ones where it claims none or nonsense."""
    return claimed if math.isfinite(claimed) and _SLOWEST_FPS <= claimed <= _FASTEST_FPS else DEFAULT_FPS


def _next_image(capture: Any) -> np.ndarray | None:
    """The next image; None at the end, and where one cannot be decoded."""
    try:
        there, image = capture.read()
    except cv2.error:
        return None
    return image if there else None


class _Stamps:
    """Times of the frames of a video as its file says them, from the first one.

    Where it says nothing, for which OpenCV gives 0, or a time that is not after that of the frame before, a frame is
    one period after that frame: images are decoded in their order, whatever their stamps.
    """

    def __init__(self, period_s: float):
        self._period_s, self._first_s, self._last_s, self._claimed_s = period_s, 0.0, -period_s, -math.inf
        self.late = 0
        """Frames whose stamps were not after those of the frames before them."""

    def next(self, claimed_s: float) -> float:
        if self._last_s < 0:
            self._first_s = claimed_s
        since_s = claimed_s - self._first_s
        is_later = math.isfinite(since_s) and since_s > self._last_s
        self._last_s = since_s if is_later else self._last_s + self._period_s
        if math.isfinite(claimed_s) and claimed_s > 0:
            # Frames without a stamp may have been counted further than the next stamp is, which is then not late.
            self.late += claimed_s <= self._claimed_s
            self._claimed_s = claimed_s
        return self._last_s


class ImageFolder:
    """Images of one size in a folder, in the order of their names, or of the numbers that are all that differs in them.

    Numbers that grow, counters or time stamps, are the clock of the images: what was dropped leaves a gap. The usual
    step from one to the next is one period of the frame rate.

    Raises:
        InputError: nothing that can be read, or two images of one number.
    """

    def __init__(self, path: Path, fps: float):
        self.name, self.fps = str(path), check_rate(fps)
        self._files = _by_number(images_in(path), path)
        rows, cols = read_image(self._files[0]).shape[:2]
        self.image_size, self.frames = (cols, rows), len(self._files)

    def numbers(self) -> np.ndarray | None:
        """The numbers with which the names end, counters or time stamps; None unless all have one and they grow."""
        ends = [re.search(r"(\d+)$", file.stem) for file in self._files]
        found = np.asarray([int(end[0]) for end in ends if end is not None], float)
        return found if len(found) == len(ends) and (np.diff(found) > 0).all() else None

    def sample(self, most: int) -> list[np.ndarray]:
        return [read_image(file) for file in spread(self._files, most)]

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        numbers = self.numbers()
        numbers = np.arange(float(self.frames)) if numbers is None else numbers
        times_s = (numbers - numbers[0]) / (_usual_step(numbers) * self.fps)
        for time_s, file in zip(times_s, self._files, strict=True):
            image = read_image(file)
            if image.shape[1::-1] != self.image_size:
                raise InputError(f"{file}: {image.shape[1]}x{image.shape[0]} pixels; the first has {self.image_size}.")
            yield float(time_s), image

    def trouble(self) -> str | None:
        return None


def _usual_step(numbers: np.ndarray) -> float:
    """From one number to the next; a quartile, since dropped frames make steps longer, and may be many."""
    return float(np.quantile(np.diff(numbers), 0.25, method="lower")) if len(numbers) > 1 else 1.0


def _by_number(files: list[Path], folder: Path) -> list[Path]:
    """The images in the order of the numbers with which their names end, where nothing else differs in the names.

    Raises:
        InputError: two of them have one number.
    """
    ends = [re.fullmatch(r"(.*?)(\d+)", file.stem, re.ASCII | re.DOTALL) for file in files]
    found = [(end[1], int(end[2])) for end in ends if end is not None]
    if len(found) < len(files) or len({before for before, _ in found}) > 1:
        return files
    order = sorted(range(len(files)), key=lambda i: found[i][1])
    for one, other in itertools.pairwise(order):
        if found[one][1] == found[other][1]:
            raise InputError(
                f"{folder}: {files[one].name} and {files[other].name} have one frame number; a folder must hold one "
                "recording."
            )
    return [files[i] for i in order]


class LiveCamera:
    """A camera of this machine, read in a thread of its own: the newest image counts, what was missed is missed."""

    is_live = True

    def __init__(self, number: int):
        self.name = f"camera {number}"
        self._capture = cv2.VideoCapture(number)
        image = _next_image(self._capture)
        if image is None:
            self._capture.release()
            raise InputError(f"{self.name}: cannot be opened, or delivers no image.")
        self.image_size = (image.shape[1], image.shape[0])
        self.fps = _rate(float(self._capture.get(cv2.CAP_PROP_FPS)))
        self._newest: tuple[float, np.ndarray] | None = None
        self._trouble: str | None = None
        self._lock, self._arrived, self._over = threading.Lock(), threading.Event(), threading.Event()

    def sample(self, most: int) -> list[np.ndarray]:  # noqa: ARG002
        return []

    def images(self) -> Iterator[tuple[float, np.ndarray | None]]:
        threading.Thread(target=self._follow, daemon=True).start()
        began = heard = time.monotonic()
        try:
            while True:
                self._arrived.wait(1 / self.fps)
                with self._lock:
                    newest, self._newest = self._newest, None
                    self._arrived.clear()
                now = time.monotonic()
                heard = now if newest is not None else heard
                if now - heard > SILENT_S and self._trouble is None:
                    self._trouble = f"{self.name}: no image since {heard - began:.0f} s after the start"
                yield (now, None) if newest is None else newest
        finally:
            self._over.set()

    def _follow(self) -> None:
        while not self._over.is_set():
            image = _next_image(self._capture)
            if image is None:
                time.sleep(0.05)
                continue
            with self._lock:
                self._newest = (time.monotonic(), image)
            self._arrived.set()

    def trouble(self) -> str | None:
        return self._trouble


def is_live(source: Any) -> bool:
    """Whether a source delivers images now, none of which comes twice."""
    return getattr(source, "is_live", False)


class FrameSet(NamedTuple):
    """What all sources have at one time."""

    time_s: float
    """From the first one."""
    images: tuple[np.ndarray | None, ...]
    """None where a source has nothing new."""


def continued(
    moments: Iterator[FrameSet], sources: Sequence[VideoSource], frames: int, time_s: float
) -> Iterator[FrameSet]:
    """The moments that an interrupted run has not had.

    Args:
        moments: From the first one.
        sources: Of the moments. Recordings are read again from their beginning; a live camera goes on, on the clock of
            the run.
        frames: Moments that the run has had.
        time_s: Of the last of them, seconds.
    """
    if not any(map(is_live, sources)):
        return itertools.islice(moments, frames, None)
    later_s = time_s + 1 / max(source.fps for source in sources) if frames else 0.0
    return (moment._replace(time_s=later_s + moment.time_s) for moment in moments)


def together(sources: list[VideoSource]) -> Iterator[FrameSet]:
    """The images of several sources on the clock of the fastest; a slower one has nothing new in between.

    Ends when the last recording ends; one that ends earlier has nothing new from then on.
    """
    half = 0.5 / max(check_rate(source.fps, f"{source.name}: fps") for source in sources)
    streams = on_one_clock(sources)
    waiting = [next(stream, None) for stream in streams]
    began = min((item[0] for item in waiting if item is not None), default=0.0)
    while any(item is not None for item in waiting):
        now = min(item[0] for item in waiting if item is not None)
        images: list[np.ndarray | None] = []
        for i, item in enumerate(waiting):
            due = item is not None and item[0] <= now + half
            images.append(item[1] if due and item is not None else None)
            if due:
                waiting[i] = next(streams[i], None)
        yield FrameSet(now - began, tuple(images))


def on_one_clock(sources: Sequence[VideoSource]) -> list[Iterator[tuple[float, np.ndarray | None]]]:
    """The images of all sources with their seconds, on one clock where folders are numbered alike."""
    streams = [source.images() for source in sources]
    folders = [source for source in sources if isinstance(source, ImageFolder)]
    numbers = [found for folder in folders if (found := folder.numbers()) is not None and len(found) > 1]
    if len(numbers) < len(sources):
        return streams
    steps = [_usual_step(found) for found in numbers]
    overlap = min(found[-1] for found in numbers) >= max(found[0] for found in numbers)
    if not overlap or max(steps) > (1 + _SAME_STEP) * min(steps):
        return streams
    first, pace = min(found[0] for found in numbers), min(steps) * max(source.fps for source in sources)
    return [_timed(stream, (found - first) / pace) for stream, found in zip(streams, numbers, strict=True)]


def _timed(
    stream: Iterator[tuple[float, np.ndarray | None]], times_s: np.ndarray
) -> Iterator[tuple[float, np.ndarray | None]]:
    for (_, image), time_s in zip(stream, times_s, strict=True):
        yield float(time_s), image
