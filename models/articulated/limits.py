"""Loose inequalities on the angles and lengths of an articulated hand, as intervals of linear combinations.

Source: Shimada et al., equations [14]-[18] and table 1. Every inequality is `lower <= normal . x <= upper`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxfilters.models.articulated.layout import LINKS, Layout


class Limit(NamedTuple):
    """One interval of a linear combination of named components of the state: radians and lengths."""

    terms: tuple[tuple[str, float], ...]
    """Names of `Layout.names` and their factors."""
    lower: float
    """-inf where there is no bound."""
    upper: float
    """inf where there is no bound."""

    @property
    def name(self) -> str:
        """The combination as text: `theta_12 - theta_13`."""
        text = " ".join(f"{'-' if factor < 0 else '+'} {_factor(factor)}{name}" for name, factor in self.terms)
        return text.removeprefix("+ ")


class LimitRows(NamedTuple):
    """Inequalities `lower <= normals x <= upper`."""

    normals: Float[Array, "rows n"]
    lower: Float[Array, " rows"]
    upper: Float[Array, " rows"]
    names: tuple[str, ...]
    static: Bool[Array, " rows"]
    """True for those on constant components only: lengths and palm."""


def within(name: str, lower: float, upper: float) -> Limit:
    """`lower <= name <= upper` [14], [16]."""
    return Limit(((name, 1.0),), lower, upper)


def difference(first: str, second: str, lower: float, upper: float) -> Limit:
    """`lower <= first - second <= upper` [15], [17]."""
    return Limit(((first, 1.0), (second, -1.0)), lower, upper)


def ratio(first: str, second: str, lower: float, upper: float) -> tuple[Limit, Limit]:
    """`lower <= first / second <= upper` for a positive second: two half-spaces, whatever the unit."""
    return (
        Limit(((first, 1.0), (second, -lower)), 0.0, math.inf),
        Limit(((first, 1.0), (second, -upper)), -math.inf, 0.0),
    )


def proportions(
    layout: Layout, lengths: Float[Array | np.ndarray, "fingers 3"], height: float, tolerance: float
) -> tuple[Limit, ...]:
    """Anthropometric limits: a hand is shaped like a template of any size, up to a relative tolerance.

    Each link is compared with the one before it, and first links with the palm's height, so that no limit speaks of
    the size: with one camera that is unknown.

    Args:
        layout: Of the state.
        lengths: The template's links, positive, in any unit.
        height: The template's palm height r_h in the same unit.
        tolerance: By how much a ratio may differ from the template's, as a share of it; 0.3 is 30 %.

    Raises:
        ValueError: if the template has not the layout's fingers or is not positive, or the tolerance not in (0, 1).
    """
    template = np.asarray(lengths, dtype=float)
    if template.shape != (layout.num_fingers, LINKS) or not np.all(template > 0) or not height > 0:
        raise ValueError(f"lengths must be ({layout.num_fingers}, {LINKS}) and positive, as height; got {lengths}.")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance must be in (0, 1); got {tolerance}.")
    limits: list[Limit] = []
    for finger, row in enumerate(template, start=1):
        names = ["r_h", *(f"r_{finger}{link}" for link in range(1, LINKS + 1))]
        before = [height, *row]
        for i in range(LINKS):
            middle = float(row[i] / before[i])
            limits += ratio(names[i + 1], names[i], (1 - tolerance) * middle, (1 + tolerance) * middle)
    return tuple(limits)


def table_1() -> tuple[Limit, ...]:
    """The 24 limits of the paper on two fingers: 11 on angles, 13 on lengths in pixels at scale 1."""
    right = math.pi / 2
    by_ten, by_twenty, by_35 = (math.radians(degrees) for degrees in (10, 20, 35))
    fingers, joints = (1, 2), (1, 2, 3)
    ranges = {1: (55.0, 70.0), 2: (30.0, 50.0), 3: (25.0, 50.0)}
    return (
        *(difference(f"theta_{i}2", f"theta_{i}3", -by_ten, by_ten) for i in fingers),
        within("theta_10", -by_twenty, 0.0),
        within("theta_20", 0.0, by_twenty),
        *(within(f"theta_{i}{j}", 0.0, right) for i in fingers for j in joints),
        difference("theta_11", "theta_21", -by_35, by_35),
        *(difference(f"r_{i}1", f"r_{i}2", 0.0, 30.0) for i in fingers),
        *(difference(f"r_{i}2", f"r_{i}3", -10.0, 10.0) for i in fingers),
        *(within(f"r_{i}{j}", *ranges[j]) for i in fingers for j in joints),
        *(difference(f"r_1{j}", f"r_2{j}", -5.0, 5.0) for j in joints),
    )


def limit_rows(layout: Layout, limits: Sequence[Limit]) -> LimitRows:
    """The limits as arrays over the state of `layout`.

    Raises:
        ValueError: naming the limit, if it has no terms or an unknown one, a factor that is not finite, all factors
            zero, or bounds that are NaN, crossed or both absent.
    """
    index = {name: i for i, name in enumerate(layout.names)}
    normals = np.zeros((len(limits), layout.size))
    for row, limit in zip(normals, limits, strict=True):
        for name, factor in limit.terms:
            if name not in index:
                raise ValueError(f"{limit.name!r} speaks of {name!r}; a state has {', '.join(layout.names)}.")
            row[index[name]] += factor
        if not np.all(np.isfinite(row)) or not np.any(row):
            raise ValueError(f"the factors of {limit.name!r} must be finite and not all zero; got {limit.terms}.")
        if not limit.lower <= limit.upper or (math.isinf(limit.lower) and math.isinf(limit.upper)):
            raise ValueError(f"{limit.name!r} must have lower <= upper; got {limit.lower} and {limit.upper}.")
    return LimitRows(
        normals=jnp.asarray(normals, dtype=float),
        lower=jnp.array([limit.lower for limit in limits], dtype=float),
        upper=jnp.array([limit.upper for limit in limits], dtype=float),
        names=tuple(limit.name for limit in limits),
        static=jnp.asarray(~np.any(normals[:, : layout.static.start], axis=1)),
    )


def _factor(factor):
    return "" if abs(factor) == 1 else f"{abs(factor):.3g} "
