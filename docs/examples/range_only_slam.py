# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Range-only SLAM with an estimated bias
#
# A robot drives loops among six radio beacons. It measures its own motion and the distance to each beacon; every radio
# adds a constant delay of its own, some two metres, and the beacons were placed to half a metre. The state holds the
# pose $(p, \theta)$ and all beacons $m_k$; the delays $b_k$ are a `jf.GaussMarkov` process with an infinite time
# constant, which `jf.correlated_noise` adds to the filter:
#
# $$p_t = p_{t-1} + d_t\,(\cos\theta_{t-1}, \sin\theta_{t-1}), \quad \theta_t = \theta_{t-1} + \omega_t, \qquad
# y^k_t = \lVert p_t - m_k \rVert + b_k + v^k_t .$$
#
# **Result:** over 200 drives the mean error of the last place is **0.065** m with the delays in the filter, **0.23** m
# without, and **0.65** m by the robot's own motion alone. The 95 percent ellipse holds the place in **0.945** of the
# drives with the delays and in **0.37** without. With beacons placed to a metre and a heading twice as noisy these are
# 0.74 and less: one extended filter is too sure over so wide a prior.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxfilters as jf

FRAMES, TURN = 300, jnp.array([0.25, 2 * np.pi / 100])  # metres and radians a frame: three loops
ODOMETRY, RANGE, DELAY, PLACED = np.array([0.03, 0.005]), 0.1, 2.0, 0.5  # standard deviations
BEACONS = jnp.array([[-3.0, -2.0], [4.0, -3.0], [7.0, 3.0], [3.0, 9.0], [-3.0, 10.0], [-7.0, 4.0]])
K, moved = len(BEACONS), jnp.tile(TURN, (FRAMES, 1))
along = lambda x: jnp.zeros((len(x), 2)).at[:2, 0].set(jnp.array([jnp.cos(x[2]), jnp.sin(x[2])])).at[2, 1].set(1.0)
drive = lambda x, moved: x + along(x) @ moved
motion_noise = lambda x, moved: (along(x) * ODOMETRY**2) @ along(x).T
ranges = lambda x: jnp.linalg.norm(x[3:].reshape(K, 2) - x[:2], axis=1)
dead_reckoning = lambda x, moved: jax.lax.scan(lambda x, u: (drive(x, u),) * 2, x, moved)[1]


def follow(key):
    keys, start = jax.random.split(key, 4), jnp.concatenate([jnp.zeros(3), BEACONS.ravel()])
    truth = dead_reckoning(start, moved + ODOMETRY * jax.random.normal(keys[0], (FRAMES, 2)))
    delay = DELAY * jax.random.normal(keys[1], (K,))
    y = jax.vmap(ranges)(truth) + delay + RANGE * jax.random.normal(keys[2], (FRAMES, K))
    placed = start.at[3:].add(PLACED * jax.random.normal(keys[3], (2 * K,)))
    prior = jf.Gaussian(placed, jnp.diag(jnp.array([1e-3] * 3 + [PLACED] * 2 * K) ** 2))
    without = jf.extended_kalman(prior, drive, motion_noise, ranges, RANGE**2 * jnp.eye(K))
    delays = jf.correlated_noise(without, jf.GaussMarkov(jnp.inf, DELAY**2 * jnp.ones(K)))
    found = [jf.run(filter, key, y, moved)[1][0] for filter in (delays, without)]
    return truth, delay, *((belief.mean, belief.covariance) for belief in found), dead_reckoning(placed, moved)


truth, delay, delays, without, alone = jax.jit(jax.vmap(follow))(jax.random.split(jax.random.key(0), 200))
last = [np.asarray(mean[:, -1, :2] - truth[:, -1, :2]) for mean in (delays[0], without[0], alone)]
inside = lambda d, P: np.mean(np.einsum("bi,bij,bj->b", d, np.linalg.inv(P[:, -1, :2, :2]), d) < 5.99)
shares = [inside(d, P) for d, (_, P) in zip(last, (delays, without), strict=False)]
result = *[np.linalg.norm(d, axis=1).mean() for d in last], *shares

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5), width_ratios=[1.2, 1], layout="constrained")
jf.plot.track(delays[0][0, :, :2], delays[1][0, :, :2, :2], truth=truth[0, :, :2], every=30, ax=left)
for places, style, label in ((without[0], "C3-", "without delays"), (alone, "C1--", "own motion alone")):
    left.plot(*places[0, :, :2].T, style, linewidth=1, label=label)
left.plot(*delays[0][0, -1, 3:15].reshape(K, 2).T, "C2^", label="beacons, estimated")
left.plot(*BEACONS.T, "x", color="0.2", label="beacons")
left.set(xlabel="x (m)", ylabel="y (m)", title="One drive, with 2 sigma", aspect="equal")
left.legend(fontsize=8, loc="center")
mean, std = delays[0][0, :, 15:17], jnp.sqrt(jnp.diagonal(delays[1][0], axis1=1, axis2=2)[:, 15:17])
for k in range(2):
    right.fill_between(np.arange(FRAMES), (mean - 2 * std)[:, k], (mean + 2 * std)[:, k], color=f"C{k}", alpha=0.2)
    right.axhline(delay[0, k], color=f"C{k}", linestyle="--")
right.plot(mean)
right.set(xlabel="frame", ylabel="delay (m)", title="Two of the delays, with 2 sigma; dashed: truth")
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "range_only_slam.webp"), dpi=110)
