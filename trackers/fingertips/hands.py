"""Several hands at once: one instance of the tracker each, and which component of an image is which hand."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from jaxfilters._xla.compiled_quickly import compiled_fully
from jaxfilters.math import assignment
from jaxfilters.models.fingertip.observation import HandObservation
from jaxfilters.models.fingertip.thumb import ThumbAngles
from jaxfilters.trackers.fingertips import tracker
from jaxfilters.trackers.fingertips.state import NEVER, FingertipConfig, HandReport, HandState, Method, repeated
from jaxfilters.trackers.fingertips.tracker import MODERN

_FAR, _IMPOSSIBLE = 1e3, 1e4
"""Squared gates: a hand that was observed takes the nearest component, one that was not what is left."""


@partial(jax.jit, static_argnames=("config", "num_hands", "method"))  # one program in place of thirty
def start_hands(config: FingertipConfig, angles: ThumbAngles, num_hands: int, *, method: Method = MODERN) -> HandState:
    """Hands of which nothing was observed yet, hands first."""
    return repeated(tracker.start(config, angles, method=method), num_hands)


def component_of(
    config: FingertipConfig, state: HandState, observed: HandObservation, sides: Float[Array, " hands"]
) -> Int32[Array, " hands"]:
    """Which component of the image each hand is: by the least sum of squared distances from where the palms go.

    Two hands that touch are one component; it is the hand that is nearer, and the other one coasts. Hands that cross
    are distinguished by their paths. Of two that appear together, the one with the thumb counter-clockwise is to the
    right: the right hand of a person who is viewed from above, with crossed arms excluded.

    Args:
        config: Constants.
        state: Of all hands, hands first.
        observed: All components, as many as hands.
        sides: Of the thumb of each hand, as in `tracker.step`.
    """
    expected = state.palm + state.palm_velocity
    distance = jnp.sum(jnp.square((expected[:, None] - observed.palm) / config.gate), axis=-1)
    is_known = state.unseen < NEVER
    # Alone, a hand is the first.
    first = jnp.arange(len(sides)) * (jnp.sum(observed.is_hand) == 1) * _FAR
    usual = _FAR - sides[:, None] * observed.palm[:, 0] / config.gate + first[:, None]
    cost = jnp.where(is_known[:, None], distance, usual)
    # A component without a hand is nobody's, and goes to whoever has none.
    cost = jnp.where(observed.is_hand, cost, _IMPOSSIBLE)
    return assignment.match(cost).column


@partial(compiled_fully, static_argnames=("config", "method"))
def run_hands(
    config: FingertipConfig,
    angles: ThumbAngles,
    state: HandState,
    observed: HandObservation,
    sides: Float[Array, " hands"],
    *,
    method: Method = MODERN,
) -> tuple[HandState, HandReport]:
    """The states after all frames, hands first, and the reports, (frames, hands, ...).

    Args:
        config: Constants.
        angles: Of the person; the same for both hands.
        state: Of all hands.
        observed: (frames, hands, ...), the components in any order.
        sides: 1 or -1 for each hand, as in `tracker.step`.
        method: The strategies.
    """

    def one(state: HandState, observed: HandObservation) -> tuple[HandState, HandReport]:
        if len(sides) > 1:
            component = component_of(config, state, observed, sides)
            observed = jax.tree.map(lambda leaf: leaf[component], observed)
        step = partial(tracker.step, config, angles, method=method)
        return jax.vmap(step)(state, observed, sides)

    return jax.lax.scan(one, state, observed)
