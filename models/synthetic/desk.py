"""Desks as a camera above sees them, with or without a hand on them: in thermal infrared, and in colour."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

NUM_RECTANGLES = 8
DESK_GREY, CLUTTER_GREY, HAND_GREY = 70.0, (55.0, 105.0), 195.0
INFRARED_NOISE, COLOUR_NOISE = 8.0, 4.0
"""Standard deviations of the sensors, grey values."""
SKIN = np.array([118.0, 148.0, 205.0])
"""Blue, green, red."""
SHADOW = 0.65
"""Share of the light that the hand's shadow leaves."""
DRIFT = 0.4
"""Pixels per frame, on a desk of 240 rows, by which what is projected moves."""


@runtime_checkable
class Desk(Protocol):
    """What lies below a hand."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""

    def image(
        self, rng: np.random.Generator, coverage: Float[np.ndarray, "rows cols"], blur: float, time: float
    ) -> np.ndarray:
        """What the camera delivers, uint8 (rows, cols) or (rows, cols, 3).

        Args:
            rng: Of the noise.
            coverage: Share of each pixel that a hand covers.
            blur: Standard deviation, pixels.
            time: In frames; what is projected moves on.
        """


@dataclass(frozen=True)
class Rectangles:
    """Things that are projected; pixels of the image."""

    corners: Float[np.ndarray, "n 2"]
    """The one with the least x and y, at time 0."""
    sizes: Float[np.ndarray, "n 2"]
    velocities: Float[np.ndarray, "n 2"]
    colours: Float[np.ndarray, "n 3"]

    def painted(self, ground: Float[np.ndarray, "rows cols channels"], time: float) -> np.ndarray:
        """The ground with the rectangles on it, each where it is at that time."""
        image = ground.copy()
        extent = np.array(image.shape[1::-1])
        for corner, size, velocity, colour in zip(self.corners, self.sizes, self.velocities, self.colours, strict=True):
            x, y = ((corner + time * velocity) % extent).astype(int)
            width, height = size.astype(int)
            image[y : y + height, x : x + width] = colour[: image.shape[2]]
        return image


@dataclass(frozen=True)
class InfraredDesk:
    """Skin is warmer than the desk and whatever is projected on it."""

    shape: tuple[int, int]
    clutter: Rectangles

    def image(
        self, rng: np.random.Generator, coverage: Float[np.ndarray, "rows cols"], blur: float, time: float = 0.0
    ) -> UInt8[np.ndarray, "rows cols"]:
        """As `Desk.image`."""
        ground = self.clutter.painted(np.full((*self.shape, 1), DESK_GREY), time)[..., 0]
        sharp = HAND_GREY - ground
        sharp *= coverage
        sharp += ground
        return _exposed(rng, sharp, blur, INFRARED_NOISE)


@dataclass(frozen=True)
class ColourDesk:
    """A desk in uneven light, things of many colours on it, none of them that of skin; the hand casts a shadow."""

    shape: tuple[int, int]
    clutter: Rectangles
    ground: Float[np.ndarray, "rows cols 3"]
    """The bare desk."""
    light: Float[np.ndarray, "rows cols"]
    """Share of the light that arrives, without the hand."""

    def image(
        self, rng: np.random.Generator, coverage: Float[np.ndarray, "rows cols"], blur: float, time: float = 0.0
    ) -> UInt8[np.ndarray, "rows cols 3"]:
        """As `Desk.image`."""
        rows, cols = self.shape
        away = rows * np.array([0.035, 0.05])
        shift = np.array([[1, 0, away[0]], [0, 1, away[1]]])
        shadow = cv2.GaussianBlur(cv2.warpAffine(coverage, shift, (cols, rows)), (0, 0), rows / 100)
        below = self.clutter.painted(self.ground, time) * (self.light * (1 - (1 - SHADOW) * shadow))[..., None]
        # Rounded fingers and palm are darker at their edges.
        roundness = cv2.GaussianBlur(coverage, (0, 0), rows / 50)
        skin = SKIN * (self.light * (0.75 + 0.25 * roundness))[..., None]
        return _exposed(rng, below + coverage[..., None] * (skin - below), blur, COLOUR_NOISE)


def infrared_desk(rng: np.random.Generator, shape: tuple[int, int] = (240, 320)) -> InfraredDesk:
    """A desk with `NUM_RECTANGLES` things of other temperatures."""
    greys = rng.uniform(*CLUTTER_GREY, (NUM_RECTANGLES, 1))
    return InfraredDesk(shape, _rectangles(rng, shape, np.repeat(greys, 3, axis=1)))


def colour_desk(rng: np.random.Generator, shape: tuple[int, int] = (240, 320)) -> ColourDesk:
    """A grey, white or bluish desk with coloured things, lit from one side."""
    rows, cols = shape
    hues = rng.uniform(45, 160, NUM_RECTANGLES)  # OpenCV's, from green to purple: what is left is near that of skin
    saturation, value = rng.uniform(0, 200, NUM_RECTANGLES), rng.uniform(40, 250, NUM_RECTANGLES)
    hsv = np.stack([hues, saturation, value], axis=-1).astype(np.uint8)[None]
    tone = rng.uniform(90, 225) * np.array([1.0, rng.uniform(0.93, 1.0), rng.uniform(0.85, 0.98)])
    grain = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), rows / 60)
    angle = rng.uniform(0, 2 * math.pi)
    x, y = np.meshgrid(np.linspace(-1, 1, cols), np.linspace(-1, 1, rows))
    return ColourDesk(
        shape,
        _rectangles(rng, shape, cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0].astype(float)),
        ground=tone * (1 + 0.04 * grain / grain.std())[..., None],
        light=0.85 + 0.15 * (math.cos(angle) * x + math.sin(angle) * y),
    )


def _rectangles(rng: np.random.Generator, shape: tuple[int, int], colours: np.ndarray) -> Rectangles:
    extent = np.array(shape[::-1])
    count = len(colours)
    return Rectangles(
        corners=rng.uniform(0, 1, (count, 2)) * extent,
        sizes=rng.uniform(0.06, 0.35, (count, 2)) * extent,
        velocities=rng.normal(0, DRIFT * shape[0] / 240, (count, 2)),
        colours=colours,
    )


def _exposed(rng: np.random.Generator, sharp: np.ndarray, blur: float, noise: float) -> np.ndarray:
    noisy = rng.standard_normal(sharp.shape)
    noisy *= noise
    noisy += cv2.GaussianBlur(sharp, (0, 0), blur) if blur > 0 else sharp
    # In place: new megabytes for every step cost more than the arithmetic.
    return np.clip(np.rint(noisy, out=noisy), 0, 255, out=noisy).astype(np.uint8)
