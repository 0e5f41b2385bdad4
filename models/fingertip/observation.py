"""What one frame shows of a hand over a desk: tips, where their fingers begin, palm and forearm."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float

MAX_TIPS = 5
"""Of one hand."""
COVERAGE_SHAPE = (60, 80)
"""Cells, rows and columns, that say where in the image a hand is: no wider than a finger of a hand that fills it."""
WHOLE_IMAGE = 1e6
"""Pixels: a cell as large as any image, where there is no silhouette."""


class HandObservation(NamedTuple):
    """A hand in one frame, in pixels (x right, y down, centres at integers); what is not there is masked, and 0."""

    tips: Float[Array, "tips 2"]
    """Ends of the extended fingers, best first."""
    is_tip: Bool[Array, " tips"]
    scores: Float[Array, " tips"]
    """Correlation of each tip with the end of a finger of its thickness and direction, at most 1."""
    bases: Float[Array, "tips 2"]
    """Where the finger of each tip leaves the palm, or parts from the finger beside it."""
    has_base: Bool[Array, " tips"]
    palm: Float[Array, "2"]
    palm_radius: Float[Array, ""]
    axis: Float[Array, "2"]
    """Unit vector along the forearm, towards the hand."""
    has_axis: Bool[Array, ""]
    """Whether the forearm reaches the border of the image, so that its axis can be trusted."""
    is_hand: Bool[Array, ""]
    coverage: Float[Array, "rows cols"]
    """Share of each cell of a grid over the image that the hand covers; ones where there is no silhouette."""
    cell: Float[Array, "2"]
    """Width and height of a cell, pixels; `WHOLE_IMAGE` where there is no silhouette."""
