"""C++ that XLA calls on a CPU: the search for nearest neighbours (knn.cc), physics (physics.cc).

An optional fast path: results are the same without it. There is one build for each kind of
processor. A small library that runs on the oldest processors (cpu.c) says which build to load, so
that none runs where it cannot. The search can also be built for NVIDIA GPUs (knn.cu).
"""

import ctypes
import functools
import logging
import os
from pathlib import Path

import jax

from maxent_jax.errors import ConfigError

TARGETS = ("maxent_knn", "maxent_physics", "maxent_physics_start", "maxent_physics_finish")
CUDA_TARGET = "maxent_knn_cuda"
# Builds, fastest first, and the processors that run each, by their number from maxent_level.
LEVELS = {"v4": (4,), "v3": (3, 4), "v8": (8,)}
NONE, AUTO = "none", "auto"
CHOICE = "MAXENT_JAX_NATIVE"  # environment variable: a build's name, none, or auto
FOLDER = Path(__file__).parent

log = logging.getLogger(__name__)


@functools.cache
def library() -> ctypes.CDLL | None:
    """Loads the build for this processor, and registers its functions with XLA; None without one.

    Raises:
      ConfigError: MAXENT_JAX_NATIVE names a build that cannot be used here.
    """
    name = variant()
    if name == NONE:
        return None
    return _load(name, TARGETS, "cpu")


@functools.cache
def cuda() -> ctypes.CDLL | None:
    """Loads the build for NVIDIA GPUs, and registers its function with XLA; None without one."""
    if not path("cuda").exists():
        return None
    return _load("cuda", (CUDA_TARGET,), "CUDA")


def _load(name: str, targets: tuple[str, ...], platform: str) -> ctypes.CDLL:
    """Loads a build, and registers its functions with XLA for a platform."""
    loaded = ctypes.CDLL(str(path(name)))
    for target in targets:
        function = jax.ffi.pycapsule(getattr(loaded, target))
        jax.ffi.register_ffi_target(target, function, platform=platform)
    return loaded


@functools.cache
def variant() -> str:
    """Returns the build in use: v4 (x86-64 with AVX-512), v3 (with AVX2), v8 (64-bit Arm), or none.

    Raises:
      ConfigError: MAXENT_JAX_NATIVE names a build that cannot be used here.
    """
    here = usable()
    wanted = os.environ.get(CHOICE) or AUTO
    if wanted == AUTO:
        chosen = (*here, NONE)[0]
    elif wanted in (*here, NONE):
        chosen = wanted
    else:
        allowed = ", ".join((AUTO, *here, NONE))
        raise ConfigError(f"{CHOICE} is '{wanted}', but this machine can use: {allowed}.")
    log.debug("native build: %s, of those usable here: %s", chosen, ", ".join(here) or NONE)
    return chosen


def usable() -> tuple[str, ...]:
    """Returns the builds that exist and that this processor can run, fastest first."""
    return tuple(name for name in LEVELS if path(name).exists() and _level() in LEVELS[name])


def path(name: str) -> Path:
    """Returns the path of a build, whether it exists or not."""
    return FOLDER / f"_{name}.so"


@functools.cache
def _level() -> int:
    return ctypes.CDLL(str(path("cpu"))).maxent_level() if path("cpu").exists() else 0
