"""What the skin of a modelled face looks like: a grey map around the head that moves with the skin.

The map is a cylinder about the y axis of the model's mean face: u = 100 mm times the angle, v = y. Features are painted
at the landmarks of the mean face, so that they are at those of everybody. Below the skin the map holds more fields: the
ball of an eye, the dark of the mouth, hair, the rims of glasses and what their lenses reflect.
"""

from dataclasses import dataclass

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfilters._struct import pytree_dataclass
from jaxfilters.models.synthetic.ict_face import IctModel
from jaxfilters.typing import AnyKey

RADIUS_MM = 100.0
PIXEL_MM = 0.6
LOW_MM, HIGH_MM = (-210.0, -150.0), (210.0, 290.0)
"""Corners (u, v) of the map."""
EYE_FIELD, MOUTH_FIELD, HAIR_FIELD = (-120.0, 225.0), (0.0, 225.0), (120.0, 225.0)
"""Middles (u, v) of the other fields."""
FIELD_MM = 50.0
"""Half their side."""
RIM_FIELD, REFLECTION_FIELD = (195.0, 225.0), (-195.0, 225.0)
"""Middles of two narrow ones, for glasses (`jaxfilters.models.synthetic.ict_worn`)."""
FRECKLE_WAVELENGTHS_MM = (2.0, 3.5, 6.0, 10.0)
IRIS_MM, PUPIL_MM = 5.85, 2.6
"""Radii on the ball of the eye: irises of people are 11.7 mm wide (F. Ruefer, A. Schroeder, C. Erb 2005)."""
_LOWEST_HAIR_MM = 45.0


@pytree_dataclass
class Skin:
    """The map of one person."""

    grey: Float[Array, "rows cols"]
    """Grey levels of the surface in full light."""


@dataclass(frozen=True)
class _Looks:
    """How one person differs from others, drawn at random."""

    skin: float
    brow: float
    brow_mm: float
    lip: float
    hair: float
    freckles: float
    iris: float
    beard: float


def map_place(points: Float[np.ndarray, "*points 3"]) -> Float[np.ndarray, "*points 2"]:
    """Where points on the mean face are on the map: (u, v) in millimetres."""
    return np.stack([RADIUS_MM * np.arctan2(points[..., 0], -points[..., 2]), points[..., 1]], axis=-1)


def paint_skin(key: AnyKey, model: IctModel, *, beard: float = 0.0) -> Skin:
    """The skin of a random person: brows, lids, irises, lips, nostrils, hair, and spots of 2 to 10 mm.

    Args:
        key: Of the person's looks, which do not depend on the beard.
        model: Of all people.
        beard: Share of the skin about mouth and jaw that it hides: 0 for none, .4 for stubble, .9 for a full one.
    """
    draw = np.random.default_rng(np.asarray(jax.random.bits(key, (4,))))
    looks = _Looks(
        skin=draw.uniform(165, 205),
        brow=draw.uniform(40, 85),
        brow_mm=draw.uniform(6.0, 9.0),
        lip=draw.uniform(0.62, 0.78),
        hair=draw.uniform(30, 75),
        freckles=draw.uniform(3.0, 4.5),
        iris=draw.uniform(40, 90),
        beard=beard,
    )
    places = map_place(np.asarray(model.neutral, float)[np.asarray(model.landmarks)])
    size = tuple(round((high - low) / PIXEL_MM) for low, high in zip(LOW_MM, HIGH_MM, strict=True))
    shape = (size[1], size[0])
    grey = np.full(shape, looks.skin)
    for features in (_hollows, _lips, _nostrils, _hair, _brows, _lids):
        grey = features(grey, places, looks, draw)
    grey += sum(_spots(draw, shape, length) for length in FRECKLE_WAVELENGTHS_MM) * looks.freckles
    grey = _fields(grey, looks, draw)
    grey = np.where(_field(grey.shape, RIM_FIELD, 10.0), draw.uniform(15, 90), grey)
    if beard:
        hairs = np.random.default_rng(np.asarray(jax.random.bits(jax.random.fold_in(key, 1), (4,))))
        grey = _beard(grey, places, looks, hairs)
    grey = np.where(_field(grey.shape, REFLECTION_FIELD, 10.0), 250.0, grey)
    return Skin(jnp.asarray(np.clip(grey, 5, 250), float))


def _pixels(places):
    return (np.asarray(places) - LOW_MM) / PIXEL_MM - 0.5


def _mask(shape, places, soft_mm):
    """1 within a polygon, 0 outside, with a soft edge."""
    mask = np.zeros(shape, np.float32)
    cv2.fillPoly(mask, [np.round(_pixels(places) * 16).astype(np.int32)], 1.0, cv2.LINE_8, 4)
    return cv2.GaussianBlur(mask, (0, 0), soft_mm / PIXEL_MM)


def _stroke(shape, places, width_mm, soft_mm, *, closed=False):
    """1 on a line, 0 away from it, with a soft edge."""
    mask = np.zeros(shape, np.float32)
    points = np.round(_pixels(places)).astype(np.int32)
    cv2.polylines(mask, [points], closed, 1.0, max(1, round(width_mm / PIXEL_MM)))
    return cv2.GaussianBlur(mask, (0, 0), soft_mm / PIXEL_MM)


def _blob(shape, place, radii_mm):
    v, u = np.indices(shape)
    center, radii = _pixels(place), np.array(radii_mm) / PIXEL_MM
    return np.exp(-0.5 * (((u - center[0]) / radii[0]) ** 2 + ((v - center[1]) / radii[1]) ** 2))


def _spots(draw, shape, wavelength_mm):
    """Noise of unit variance about one wavelength."""
    sigma = wavelength_mm / PIXEL_MM / (2 * np.pi)
    noise = draw.standard_normal(shape).astype(np.float32)
    band = cv2.GaussianBlur(noise, (0, 0), sigma) - cv2.GaussianBlur(noise, (0, 0), 1.6 * sigma)
    return band / band.std()


def _toward(grey, mask, value):
    return grey + mask * (value - grey)


def _hollows(grey, places, _looks, _draw):
    """Shade around the eyes and beside the nose, where light comes less."""
    for eye in (range(36, 42), range(42, 48)):
        center = places[list(eye)].mean(axis=0)
        grey = grey * (1 - 0.30 * _blob(grey.shape, center - [0, 3], (15, 9)))
    for side in (31, 35):
        grey = grey * (1 - 0.18 * _blob(grey.shape, places[side] - [0, 2], (5, 6)))
    return grey * (1 - 0.15 * _blob(grey.shape, places[57] + [0, 6], (13, 4)))


def _lips(grey, places, looks, _draw):
    outer, inner = places[48:60], np.concatenate([places[60:65], places[65:68]])
    grey = grey * (1 - (1 - looks.lip) * _mask(grey.shape, outer, 0.8))
    line = np.concatenate([places[48:49], places[60:65], places[54:55]])
    grey = _toward(grey, 0.75 * _stroke(grey.shape, line, 1.6, 0.5), 45.0)
    return _toward(grey, 0.6 * _mask(grey.shape, inner, 0.4), 45.0)


def _nostrils(grey, places, _looks, _draw):
    for k, side in ((32, -1), (34, 1)):
        hole = places[k] + [side * 1.5, -2.0]
        grey = _toward(grey, 0.9 * np.minimum(1.6 * _blob(grey.shape, hole, (3.0, 2.0)), 1.0), 35.0)
    return grey


def _hair(grey, _places, looks, draw):
    """Above a line across the forehead and beside the temples."""
    v, u = np.indices(grey.shape)
    u, v = u * PIXEL_MM + LOW_MM[0], v * PIXEL_MM + LOW_MM[1]
    temple = np.clip((np.abs(u) - 95) / 25, 0, 1)
    ear = np.clip((np.abs(u) - 130) / 8, 0, 1)
    line = -102 + 0.0022 * u**2 + 95 * temple - 80 * ear
    edge = 1.5 * _spots(draw, grey.shape, 8.0)
    share = np.clip(0.5 - (v - np.minimum(line, _LOWEST_HAIR_MM) + edge) / 5, 0, 1)
    return _toward(grey, np.where(v < 150, share, 0.0), looks.hair + 10 * _strands(draw, grey.shape))


def _strands(draw, shape):
    noise = draw.standard_normal(shape).astype(np.float32)
    band = cv2.GaussianBlur(noise, (0, 0), sigmaX=0.9, sigmaY=7.0)
    return band / band.std()


def _brows(grey, places, looks, draw):
    hairs = _strands(draw, grey.shape)
    for brow, inner in (((17, 18, 19, 20, 21), 21), ((22, 23, 24, 25, 26), 22)):
        path = places[list(brow)]
        mask = _stroke(grey.shape, path, looks.brow_mm * 0.7, 1.1)
        mask = np.maximum(mask, _stroke(grey.shape, path[1:-1], looks.brow_mm, 1.1))
        mask = np.maximum(mask, _blob(grey.shape, places[inner], (2.5, looks.brow_mm / 2.2)))
        grey = _toward(grey, np.minimum(mask, 1) * 0.92, looks.brow + 8 * hairs)
    return grey


def _lids(grey, places, _looks, _draw):
    for start in (36, 42):
        upper, lower = places[start : start + 4], places[[start + 3, start + 4, start + 5, start]]
        grey = _toward(grey, 0.9 * _stroke(grey.shape, upper, 2.2, 0.6), 30.0)
        grey = _toward(grey, 0.5 * _stroke(grey.shape, lower, 1.4, 0.6), 60.0)
        grey = _toward(grey, 0.35 * _stroke(grey.shape, upper - [0, 5.0], 1.4, 0.6), 60.0)
    return grey


def _beard(grey, places, looks, draw):
    """Hair along the jaw, on the chin, and between nose and mouth; lips stay free."""
    jaw = places[3:14] + np.outer(np.r_[0, np.full(9, 15), 0], [0, 1])
    cheeks = np.array([places[54] + [16, -4], places[35] + [5, 5], places[31] + [-5, 5], places[48] + [-16, -4]])
    mask = _mask(grey.shape, np.concatenate([jaw, cheeks]), 3.0) * (1 - _mask(grey.shape, places[48:60], 1.0))
    return _toward(grey, looks.beard * mask, looks.hair + 15 * _strands(draw, grey.shape))


def _millimetres(shape):
    """Places (u, v) of the pixels."""
    v, u = np.indices(shape)
    return (u + 0.5) * PIXEL_MM + LOW_MM[0], (v + 0.5) * PIXEL_MM + LOW_MM[1]


def _field(shape, middle, half_mm):
    u, v = _millimetres(shape)
    return (np.abs(u - middle[0]) <= half_mm) & (np.abs(v - middle[1]) <= half_mm)


def _fields(grey, looks, draw):
    """The map with eye, mouth and hair in their places."""
    u, v = _millimetres(grey.shape)
    field = lambda middle: _field(grey.shape, middle, FIELD_MM + 5)
    radius = np.hypot(u - EYE_FIELD[0], v - EYE_FIELD[1])
    ring, pupil = (np.clip(0.5 - (radius - reach) / 0.8, 0, 1) for reach in (IRIS_MM, PUPIL_MM))
    eye = _toward(_toward(np.full(grey.shape, 205.0), ring, looks.iris), pupil, 12.0)
    glint = np.exp(-0.5 * ((u - EYE_FIELD[0] - 1.6) ** 2 + (v - EYE_FIELD[1] + 2.0) ** 2) / 0.7**2)
    grey = np.where(field(EYE_FIELD), eye + 190 * glint, grey)
    grey = np.where(field(MOUTH_FIELD), 22.0, grey)
    return np.where(field(HAIR_FIELD), looks.hair + 10 * _strands(draw, grey.shape), grey)
