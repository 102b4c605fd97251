"""The search for nearest neighbours on several devices: divides the queries or the points."""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from maxent_jax.density.knn import NONE_EXCLUDED, knn_distances, smallest_k


def sharded_knn_distances(
    queries: jax.Array,
    points: jax.Array,
    k: int,
    mesh: Mesh,
    axis: str,
    shard: Literal["queries", "points"] = "queries",
    exclude: jax.Array | None = None,
    count: jax.Array | int | None = None,
    labels: jax.Array | None = None,
) -> jax.Array:
    """Runs knn_distances over one axis of a mesh of devices.

    Sizes need not be multiples of the number of devices.

    Args: as `knn_distances`, and
      mesh: the devices.
      axis: the mesh's axis to divide over.
      shard: what to divide among the devices; each holds the other whole. "queries" needs no
        communication. "points", for sets that one device cannot hold, gathers k candidates for
        each query from each device and keeps the k nearest.
    Returns:
      [B, k], divided like the queries if shard is "queries" and B a multiple of the number of
        devices, else whole on every device.
    Raises:
      ValueError: axis or shard is unknown, k > M, or the sizes do not match.
    """
    if axis not in mesh.shape:
        raise ValueError(f"the mesh has no axis '{axis}', only {', '.join(mesh.axis_names)}")
    if shard not in ("queries", "points"):
        raise ValueError(f"shard is '{shard}', but must be 'queries' or 'points'")
    num_queries, num_points = queries.shape[0], points.shape[0]
    if not 1 <= k <= num_points:
        raise ValueError(f"k is {k}, but must be from 1 to the number of points, {num_points}")
    exclude = jnp.full(num_queries, NONE_EXCLUDED, jnp.int32) if exclude is None else exclude
    labels = jnp.arange(num_points, dtype=jnp.int32) if labels is None else labels
    count = jnp.asarray(num_points if count is None else count, jnp.int32)
    size = mesh.shape[axis]
    if shard == "queries":
        find = lambda q, x, e, y, n: knn_distances(q, x, k, e, n, y)
        given = _pad(queries, size), points, _pad(exclude, size), labels, count
        specs = P(axis), P(), P(axis), P(), P()
        found = _on(mesh, find, given, specs, P(axis))
        if num_queries % size == 0:
            return found
        return jax.device_put(found, NamedSharding(mesh, P()))[:num_queries]
    find = functools.partial(_of_all_points, k, axis)
    # Padding comes after the filled points, so that no query sees it.
    given = queries, _pad(points, size), exclude, _pad(labels, size), count
    return _on(mesh, find, given, (P(), P(axis), P(), P(axis), P()), P())


def _on(mesh, find, given, specs, out_spec):
    """The search on each device. The mesh's axes may be explicit or automatic."""
    placed = [
        jax.device_put(x, NamedSharding(mesh, spec)) for x, spec in zip(given, specs, strict=True)
    ]
    # check_vma=False: jax cannot know that a foreign function's results are replicated.
    part = jax.shard_map(find, mesh=mesh, in_specs=specs, out_specs=out_spec, check_vma=False)
    return part(*placed)


def _of_all_points(k, axis, queries, points, exclude, labels, count):
    """The k nearest of this device's points, then of all devices' candidates."""
    num_here = points.shape[0]
    count = jnp.clip(count - jax.lax.axis_index(axis) * num_here, 0, num_here)
    found = knn_distances(queries, points, min(k, num_here), exclude, count, labels)
    candidates = jax.lax.all_gather(found, axis, axis=1, tiled=True)
    return smallest_k(candidates, k)


def _pad(rows: jax.Array, multiple: int) -> jax.Array:
    padding = -rows.shape[0] % multiple
    return jnp.pad(rows, ((0, padding),) + ((0, 0),) * (rows.ndim - 1))
