"""A uniform sample of everything that ever passed by, of fixed size (Vitter 1985, algorithm R)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class Reservoir(NamedTuple):
    """The first min(seen, M) points are filled."""

    points: jax.Array  # [M, F]
    seen: jax.Array  # [] int32


def init(capacity: int, dims: int) -> Reservoir:
    return Reservoir(jnp.zeros((capacity, dims)), jnp.zeros((), jnp.int32))


def add(reservoir: Reservoir, points: jax.Array, valid: jax.Array, key: jax.Array) -> Reservoir:
    """With the valid rows of `points` [B, F] having passed by."""
    capacity = reservoir.points.shape[0]
    ordinal = reservoir.seen + jnp.cumsum(valid, dtype=jnp.int32) - 1
    slot = jnp.where(
        ordinal < capacity, ordinal, jax.random.randint(key, ordinal.shape, 0, ordinal + 1)
    )
    slot = jnp.where(valid, slot, capacity)  # a slot beyond the last stores nothing
    # Of rows with one slot the last stays, as if they came one by one: a scatter of several to one
    # place has no defined order on an accelerator.
    rows = jnp.arange(points.shape[0], dtype=jnp.int32)
    last = jnp.zeros(capacity + 1, jnp.int32).at[slot].max(rows)
    slot = jnp.where(rows == last[slot], slot, capacity)
    return Reservoir(
        reservoir.points.at[slot].set(points, mode="drop"),
        reservoir.seen + jnp.sum(valid, dtype=jnp.int32),
    )


def count(reservoir: Reservoir) -> jax.Array:
    """[] int32: how many points are filled."""
    return jnp.minimum(reservoir.seen, reservoir.points.shape[0])
