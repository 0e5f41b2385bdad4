"""The batch command on all machines of a Ray cluster: a task for each of its GPUs, or for each machine without one.

Ray only starts the tasks; who tracks which recording is decided by the claims in the folder of the results, as without
it. A task whose machine fails is started again, and its recordings are taken over meanwhile.
"""

import argparse
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from jaxfilters.trackers.io.errors import InputError


def run_on_cluster(options: argparse.Namespace) -> None:
    """Run the command of `options` on every share of the cluster at `options.ray`, and wait for all of them.

    Raises:
        InputError: Ray is not installed, there is no cluster at the address, or it has no processors.
    """
    try:
        ray: Any = import_module("ray")
    except ImportError:
        raise InputError("--ray needs the package ray: pip install 'jaxfilters[ray]'.") from None
    try:
        ray.init(address=options.ray, log_to_driver=True)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise InputError(f"--ray {options.ray}: no cluster answers ({str(error).splitlines()[0]}).") from None
    try:
        _wait_for_all(ray, options)
    finally:
        ray.shutdown()


def shares_of(nodes: Sequence[Mapping[str, Any]]) -> list[tuple[str, dict[str, int]]]:
    """Machine and resources of each task, of the machines as `ray.nodes` lists them."""
    shares: list[tuple[str, dict[str, int]]] = []
    for node in nodes:
        found = node["Resources"]
        cpus, gpus = int(found.get("CPU", 0)), int(found.get("GPU", 0))
        if node["Alive"] and (cpus or gpus):
            share = {"num_cpus": cpus // gpus, "num_gpus": 1} if gpus else {"num_cpus": cpus}
            shares += max(1, gpus) * [(node["NodeID"], share)]
    return shares


def _wait_for_all(ray: Any, options: argparse.Namespace) -> None:
    strategies: Any = import_module("ray.util.scheduling_strategies")
    shares = shares_of(ray.nodes())
    if not shares:
        raise InputError(f"--ray {options.ray}: its machines have no processors to offer.")
    here = {"manifest": options.manifest.resolve(), "out": options.out.resolve(), "ray": None, "retry": False}
    words = argparse.Namespace(**vars(options) | here)
    tasks = []
    for machine, share in shares:
        place = strategies.NodeAffinitySchedulingStrategy(machine, soft=True)
        remote = ray.remote(max_retries=-1, scheduling_strategy=place, **share)(_work)
        tasks.append(remote.remote(words))
    try:
        ray.get(tasks)
    except KeyboardInterrupt:
        for task in tasks:
            ray.cancel(task)  # as Ctrl-C: what is tracked is kept
        ray.wait(tasks, num_returns=len(tasks), timeout=60)
        raise


def _work(options: argparse.Namespace) -> None:
    """Track what no other process tracks, in a process of the cluster."""
    from jaxfilters.trackers.batch.command import Batch
    from jaxfilters.trackers.batch.manifest import read_manifest

    Batch(read_manifest(options.manifest), options).work()
