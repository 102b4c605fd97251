"""How far the states of a batch lie from each other."""

import jax
import jax.numpy as jnp

from maxent_jax.density.knn import knn_distances


def distances(points: jax.Array, rows: jax.Array, num_neighbors: int) -> jax.Array:
    """Distances from each point [B, F] to its k nearest others, ascending, [B, k].

    A point leaves itself out, and every copy of it, by its row [B]. The code of RE3, APT and VCSE
    sorts it among its neighbours, so that their k counts one neighbour fewer, but in RE3, which
    asks for k + 1.

    Where copies leave fewer than k others, the farthest of them stands for those that are missing.

    Raises:
      ValueError: B <= k.
    """
    check(points.shape[0], num_neighbors)
    return filled(knn_distances(points, points, num_neighbors, exclude=rows, labels=rows))


def filled(nearest: jax.Array) -> jax.Array:
    """[..., k] with the farthest in place of those that are missing, inf; 0 where all are."""
    there = jnp.isfinite(nearest)
    farthest = jnp.max(jnp.where(there, nearest, 0.0), axis=-1, keepdims=True)
    return jnp.where(there, nearest, farthest)


def check(batch_size: int, num_neighbors: int) -> None:
    """Refuse a batch in which a state has too few others."""
    if batch_size <= num_neighbors:
        raise ValueError(
            f"a batch of {batch_size} is too small for {num_neighbors} neighbours of each state"
        )
