"""Distances between the states of a batch."""

import jax
import jax.numpy as jnp

from maxent_jax.density.knn import knn_distances


def distances(points: jax.Array, rows: jax.Array, num_neighbors: int) -> jax.Array:
    """Returns the distances from each point to its k nearest others, ascending.

    A point ignores itself and its copies. In the code of RE3, APT and VCSE, a point is among its
    own neighbours, so that their k counts one neighbour fewer, except in RE3, which asks for k + 1.

    Args:
      points: [B, F].
      rows: [B] int32, equal for copies of one point.
      num_neighbors: k.
    Returns:
      [B, k]. If copies leave fewer than k others, the farthest of these fills the missing places.
    Raises:
      ValueError: B <= k.
    """
    check(points.shape[0], num_neighbors)
    return filled(knn_distances(points, points, num_neighbors, exclude=rows, labels=rows))


def filled(nearest: jax.Array) -> jax.Array:
    """Replaces missing distances (inf) by the farthest one, or by 0 if all are, [..., k]."""
    there = jnp.isfinite(nearest)
    farthest = jnp.max(jnp.where(there, nearest, 0.0), axis=-1, keepdims=True)
    return jnp.where(there, nearest, farthest)


def check(batch_size: int, num_neighbors: int) -> None:
    """Raises ValueError if a state of the batch has too few others."""
    if batch_size <= num_neighbors:
        raise ValueError(
            f"a batch of {batch_size} is too small for {num_neighbors} neighbours of each state"
        )
