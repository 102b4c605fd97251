"""C++ that XLA calls on a CPU, where it was built and can run: the search for nearest neighbours
(knn.cc) and the physics (physics.cc).

It computes nothing that is not also there without it; it is there because it is faster.
"""

import ctypes
import functools
import importlib.util

import jax

TARGETS = ("maxent_knn", "maxent_physics")
VARIANTS = ("v4", "v3", "v8")  # setup.py says what they are; the fastest first


@functools.cache
def library() -> ctypes.CDLL | None:
    """The first variant that runs here, its functions known to XLA; None where there is none."""
    for variant in VARIANTS:
        found = importlib.util.find_spec(f"maxent_jax.native._{variant}")
        if found is None or found.origin is None:
            continue
        loaded = ctypes.CDLL(found.origin)
        if loaded.maxent_runs_here():
            for target in TARGETS:
                function = jax.ffi.pycapsule(getattr(loaded, target))
                jax.ffi.register_ffi_target(target, function, platform="cpu")
            return loaded
    return None
