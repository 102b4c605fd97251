"""A uniform sample, of fixed size, of all points seen so far (Vitter 1985, algorithm R)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Reservoir(NamedTuple):
    """The first min(seen, M) points are filled."""

    points: jax.Array  # [M, F]
    seen: jax.Array  # [] int32


def init(capacity: int, dims: int) -> Reservoir:
    """Returns an empty reservoir for `capacity` points with `dims` features."""
    return Reservoir(jnp.zeros((capacity, dims)), jnp.zeros((), jnp.int32))


def add(reservoir: Reservoir, points: jax.Array, valid: jax.Array, key: jax.Array) -> Reservoir:
    """Updates the sample with new points.

    Args:
      reservoir: [M, F].
      points: [B, F].
      valid: [B] bool, the points that count.
      key: draws which points stay.
    Returns:
      The reservoir [M, F], a uniform sample of all valid points so far.
    """
    capacity = reservoir.points.shape[0]
    ordinal = reservoir.seen + jnp.cumsum(valid, dtype=jnp.int32) - 1
    slot = jnp.where(
        ordinal < capacity, ordinal, jax.random.randint(key, ordinal.shape, 0, ordinal + 1)
    )
    slot = jnp.where(valid, slot, capacity)  # beyond the last slot nothing is stored
    # If rows share a slot, the last one stays, as if they came one by one: an accelerator scatters
    # rows to the same place in no defined order.
    rows = jnp.arange(points.shape[0], dtype=jnp.int32)
    last = jnp.zeros(capacity + 1, jnp.int32).at[slot].max(rows)
    slot = jnp.where(rows == last[slot], slot, capacity)
    return Reservoir(
        reservoir.points.at[slot].set(points, mode="drop"),
        reservoir.seen + jnp.sum(valid, dtype=jnp.int32),
    )


def count(reservoir: Reservoir) -> jax.Array:
    """Returns the number of filled points, [] int32."""
    return jnp.minimum(reservoir.seen, reservoir.points.shape[0])
