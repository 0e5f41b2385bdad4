"""What filters say on the devices that this process sees, as JSON: `python sharded_runs.py READINGS [RANK PORT]`.

A process sees its devices once and for all, so `test_sharding.py` starts this one with as many as it wants. With a rank
and a port it is one of two processes.
"""

import json
import re
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

import jaxfilters
from jaxfilters import weights
from jaxfilters._struct import pytree_dataclass
from jaxfilters.gaussian.belief import Gaussian
from jaxfilters.noise import StandardNormal
from jaxfilters.particle.bootstrap import bootstrap
from jaxfilters.particle.rao_blackwell import MixedDynamics, rao_blackwell_shared
from jaxfilters.particle.sharding import placement, sharded, spread_sequences
from jaxfilters.particle.tempering import AdaptiveTempering

DT, Q_N, Q_L = 0.1, 0.3, 4.0
NUM_RUNS = 800


@pytree_dataclass
class Sensor:
    """y = x + r."""

    std: jax.Array

    def log_likelihood(self, x, y):
        return norm.logpdf(y, x["pose"][0], self.std)


def sample_prior(key):
    return {"pose": jax.random.normal(key, (1,)), "velocity": jax.random.normal(jax.random.fold_in(key, 1))}


def move(noise, x, inputs):
    del inputs
    pose = x["pose"] + DT * x["velocity"] + jnp.sqrt(DT * Q_N) * noise[:1]
    return {"pose": pose, "velocity": x["velocity"] + jnp.sqrt(DT * Q_L) * noise[1]}


def mixed(x, inputs):
    del inputs
    one = jnp.ones((1, 1))
    return MixedDynamics(x, DT * one, DT * Q_N * one, jnp.zeros(1), one, DT * Q_L * one)


def log_likelihood(x, y):
    return norm.logpdf(y, x[0], 0.4)


def plain(num_particles, **options):
    options = {"noise": StandardNormal(2)} | options
    sensor = Sensor(jnp.asarray(0.4))
    return bootstrap(sample_prior, move, sensor.log_likelihood, num_particles=num_particles, **options)


def marginalised(num_particles):
    prior = Gaussian(jnp.zeros(1), jnp.eye(1))
    sample = lambda key: jax.random.normal(key, (1,))
    return rao_blackwell_shared(sample, prior, mixed, log_likelihood, num_particles=num_particles, noise_dim=1)


def last_pose(state, info):
    pose = state.particles["pose"] if isinstance(state.particles, dict) else state.particles
    return weights.mean(pose, state.log_weights)[0], info.log_evidence


def repeated(filter, ys, num_runs=NUM_RUNS):
    """Log evidence and last mean of many runs."""
    means, evidence = many_runs(filter, jax.random.split(jax.random.key(1), num_runs), ys)
    return {"mean": means[:, -1].tolist(), "log_evidence": evidence.sum(1).tolist()}


@jax.jit
def many_runs(filter, keys, ys):
    return jax.vmap(lambda key: jaxfilters.run(filter, key, ys, collect=last_pose)[1])(keys)


def by_placement(mesh, ys):
    """One device against all of them, with one key."""
    key, pf = jax.random.key(3), plain(1200)
    alone, infos = jaxfilters.run(pf, key, ys)
    start = jaxfilters.init(pf, jax.random.split(key)[0])
    spread, spread_infos = jaxfilters.run(pf, key, ys, state=jax.device_put(start, placement(pf, mesh)))
    return {
        "ancestors": bool((alone.ancestors == spread.ancestors).all()),
        "error": float(abs(alone.particles["pose"] - spread.particles["pose"]).max()),
        "evidence_error": float(abs(infos[1].log_evidence - spread_infos[1].log_evidence).max()),
        "shard": list(spread.particles["pose"].addressable_shards[0].data.shape),
    }


def exchanges(mesh, num_devices):
    """Ensembles of 10 particles a device before and after one prediction."""
    share = 10
    of_all = lambda filter, state: jaxfilters.predict(filter, jax.random.key(0), state)
    always = sharded(plain(share * num_devices), mesh, island_threshold=1.0)
    sometimes = replace(always, params=replace(always.params, island_threshold=0.5))
    start = jaxfilters.init(always, jax.random.key(2))
    islands = jnp.arange(share * num_devices) // share
    one = start._replace(log_weights=jnp.where(islands == 1, -np.log(share), -jnp.inf))
    uneven = start._replace(log_weights=weights.normalize(jnp.log(1.0 + islands))[0])
    after = of_all(sometimes, one)
    return {
        "permutation": sorted(of_all(always, start).ancestors.tolist()) == list(range(share * num_devices)),
        "moved": of_all(always, start).ancestors.tolist() != list(range(share * num_devices)),
        "stay": of_all(sometimes, start).ancestors.tolist() == list(range(share * num_devices)),
        "from_one": sorted(set((after.ancestors // share).tolist())),
        "shares": jnp.exp(after.log_weights).reshape(num_devices, share).sum(1).tolist(),
        "kept": jnp.exp(of_all(sometimes, uneven).log_weights).reshape(num_devices, share).sum(1).tolist(),
    }


def traffic(num_devices):
    """Bytes that a device of each mesh sends in an exchange, by the compiled program, and those of its particles."""
    share, found = 120, {}
    for count in (2, num_devices):
        mesh = jax.make_mesh((count,), ("particles",), devices=jax.devices()[:count])
        filter = sharded(plain(share * count), mesh, island_threshold=1.0)
        state = jaxfilters.init(filter, jax.random.key(0))
        own = jax.tree.leaves((state.particles, state.log_weights, state.ancestors))
        program = jax.jit(jaxfilters.predict).lower(filter, jax.random.key(0), state).compile().as_text()
        received = sum(result_bytes(line) for line in program.splitlines() if " all-to-all(" in line)
        found[count] = {"sent": received * (count - 1) / count, "has": sum(leaf.nbytes for leaf in own) / count}
    return found


def result_bytes(line):
    """Size of what an operation of a compiled program returns; its operands follow its name."""
    shapes = re.findall(r"[fsu]32\[([\d,]*)\]", line.partition(" all-to-all(")[0])
    return sum(4 * np.prod([int(size) for size in shape.split(",")]) for shape in shapes)


def dead(mesh, num_devices):
    """An observation that nothing explains, and log-likelihoods that are no numbers."""
    pf = sharded(plain(25 * num_devices), mesh)
    _, (state, info) = jaxfilters.run(pf, jax.random.key(0), jnp.array([0.0, 1e30, 0.0]))
    _, (_, odd) = jaxfilters.run(pf, jax.random.key(0), jnp.full(3, jnp.nan))
    return {
        "log_evidence": [str(value) for value in info.log_evidence.tolist()],
        "effective": info.effective_sample_size.tolist(),
        "finite": bool(jnp.isfinite(state.particles["pose"]).all()),
        "invalid": odd.num_invalid.tolist(),
    }


def scores(mesh, ys):
    keys = jax.random.split(jax.random.key(4), 200)
    score = jax.grad(lambda filter, key: jaxfilters.log_evidence(filter, key, ys))
    found = jax.jit(jax.vmap(score, (None, 0)))(sharded(plain(800), mesh), keys)
    return found.params.island.params.log_likelihood.callback.args[0].std.tolist()


def sequences(mesh, num_devices, ys):
    """A batch whose every device filters its own sequences."""
    batch = spread_sequences(jnp.stack([ys + i for i in range(2 * num_devices)]), mesh, axis="particles")
    total = jax.jit(jax.vmap(jaxfilters.log_evidence, (None, None, 0)))
    program = total.lower(plain(100), jax.random.key(0), batch).compile()
    placed = program(plain(100), jax.random.key(0), batch)
    alone = total(plain(100), jax.random.key(0), np.asarray(batch))
    text = program.as_text()
    talks = [word for word in ("all-reduce", "all-gather", "all-to-all", "collective-permute") if word in text]
    return {
        "error": float(abs(np.asarray(placed) - np.asarray(alone)).max()),
        "devices": len(placed.sharding.device_set),
        "collectives": talks,
    }


def refusals(mesh, num_devices):
    kalman = jaxfilters.Filter(jnp.zeros(2), lambda p, k: p, lambda p, k, s, c: s, lambda p, k, s, y, u: (s, None))
    wrong = {
        "number": lambda: sharded(plain(10 * num_devices + 1), mesh),
        "placed_number": lambda: placement(plain(10 * num_devices + 1), mesh),
        "axis": lambda: sharded(plain(10 * num_devices), mesh, axis="rows"),
        "threshold": lambda: sharded(plain(10 * num_devices), mesh, island_threshold=-1.0),
        "temper": lambda: sharded(plain(10 * num_devices, temper=AdaptiveTempering(0.2)), mesh),
        "sequences": lambda: spread_sequences(jnp.zeros((num_devices + 1, 3)), mesh, axis="particles"),
        "kind": lambda: sharded(kalman, mesh),
    }
    messages = {}
    for name, attempt in wrong.items():
        try:
            attempt()
        except ValueError as error:
            messages[name] = str(error)
    return messages


def main():
    if len(sys.argv) > 2:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"localhost:{sys.argv[3]}", 2, int(sys.argv[2]))
    num_devices = len(jax.devices())
    mesh = jax.make_mesh((num_devices,), ("particles",))
    ys = jnp.asarray(json.loads(sys.argv[1]))
    alone = len(sys.argv) == 2
    thresholds = (0.0, 0.5, 1.0) if alone else (0.5,)
    found = {
        "num_devices": num_devices,
        **{f"islands_{t}": repeated(sharded(plain(100), mesh, island_threshold=t), ys) for t in thresholds},
    }
    if alone:
        found |= {
            "marginalised": repeated(sharded(marginalised(100), mesh), ys),
            "placement": by_placement(mesh, ys),
            "exchanges": exchanges(mesh, num_devices),
            "traffic": traffic(num_devices),
            "dead": dead(mesh, num_devices),
            "scores": scores(mesh, ys),
            "sequences": sequences(mesh, num_devices, ys),
            "refusals": refusals(mesh, num_devices),
        }
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
