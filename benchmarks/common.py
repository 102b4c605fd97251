"""What every benchmark prints and measures alike."""

import importlib.metadata
import os
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy")


def print_versions() -> None:
    """The first line of every benchmark: what was measured, on what."""
    versions = " ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    device = jax.devices()[0]
    print(
        f"# python {platform.python_version()} {versions} | {device.platform} "
        f"{device.device_kind}, {os.cpu_count()} CPU cores",
        flush=True,
    )


def median_seconds(call: Callable[[], Any], repeats: int = 5) -> float:
    """Median time of a call that returns arrays, after one call to warm up."""
    jax.block_until_ready(call())
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)
