# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Range-only SLAM with a learnt bias
#
# A robot drives loops among six radio beacons. It measures its own motion and the distance to each beacon; every radio
# adds a constant delay of its own, and the beacons were placed by eye, to about a metre. The state holds the pose
# $(p, \theta)$ and all beacons $m_k$; the delays $b_k$ are a `jf.GaussMarkov` process with an infinite time constant,
# which `jf.correlated_noise` adds to the filter:
#
# $$p_t = p_{t-1} + d_t\,(\cos\theta_{t-1}, \sin\theta_{t-1}), \quad \theta_t = \theta_{t-1} + \omega_t, \qquad
# y^k_t = \lVert p_t - m_k \rVert + b_k + v^k_t .$$
#
# **Result:** over 200 drives the mean error of the last place is **0.31** m with the delays in the filter, **0.83** m
# without, and **2.1** m by the robot's own motion alone. The 95 percent ellipse holds the place in **0.94** of the
# drives with the delays and in **0.13** without.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxfilters as jf

FRAMES, SPEED, TURN = 300, 0.25, 2 * np.pi / 100  # metres and radians a frame: three loops
ODOMETRY, RANGE, DELAY, PLACED = np.array([0.03, 0.01]), 0.1, 0.5, 1.0  # standard deviations
BEACONS = jnp.array([[-3.0, -2.0], [4.0, -3.0], [7.0, 3.0], [3.0, 9.0], [-3.0, 10.0], [-7.0, 4.0]])
K = len(BEACONS)
ranges = lambda x: jnp.linalg.norm(x[3:].reshape(K, 2) - x[:2], axis=1)


def drive(x, moved):
    """The state after a measured motion, metres and radians; the beacons stay."""
    heading = jnp.array([jnp.cos(x[2]), jnp.sin(x[2])])
    return x.at[:2].add(moved[0] * heading).at[2].add(moved[1])


def motion_noise(x, moved):
    heading = jnp.array([jnp.cos(x[2]), jnp.sin(x[2])])
    G = jnp.zeros((len(x), 2)).at[:2, 0].set(ODOMETRY[0] * heading).at[2, 1].set(ODOMETRY[1])
    return G @ G.T


def simulate(key):
    keys = jax.random.split(key, 4)
    sent = jnp.array([SPEED, TURN]) + ODOMETRY * jax.random.normal(keys[0], (FRAMES, 2))
    start = jnp.concatenate([jnp.zeros(3), BEACONS.ravel()])
    step = lambda x, moved: (drive(x, moved),) * 2
    truth = jax.lax.scan(step, start, sent)[1]
    delay = DELAY * jax.random.normal(keys[1], (K,))
    y = jax.vmap(ranges)(truth) + delay + RANGE * jax.random.normal(keys[2], (FRAMES, K))
    placed = start.at[3:].add(PLACED * jax.random.normal(keys[3], (2 * K,)))
    return truth, y, placed


def follow(key):
    truth, y, placed = simulate(key)
    moved = jnp.tile(jnp.array([SPEED, TURN]), (FRAMES, 1))
    prior = jf.Gaussian(placed, jnp.diag(jnp.array([1e-3] * 3 + [PLACED] * 2 * K) ** 2))
    without = jf.extended_kalman(prior, drive, motion_noise, ranges, RANGE**2 * jnp.eye(K))
    delays = jf.correlated_noise(without, jf.GaussMarkov(jnp.inf, DELAY**2 * jnp.ones(K)))
    found = [jf.run(filter, key, y, moved)[1][0] for filter in (delays, without)]
    alone = jax.lax.scan(lambda x, u: (drive(x, u),) * 2, placed, moved)[1]
    return truth, placed, *((belief.mean, belief.covariance) for belief in found), alone


truth, placed, delays, without, alone = jax.jit(jax.vmap(follow))(jax.random.split(jax.random.key(0), 200))
difference = [np.asarray(mean[:, -1, :2] - truth[:, -1, :2]) for mean in (delays[0], without[0], alone)]
inside = [
    np.mean(np.einsum("bi,bij,bj->b", d, np.linalg.inv(P[:, -1, :2, :2]), d) < 5.99)
    for d, P in zip(difference, (delays[1], without[1]), strict=False)
]
result = *[np.linalg.norm(d, axis=1).mean() for d in difference], *inside
print(result)

# %%
figure, ax = plt.subplots(figsize=(7, 6), layout="constrained")
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "range_only_slam.webp"), dpi=110)
