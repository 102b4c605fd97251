"""Exact distances to the k nearest points, on the device, without a distance matrix in memory.

Distances come from direct float32 differences: the expanded square loses small distances, and
those matter most. Four implementations differ only in speed: compiled C++ for CPUs, blocks of
points in XLA for CPUs, one reduction in XLA for GPUs, and CUDA.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from maxent_jax import native
from maxent_jax.checks import check_whole

NONE_EXCLUDED = -1
# Points in an unrolled block. Measured on two cores with AVX-512, inside a scan: few queries are
# fastest with 8 (0.9 Gpair/s, against 0.3 with 16), many with 32 (1.6).
FEW_QUERIES, SMALL_BLOCK, LARGE_BLOCK = 2048, 8, 32
# Sizes from which a tree pays off. Speed relative to no tree, measured on two cores with Gaussian
# points, the hardest: with 7 features 0.9 at this size, and 3 for 8,192 queries and 131,072 points;
# at the latter size 2.2 with 10 features and 0.4 with 16. With the states of a run a tree is two
# to seven times as fast from this size on.
TREE_QUERIES, TREE_POINTS, TREE_FEATURES = 2048, 8192, 10
# Queries in one reduction. XLA divides M points into about √M groups, and stores the k smallest of
# each group for each query: 0.3 GB for this many queries and 131,072 points.
QUERIES_AT_ONCE = 65_536
# Limits of a GPU thread's registers; beyond them `in_cuda` uses one reduction.
CUDA_NEIGHBORS, CUDA_FEATURES = 8, 15


def knn_distances(
    queries: jax.Array,
    points: jax.Array,
    k: int,
    exclude: jax.Array | None = None,
    count: jax.Array | int | None = None,
    labels: jax.Array | None = None,
) -> jax.Array:
    """Returns the distances from each query to its k nearest points, ascending.

    Works inside jit, scan and vmap; is not differentiable. Memory grows with B + M, not with B × M.

    Args:
      queries: [B, F]. float64 is slower than float32; float16 is converted to float32.
      points: [M, F], same units.
      k: the number of neighbours.
      exclude: [B] int, the label of the points that a query ignores, -1 for none. A query that is
        itself a point ignores itself by its label, even where other points share its place.
      count: [] int, how many points, from the first, are filled; all when left out. May be traced.
      labels: [M] int except -1, the labels that `exclude` names; a point's index when left out.
    Returns:
      [B, k] distances in the units of F; inf where there are fewer than k neighbours. Traced
        values cannot raise an error: a point that is not finite is never a neighbour, and a query
        that is not finite gets NaN.
    Raises:
      ValueError: k < 1, k > M or a concrete count, the sizes do not match, or a concrete value is
        not finite.
      TypeError: the input is not an array of real numbers, or labels are not whole numbers.
    """
    queries, points, k = _floats("queries", queries), _floats("points", points), check_whole("k", k)
    _check(queries, points, k, count)
    queries, points = jnp.asarray(queries), jnp.asarray(points)
    # At least 32 bits: the square of a distance above 256 overflows float16.
    dtype = jnp.promote_types(jnp.promote_types(queries.dtype, points.dtype), jnp.float32)
    queries, points = queries.astype(dtype), points.astype(dtype)
    num_queries, num_points = queries.shape[0], points.shape[0]
    if exclude is None:
        exclude = jnp.full(num_queries, NONE_EXCLUDED, jnp.int32)
    if labels is None:
        labels = jnp.arange(num_points, dtype=jnp.int32)
    exclude = _whole_numbers("exclude", exclude, (num_queries,))
    labels = _whole_numbers("labels", labels, (num_points,))
    count = _whole_numbers("count", num_points if count is None else count, ())
    on_cpu = in_cpp if dtype == jnp.float32 and native.library() else by_blocks
    return jax.lax.platform_dependent(
        *(queries, points, exclude, labels, count),
        cpu=functools.partial(on_cpu, k),
        cuda=functools.partial(by_reduction, k),
        rocm=functools.partial(by_reduction, k),
        default=functools.partial(by_blocks, k),
    )


def in_cpp(
    k: int,
    queries: jax.Array,
    points: jax.Array,
    exclude: jax.Array,
    labels: jax.Array,
    count: jax.Array,
    tree: bool | None = None,
) -> jax.Array:
    """Searches in float32 on a CPU with the native library.

    The results are bit-identical to those of `by_blocks` where the processor fuses multiplication
    and addition.

    Args: as `knn_distances`, and
      tree: whether to put the points into a tree first; when left out, where that is faster.
    """
    if tree is None:
        (num_queries, num_features), num_points = queries.shape, points.shape[0]
        many = num_queries >= TREE_QUERIES and num_points >= TREE_POINTS
        tree = many and num_features <= TREE_FEATURES
    call = _foreign("maxent_knn", queries, k)
    return call(queries, points, labels, exclude, count, tree=tree)


def in_cuda(
    k: int,
    queries: jax.Array,
    points: jax.Array,
    exclude: jax.Array,
    labels: jax.Array,
    count: jax.Array,
) -> jax.Array:
    """Searches in float32 on an NVIDIA GPU with native.cuda().

    `knn_distances` does not use it, because it has not been measured on a GPU yet.

    Args: as `knn_distances`.
    """
    if k > CUDA_NEIGHBORS or queries.shape[1] > CUDA_FEATURES:
        return by_reduction(k, queries, points, exclude, labels, count)
    return _foreign(native.CUDA_TARGET, queries, k)(queries, points, labels, exclude, count)


def _foreign(target: str, queries: jax.Array, k: int) -> Callable[..., jax.Array]:
    """A search of maxent_jax.native, by its name in XLA."""
    return jax.ffi.ffi_call(
        target,
        jax.ShapeDtypeStruct((queries.shape[0], k), jnp.float32),
        vmap_method="expand_dims",  # does not copy unmapped operands
    )


def by_blocks(
    k: int,
    queries: jax.Array,
    points: jax.Array,
    exclude: jax.Array,
    labels: jax.Array,
    count: jax.Array,
) -> jax.Array:
    """Searches by a scan over blocks of points, for CPUs.

    SIMD lanes hold the queries, each with its k smallest squares.

    Args: as `knn_distances`.
    """
    # A point that is no neighbour lies at infinity, and the label of padding matches no query.
    points = jnp.where(_neighbors(points, count)[:, None], points, jnp.inf)
    block = SMALL_BLOCK if queries.shape[0] <= FEW_QUERIES else LARGE_BLOCK
    padding = -points.shape[0] % block
    points = jnp.pad(points, ((0, padding), (0, 0)), constant_values=jnp.inf)
    labels = jnp.pad(labels, (0, padding), constant_values=NONE_EXCLUDED - 1)
    coordinates = queries.T

    def pass_block(smallest, block_of_points):
        points_, labels_ = block_of_points
        smallest = list(smallest)
        for j in range(block):
            differences = [coordinates[f] - points_[j, f] for f in range(queries.shape[1])]
            squared = sum(d * d for d in differences)
            squared = jnp.where(exclude == labels_[j], jnp.inf, squared)
            for i in range(k):  # insert: the larger one moves to the next place
                smallest[i], squared = (
                    jnp.minimum(smallest[i], squared),
                    jnp.maximum(smallest[i], squared),
                )
        return tuple(smallest), None

    none_yet = tuple(jnp.full(queries.shape[0], jnp.inf, queries.dtype) for _ in range(k))
    blocks = (points.reshape(-1, block, points.shape[1]), labels.reshape(-1, block))
    smallest, _ = jax.lax.scan(pass_block, none_yet, blocks)
    return _distances(queries, smallest)


def by_reduction(
    k: int,
    queries: jax.Array,
    points: jax.Array,
    exclude: jax.Array,
    labels: jax.Array,
    count: jax.Array,
) -> jax.Array:
    """Searches by one reduction over the points that keeps the k smallest squares, for GPUs.

    The distances are fused into the reduction: a few large kernels instead of a loop over blocks,
    for which a GPU would wait.

    Args: as `knn_distances`.
    """
    num_queries = queries.shape[0]
    if num_queries > QUERIES_AT_ONCE:
        groups = -(-num_queries // QUERIES_AT_ONCE)  # rounded up, as is the size of each
        padding = -num_queries % groups
        queries = jnp.pad(queries, ((0, padding), (0, 0))).reshape(groups, -1, queries.shape[1])
        exclude = jnp.pad(exclude, (0, padding)).reshape(groups, -1)
        found = jax.lax.map(
            lambda group: by_reduction(k, group[0], points, group[1], labels, count),
            (queries, exclude),
        )
        return found.reshape(-1, k)[:num_queries]
    points = jnp.where(_neighbors(points, count)[:, None], points, jnp.inf)
    # [B, M], never stored. Reduced along M: along B, XLA stores it (seen in its compiled programs).
    differences = [queries[:, f, None] - points[None, :, f] for f in range(queries.shape[1])]
    squared = sum(d * d for d in differences)
    squared = jnp.where(exclude[:, None] == labels[None, :], jnp.inf, squared)
    nothing = jnp.asarray(jnp.inf, squared.dtype)
    alone = squared, *[jnp.full_like(squared, jnp.inf)] * (k - 1)  # k for each point, its own first
    return _distances(queries, jax.lax.reduce(alone, (nothing,) * k, _merged, (1,)))


def _merged(a, b):
    """The k smallest of two ascending lists of k."""
    # The j-th: the least, over all ways to take j from both, of the larger of the two last taken.
    smallest = []
    for j in range(len(a)):
        last_taken = [jnp.maximum(a[i], b[j - 1 - i]) for i in range(j)] + [jnp.minimum(a[j], b[j])]
        smallest.append(functools.reduce(jnp.minimum, last_taken))
    return tuple(smallest)


def _neighbors(points, count):
    """[M] bool: filled, and finite."""
    return (jnp.arange(points.shape[0]) < count) & jnp.all(jnp.isfinite(points), axis=1)


def _distances(queries, smallest):
    """[B, k] from k arrays of squares, [B] each."""
    valid = jnp.all(jnp.isfinite(queries), axis=1, keepdims=True)
    return jnp.where(valid, jnp.sqrt(jnp.stack(smallest, axis=1)), jnp.nan)


def smallest_k(values: jax.Array, k: int) -> jax.Array:
    """Returns the k smallest of each row, ascending, [..., L] -> [..., k].

    Makes k passes, for short rows: on a CPU `lax.top_k` sorts whole rows.
    """
    found = []
    positions = jax.lax.broadcasted_iota(jnp.int32, values.shape, values.ndim - 1)
    for _ in range(k):
        nearest = jnp.argmin(values, axis=-1)
        found.append(jnp.min(values, axis=-1))
        values = jnp.where(positions == nearest[..., None], jnp.inf, values)
    return jnp.stack(found, axis=-1)


def _floats(name: str, values: Any) -> Any:
    """The values as floats, in a numpy or jax array as given."""
    values = _array(name, values)
    if jnp.issubdtype(values.dtype, jnp.integer) or values.dtype == bool:
        return values.astype(jnp.float32)
    if not jnp.issubdtype(values.dtype, jnp.floating):
        raise TypeError(f"{name} have dtype {values.dtype}, but must be real numbers")
    return values


def _whole_numbers(name: str, values: Any, shape: tuple[int, ...]) -> jax.Array:
    values = _array(name, values)
    if not jnp.issubdtype(values.dtype, jnp.integer):
        raise TypeError(f"{name} is of dtype {values.dtype}, but must be whole numbers")
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}, but must be {shape}")
    return jnp.asarray(values, jnp.int32)


def _array(name: str, values: Any) -> Any:
    if isinstance(values, jax.Array | np.ndarray):
        return values
    try:
        array = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise TypeError(f"{name} cannot be converted to an array: {error}") from None
    if array.dtype == np.float64:  # Python floats, which are float32 in jax too
        return array.astype(np.float32)
    if not (np.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise TypeError(f"{name} holds {array.dtype}, but must be an array of numbers")
    return array


def _check(queries, points, k, count) -> None:
    if queries.ndim != 2 or points.ndim != 2 or queries.shape[1] != points.shape[1]:
        raise ValueError(
            f"queries have shape {queries.shape} and points {points.shape}, but must be [B, F] and "
            f"[M, F]"
        )
    available = points.shape[0]
    if count is not None and not isinstance(count, jax.core.Tracer):
        if check_whole("count", count) > available:
            raise ValueError(f"count is {count}, but there are {available} points")
        available = int(count)
    if not 1 <= k <= available:
        raise ValueError(f"k is {k}, but must be from 1 to the number of points, {available}")
    for name, value in (("queries", queries), ("points", points)):
        if not isinstance(value, jax.core.Tracer):
            rows = np.asarray(value)  # slicing a jax array would be traced inside jit
            if not np.isfinite(rows if name == "queries" else rows[:available]).all():
                raise ValueError(f"{name} hold a number that is not finite")
