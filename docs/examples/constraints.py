# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A pedestrian in a corridor
#
# A camera looks obliquely into a corridor 2 m wide. It measures a pedestrian to 0.2 m across its line of sight and to
# 3 m along it. Whoever walks there is between the walls:
#
# $$x_t = F x_{t-1} + w_t, \qquad y_t = p_t + v_t, \quad v_t \sim N(0, R), \qquad -1 \le p^2_t \le 1.$$
#
# The belief of a Kalman filter is a long ellipse across the corridor. `jf.constraints.cut` truncates it to the part
# between the walls, which says where along the corridor, too; the filter goes on from the belief as it was. Beside it
# stand the mean clipped to the walls, and the point of each measured line of sight in the middle of the corridor.
# `jf.constrained` goes on from the truncated belief. This counts walls that a slow walker is near in every frame anew:
# its standard deviations are too small here, and its errors larger.
#
# **Result:** over 100 walks the root mean square error is **0.85** m truncated, **1.31** m by the Kalman filter,
# **1.19** m clipped, **1.04** m by the middle of the corridor, and **0.93** m by `jf.constrained`. Of the true
# coordinates **0.962** are within 2 sigma truncated, and **0.867** by `jf.constrained`.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxfilters as jf

WALKS, FRAMES, DT = 100, 120, 0.2  # seconds
sight = np.deg2rad(40)
axes = np.array([[np.cos(sight), -np.sin(sight)], [np.sin(sight), np.cos(sight)]])
R = axes @ np.diag([3.0**2, 0.2**2]) @ axes.T
F, Q = jf.motion.constant_velocity(1.0, dims=2).discretize(DT)
rng, root, truth = np.random.default_rng(0), np.linalg.cholesky(Q), []
x = rng.uniform(-1, 1, (WALKS, 4)) * [0, 1, 2, 0.5]
for _ in range(FRAMES):
    x = (x @ np.asarray(F).T + rng.normal(size=x.shape) @ root.T) * [1, 1, 0.99, 0.95]
    wall = np.abs(x[:, 1]) > 1
    x[wall, 1], x[wall, 3] = np.clip(2 * np.sign(x[wall, 1]) - x[wall, 1], -1, 1), -0.3 * x[wall, 3]
    truth.append(x[:, :2])
truth = np.stack(truth, 1)
y = jnp.asarray(truth + rng.normal(size=truth.shape) * [3.0, 0.2] @ axes.T, jnp.float32)

kalman = jf.kalman(jf.Gaussian(jnp.zeros(4), jnp.diag(jnp.array([9, 0.4, 1.4, 0.1]))), F, Q, jnp.eye(2, 4), R)
walls = jf.constraints.linear_constraints([[0.0, 1.0, 0.0, 0.0]], lower=-1.0, upper=1.0)
cut = jf.constraints.cut.sequential_intervals
run = lambda filter: jax.vmap(lambda y: jf.run(filter, jax.random.key(0), y)[1][0])(y)
plain, constrained = run(kalman), run(jf.constrained(kalman, jf.TruncateEachStep(walls, cut))).belief
truncated = jax.vmap(jax.vmap(lambda belief: cut(belief, walls)[0]))(plain)

places = lambda belief: np.asarray(belief.mean)[..., :2]
std = lambda belief: np.sqrt(np.diagonal(np.asarray(belief.covariance), axis1=2, axis2=3))[..., :2]
middle = np.stack([y[..., 0] - y[..., 1] / np.tan(sight), 0 * y[..., 1]], -1)
clipped = np.clip(places(plain), [-np.inf, -1], [np.inf, 1])
rms = lambda found: np.sqrt(np.mean(np.sum((found - truth) ** 2, -1)))
within = lambda belief: np.mean(np.abs(places(belief) - truth) <= 2 * std(belief))
errors = [rms(found) for found in (places(truncated), places(plain), clipped, middle, places(constrained))]
result = *errors, within(truncated), within(constrained)

# %%
plt.rcParams.update({"axes.grid": True, "grid.alpha": 0.3, "axes.spines.top": False, "axes.spines.right": False})
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), width_ratios=[1.5, 1], layout="constrained")
one, covariance = slice(60, 100), np.asarray(truncated.covariance)[2, :, :2, :2]
left.axhspan(-1, 1, color="0.92")
jf.plot.track(places(truncated)[2, one], covariance[one], truth=truth[2, one], observations=y[2, one], every=8, ax=left)
left.plot(*places(plain)[2, one].T, color="tab:orange", label="Kalman filter")
left.set(xlabel="along (m)", ylabel="across (m)", ylim=(-4, 4), aspect="auto", title="Eight seconds, 2 sigma")
left.legend(fontsize=8, ncols=2)
right.barh(["truncated", "Kalman filter", "clipped", "middle", "constrained"], errors, color=["tab:blue", *["0.7"] * 4])
right.set(xlabel="root mean square error (m)", title="100 walks")
right.invert_yaxis()
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "constraints.webp"), dpi=110)
