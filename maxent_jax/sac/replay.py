"""The replay buffer: a ring, as immutable state and functions. Adding costs the same when full."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Replay(NamedTuple):
    """The first `size` rows of `items` are filled; the next row goes to `cursor`."""

    items: Any  # a pytree, [capacity, ...]
    size: jax.Array  # int32
    cursor: jax.Array  # int32


def init(item: Any, capacity: int) -> Replay:
    """Returns an empty ring for items like `item`, which has no leading axis."""
    items = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), item)
    return Replay(items, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def add(replay: Replay, items: Any, valid: jax.Array) -> Replay:
    """Adds the `valid` [B] rows of `items` [B, ...]; a full ring overwrites its oldest rows."""
    capacity = capacity_of(replay)
    num_added = jnp.sum(valid, dtype=jnp.int32)
    rows = destinations(replay, valid)
    return Replay(
        items=jax.tree.map(lambda x, new: x.at[rows].set(new, mode="drop"), replay.items, items),
        size=jnp.minimum(replay.size + num_added, capacity),
        cursor=(replay.cursor + num_added) % capacity,
    )


def destinations(replay: Replay, valid: jax.Array) -> jax.Array:
    """Returns where `add` puts each row, [B] bool -> [B] int32; the capacity for a dropped row."""
    capacity = capacity_of(replay)
    offset = jnp.cumsum(valid, dtype=jnp.int32) - 1
    # Of more rows than places only the last stay: a scatter leaves open which duplicate wins.
    kept = valid & (offset >= jnp.sum(valid, dtype=jnp.int32) - capacity)
    return jnp.where(kept, (replay.cursor + offset) % capacity, capacity)


def draw(replay: Replay, shape: tuple[int, ...], key: jax.Array, skip: int = 0) -> jax.Array:
    """Draws filled rows uniformly with replacement, [*shape] int32; 0 from an empty ring.

    Args:
      replay: the ring.
      shape: of the draw.
      key: of the draw.
      skip: how many of the oldest rows to leave out when the ring is full.
    """
    capacity = capacity_of(replay)
    skipped = jnp.where(replay.size == capacity, skip, 0)
    nth = jax.random.randint(key, shape, 0, jnp.maximum(replay.size - skipped, 1))
    oldest = replay.cursor - replay.size + skipped
    return (oldest + nth) % capacity


def sample(replay: Replay, shape: tuple[int, ...], key: jax.Array) -> Any:
    """Draws items uniformly with replacement, [*shape, ...]; zeros from an empty ring."""
    rows = draw(replay, shape, key)
    return jax.tree.map(lambda x: x[rows], replay.items)


def capacity_of(replay: Replay) -> int:
    """Returns the number of rows."""
    return jax.tree.leaves(replay.items)[0].shape[0]
