"""The compiled search for nearest neighbours, `knn.cc`, where it was built and can run.

Its distances are those of XLA's own search, to the bit where the processor fuses multiplication and
addition: it is there because it is ten times as fast.
"""

import ctypes
import functools
import importlib.util

import jax
import jax.numpy as jnp

TARGET = "maxent_knn"
VARIANTS = ("v4", "v3", "v8")  # setup.py says what they are; the fastest first
# Where putting the points into a tree repays itself. Measured on two cores with Gaussian points,
# the hardest: with 7 features 0.9 times as fast at this size and 3 times with 8,192 queries of
# 131,072 points; with 10 features 2.2 times there, with 16 no longer (0.4). With a run's states
# twice to seven times as fast from this size on.
TREE_QUERIES, TREE_POINTS, TREE_FEATURES = 2048, 8192, 10


@functools.cache
def available() -> bool:
    """Whether a compiled variant runs here. Registers it with XLA, once."""
    for variant in VARIANTS:
        found = importlib.util.find_spec(f"maxent_jax.density._knn_{variant}")
        if found is None or found.origin is None:
            continue
        library = ctypes.CDLL(found.origin)
        if library.maxent_knn_runs_here():
            target = jax.ffi.pycapsule(library.maxent_knn)
            jax.ffi.register_ffi_target(TARGET, target, platform="cpu")
            return True
    return False


def knn_distances(
    k: int,
    queries: jax.Array,
    points: jax.Array,
    exclude: jax.Array,
    labels: jax.Array,
    count: jax.Array,
    tree: bool | None = None,
) -> jax.Array:
    """As density.knn.knn_distances, in float32 and on a CPU only, where `available`.

    Args:
      tree: whether the points are put into a tree first; where it pays, if left out.
    """
    if tree is None:
        (num_queries, num_features), num_points = queries.shape, points.shape[0]
        many = num_queries >= TREE_QUERIES and num_points >= TREE_POINTS
        tree = many and num_features <= TREE_FEATURES
    call = jax.ffi.ffi_call(
        TARGET,
        jax.ShapeDtypeStruct((queries.shape[0], k), jnp.float32),
        vmap_method="expand_dims",  # what is not mapped over is not copied
    )
    return call(queries, points, labels, exclude, count, tree=tree)
