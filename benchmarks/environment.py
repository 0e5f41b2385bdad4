"""The machine and the versions that a measurement holds for."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax

from jaxfilters.trackers.app.devices import available_cores, processor

PEERS = ("dynamax", "cuthbert", "filterpy", "particles", "smcx", "blackjax", "hmmlearn", "nlopt", "pyceres", "embreex")
"""Libraries that scenarios compare with, where they are installed."""


def environment() -> dict[str, Any]:
    """JSON-able: versions, processor, cores, load at the time, and the devices that JAX computes on."""
    devices = jax.devices()
    return {
        **{package: version(package) for package in ("jaxfilters", "jax", "jaxlib", "numpy")},
        "peers": {peer: found for peer in PEERS if (found := _installed(peer)) is not None},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": processor("model name") or platform.processor() or platform.machine(),
        "cores": available_cores(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "backend": jax.default_backend(),
        "device": devices[0].device_kind,
        "devices": len(devices),
    }


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
