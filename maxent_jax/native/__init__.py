"""C++ that XLA calls on a CPU: the search for nearest neighbours (knn.cc), physics (physics.cc).

An optional fast path: results are the same without it. The library is built once for each kind of
processor. Nothing of a build runs where it cannot: a small library for the oldest processors
(cpu.c) says which one to load. The search can be built for NVIDIA's GPUs too (knn.cu).
"""

import ctypes
import functools
import logging
import os
from pathlib import Path

import jax

from maxent_jax.errors import ConfigError

TARGETS = ("maxent_knn", "maxent_physics")
CUDA_TARGET = "maxent_knn_cuda"
# Builds, the fastest first, and the processors that run each, as maxent_level numbers them.
LEVELS = {"v4": (4,), "v3": (3, 4), "v8": (8,)}
NONE, AUTO = "none", "auto"
CHOICE = "MAXENT_JAX_NATIVE"  # environment variable: a build's name, none, or auto
FOLDER = Path(__file__).parent

log = logging.getLogger(__name__)


@functools.cache
def library() -> ctypes.CDLL | None:
    """The build for this processor, its functions known to XLA; None where there is none.

    Raises:
      ConfigError: MAXENT_JAX_NATIVE names a build that cannot be used here.
    """
    name = variant()
    if name == NONE:
        return None
    return _load(name, TARGETS, "cpu")


@functools.cache
def cuda() -> ctypes.CDLL | None:
    """The build for NVIDIA's GPUs, its function known to XLA; None where there is none."""
    if not path("cuda").exists():
        return None
    return _load("cuda", (CUDA_TARGET,), "CUDA")


def _load(name: str, targets: tuple[str, ...], platform: str) -> ctypes.CDLL:
    """A build, its functions known to XLA on that platform."""
    loaded = ctypes.CDLL(str(path(name)))
    for target in targets:
        function = jax.ffi.pycapsule(getattr(loaded, target))
        jax.ffi.register_ffi_target(target, function, platform=platform)
    return loaded


@functools.cache
def variant() -> str:
    """Which build is used: v4 (x86-64 with AVX-512), v3 (with AVX2), v8 (64-bit Arm), or none.

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
    """The builds that were made and that this processor can run, the fastest first."""
    return tuple(name for name in LEVELS if path(name).exists() and _level() in LEVELS[name])


def path(name: str) -> Path:
    """Where the build of that name lies, if it was made."""
    return FOLDER / f"_{name}.so"


@functools.cache
def _level() -> int:
    return ctypes.CDLL(str(path("cpu"))).maxent_level() if path("cpu").exists() else 0
