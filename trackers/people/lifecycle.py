"""Who is there: confirmation, loss, memory of those who left, and exchanged identities put right."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.models.person.scene import nearest_on_border, walkable
from jaxfilters.trackers.people.appearance import BINS, dissimilarity
from jaxfilters.trackers.people.births import Birth, stride
from jaxfilters.trackers.people.exchange import is_meeting
from jaxfilters.trackers.people.fit import Fit
from jaxfilters.trackers.people.silhouette_bias import edge_covariance
from jaxfilters.trackers.people.state import (
    DORMANT,
    FREE,
    HEIGHT,
    NUM_BIASES,
    STATE,
    TENTATIVE,
    TRACKED,
    WIDTH,
    People,
    PeopleScene,
    chosen,
)

MOST_LOG_ODDS = 8.0
HIDDEN_SHARE = 0.2
"""Below this share of the silhouette there is nothing to see of a person."""
HIDDEN_COST = 0.5
"""Log odds per second lost by a person of whom nothing is visible: people can be hidden, but not for ever."""
LEAST_SURPLUS = 0.5
"""Mean log likelihood ratio a pixel that two people explain beyond what one of them explains alone."""
SUPERFLUOUS_COST = 2.0
"""Log odds per second lost by a person who explains less than that."""
AWAY_SD = 2.0
"""Standard deviations beyond the border of the floor from which on a person has left it."""
LOST_SD_M = 1.2
"""A place known no better than this is no place."""
LOST_NEWCOMER_SDS = 2.0
"""Where cameras tell distances worse than that, the same in standard deviations of a birth."""
LIKENESS = 0.3
"""Dissimilarity up to which a person who comes is a person who left."""
WALKING_M_PER_S = 2.0
LEARNING_RATE = 0.1
"""Share of a new appearance in the remembered one."""
NEWCOMER_SD_M = 0.3
"""Of the place of a birth, from the distance between cells."""
_LEAST_INFORMATION = 0.01
"""Inverse square metres: a place that no silhouette fixes is still somewhere on the floor."""


def existence(scene: PeopleScene, people: People, fit: Fit, dt: Float[Array, ""], looked: Bool[Array, ""]) -> People:
    """Log odds and modes after a frame that `looked` at the scene."""
    config = scene.config
    active = (people.mode == TENTATIVE) | (people.mode == TRACKED)
    hidden = fit.share_seen < HIDDEN_SHARE
    change = jnp.where(hidden, -HIDDEN_COST * dt, jnp.clip(fit.score, -2.0, 1.0))
    # A person whom one other person explains as well is hidden behind that person, or nobody.
    superfluous = fit.surplus < LEAST_SURPLUS
    cost = jnp.where(people.mode == TRACKED, SUPERFLUOUS_COST * dt, LEAST_SURPLUS - fit.surplus)
    change = jnp.where(superfluous, jnp.minimum(change, -cost), change) * looked
    log_odds = jnp.where(active, jnp.minimum(people.log_odds + change, MOST_LOG_ODDS), people.log_odds)
    unseen = jnp.where(active & ~hidden & looked, 0.0, people.unseen_s + dt)
    sd = _largest_sd(people.belief.covariance[:, :2, :2])
    newcomers = jax.vmap(newcomer_covariance, in_axes=(None, 0))(scene, people.belief.mean[:, :2])
    lost = sd > jnp.maximum(LOST_SD_M, LOST_NEWCOMER_SDS * _largest_sd(newcomers))
    away = _is_away(scene, people.belief)
    gone = active & ((log_odds < config.dropped) | (unseen > config.hidden_s) | lost | away)
    gone |= (people.mode == TENTATIVE) & (unseen > 0.5)
    mode = jnp.where(gone, jnp.where(people.mode == TRACKED, DORMANT, FREE), people.mode)
    mode = jnp.where((mode == DORMANT) & (unseen > config.memory_s + config.hidden_s), FREE, mode)
    mode = jnp.where((mode == TENTATIVE) & (log_odds > config.confirmed), TRACKED, mode)
    return people._replace(log_odds=log_odds, unseen_s=unseen, mode=mode)


def _largest_sd(covariance: Float[Array, "slots 2 2"]) -> Float[Array, " slots"]:
    """Of X and Y."""
    return jnp.sqrt(jnp.max(jnp.diagonal(covariance, axis1=1, axis2=2), axis=-1))


def _is_away(scene: PeopleScene, belief: Gaussian) -> Bool[Array, " slots"]:
    """Who is beyond the border of the floor by more than the place is uncertain in that direction."""
    xy = belief.mean[:, :2]
    beyond = xy - nearest_on_border(scene.floor, xy)
    distance = jnp.linalg.norm(beyond, axis=-1)
    normal = beyond / jnp.maximum(distance, 1e-6)[:, None]
    sd = jnp.sqrt(jnp.einsum("ki,kij,kj->k", normal, belief.covariance[:, :2, :2], normal))
    return ~walkable(scene.floor, xy) & (distance > AWAY_SD * sd)


def seniority(people: People) -> Float[Array, " slots"]:
    """Higher for who is the less likely to be a mistake: the tracked by identity, then the tentative by log odds."""
    return jnp.where(
        people.mode == TRACKED, 1e4 - people.identity, people.log_odds - 1e-3 * jnp.arange(len(people.mode))
    )


def remembered(people: People, histograms: Float[Array, "slots 48"], good: Bool[Array, " slots"]) -> People:
    """Appearances with what this frame shows of those who are certainly who they are said to be."""
    good &= ~is_meeting(people.meetings)
    blank = jnp.all(people.appearance == people.appearance[:, :1], axis=-1)
    rate = jnp.where(blank, 1.0, LEARNING_RATE)[:, None]
    learned = people.appearance + rate * (histograms - people.appearance)
    return people._replace(appearance=jnp.where(good[:, None], learned, people.appearance))


def named(people: People) -> People:
    """Identities for the confirmed: that of a person who left, where place and clothes agree, or a new one."""

    def one(k, people):
        reach = 1.0 + WALKING_M_PER_S * people.unseen_s
        apart = jnp.linalg.norm(people.belief.mean[:, :2] - people.belief.mean[k, :2], axis=-1)
        unlike = dissimilarity(people.appearance, people.appearance[k])
        cost = jnp.where((people.mode == DORMANT) & (apart < reach) & (unlike < LIKENESS), unlike, jnp.inf)
        old = jnp.argmin(cost)
        back = jnp.isfinite(cost[old])
        identity = jnp.where(back, people.identity[old], people.next_identity)
        return people._replace(
            identity=people.identity.at[k].set(identity),
            mode=people.mode.at[old].set(jnp.where(back, FREE, people.mode[old])),
            next_identity=people.next_identity + ~back,
        )

    fresh = (people.mode == TRACKED) & (people.identity < 0)
    order = jnp.argsort(~fresh)
    people = jax.lax.fori_loop(0, jnp.sum(fresh), lambda turn, p: one(order[turn], p), people)
    return people._replace(identity=jnp.where(people.mode == FREE, -1, people.identity))


def confirm(scene: PeopleScene, people: People, found: Birth) -> People:
    """With the birth in a free slot; without a free one, nobody is added."""
    config, free = scene.config, people.mode == FREE
    slot = (jnp.arange(len(free)) == jnp.argmax(free)) & free & found.found
    n = len(free)
    mean = jnp.zeros(STATE).at[:2].set(found.xy).at[HEIGHT].set(config.height_m).at[WIDTH].set(config.width_m)
    speed, size = [config.speed_sd] * 2, [config.height_sd_m, config.width_sd_m]
    sd = jnp.array([0.0, 0.0, *speed, *size, *[1.0] * NUM_BIASES])
    covariance = jnp.diag(sd**2).at[:2, :2].set(newcomer_covariance(scene, found.xy))
    fresh = Gaussian(jnp.broadcast_to(mean, (n, STATE)), jnp.broadcast_to(covariance, (n, STATE, STATE)))
    return people._replace(
        belief=chosen(slot, fresh, people.belief),
        mode=jnp.where(slot, TENTATIVE, people.mode),
        identity=jnp.where(slot, -1, people.identity),
        log_odds=jnp.where(slot, 0.0, people.log_odds),
        unseen_s=jnp.where(slot, 0.0, people.unseen_s),
        appearance=jnp.where(slot[:, None], 1 / BINS, people.appearance),
        shift=jnp.where(slot[:, None, None], 0.0, people.shift),
    )


def newcomer_covariance(scene: PeopleScene, xy: Float[Array, " 2"]) -> Float[Array, "2 2"]:
    """Of the place of a birth, square metres: that of the grid of cells, and of edges in the reduced image.

    An edge that is a pixel of the reduced image too low moves a person who is looked at under a small angle by metres.
    A belief that is surer than that keeps the error for seconds, as a bias of the silhouette.
    """
    config = scene.config
    edges_px = [float(stride(camera.shape)) for camera in scene.cameras]
    known = jnp.zeros((3, 3)).at[2, 2].set(1 / config.height_sd_m**2) + _LEAST_INFORMATION * jnp.eye(3)
    covariance = edge_covariance(scene, xy, jnp.asarray(config.height_m), edges_px, known)
    return covariance[:2, :2] + NEWCOMER_SD_M**2 * jnp.eye(2)
