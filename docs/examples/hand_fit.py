# ---
# jupytext:
#   formats: ipynb,py:percent
# kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A hand fitted through the z-buffer
#
# $\theta$ is a hand's place, rotation, 15 angles and size. `render_capsules` draws its depth: which capsule a pixel
# shows is found first and then held fixed, so that the depth $d_i(\theta)$ has a derivative inside the outline. A depth
# image $y_i$ with a noise of 2 mm is fitted by the maximum of
#
# $$-\sum_i \log\left(1 + \tfrac12 (y_i - d_i(\theta))^2 / (1\,\mathrm{cm})^2\right).$$
#
# Each search begins at a pose of some frames ago, and takes 400 steps of Adam. Beside it stands hill climbing without
# derivatives, with three times as many images: random steps, kept where they are better.
#
# **Result:** for 24 poses the median error of the joints is **17.4** mm at the start, **0.43** mm by gradient and
# **3.7** mm by climbing. Four to six of the 24 gradient searches end more than 2 mm away, because the outline has no
# derivative; rounding decides which.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from jax.lax import fori_loop

from jaxfilters.models.camera import Pinhole
from jaxfilters.models.hand.skeleton import ANGLE_LIMITS, forward_kinematics, hand_geometry
from jaxfilters.models.rendering.depth import render_capsules

N, STEPS, WALL = 24, 400, 0.7  # metres
camera, geometry = Pinhole.from_intrinsics(107.0, (31.5, 31.5), (64, 64)), hand_geometry()
SPREAD = jnp.repeat(jnp.array([0.01, 0.05, 0.08, 0.08]), jnp.array([3, 3, 15, 1]))  # metres, radians, 1
adam = optax.adam(optax.cosine_decay_schedule(1.0, STEPS))
draw = lambda i, *shape: jax.random.normal(jax.random.key(i), shape)
pose = lambda theta: jnp.concatenate([theta[:3], jnp.ones(1), theta[3:6] / 2, theta[6:21]])  # nearly rotation vectors
hand = lambda theta: forward_kinematics(pose(theta), geometry.scaled(jnp.exp(theta[21])))
depth = lambda theta: jnp.minimum(render_capsules(camera, hand(theta).capsules), WALL)
misfit = lambda theta, y: jnp.sum(jnp.log1p(0.5 * ((y - depth(theta)) / 0.01) ** 2))


def fits(start, y):
    def descend(i, carry):
        update, state = adam.update(jax.grad(misfit)(carry[0], y), carry[1])
        return carry[0] + 0.25 * SPREAD * update, state

    def climb(i, theta):
        other = theta + 0.2 * SPREAD * draw(i, 22)
        return jnp.where(misfit(other, y) < misfit(theta, y), other, theta)

    return fori_loop(0, STEPS, descend, (start, adam.init(start)))[0], fori_loop(0, 3 * STEPS, climb, start)


share = 0.2 + 0.4 * jax.random.uniform(jax.random.key(5), (N, 15))
angles = (1 - share) * ANGLE_LIMITS[:, 0] + share * ANGLE_LIMITS[:, 1]
first = jnp.array([0.0, 0.08, 0.5, 0, 0, 0]) + jnp.array([0.02] * 3 + [0.3] * 3) * draw(1, N, 6)
truth = jnp.concatenate([first, angles, 0.08 * draw(3, N, 1)], 1)
start = (truth + SPREAD * draw(4, N, 22)).at[:, 21].set(0.0)
y = jax.lax.map(depth, truth) + 0.002 * draw(6, N, 64, 64)
found = [start, *jax.jit(lambda *each: jax.lax.map(lambda one: fits(*one), each))(start, y)]
joints = [jax.vmap(lambda theta: hand(theta).joints)(each) for each in (truth, *found)]
errors = [1e3 * np.linalg.norm(each - joints[0], axis=-1).mean(1) for each in joints[1:]]
result = np.median(errors, axis=1)

# %%
figure, axes = plt.subplots(2, 4, figsize=(10, 5), layout="constrained")
for row, i in zip(axes, (1, 2), strict=True):
    titles = [f"{n}: {e[i]:.1f} mm" for n, e in zip(("start", "gradient", "climbing"), errors, strict=True)]
    for ax, title, image in zip(row, ["observed", *titles], [y[i], *(depth(f[i]) for f in found)], strict=True):
        ax.imshow(np.where(image < WALL - 0.02, image, np.nan), cmap="viridis_r", vmin=0.42, vmax=0.6)
        ax.set(xticks=[], yticks=[], title=title)
figure.savefig(Path(*sys.argv[1:2] if "__file__" in globals() else (), "hand_fit.webp"), dpi=110)
