"""A ring of experience as frozen state and functions; inserting costs the same when it is full."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


class Replay(NamedTuple):
    """The first `size` rows of `items` are filled; the next row goes to `cursor`."""

    items: Any  # a pytree, [capacity, ...]
    size: jax.Array  # int32
    cursor: jax.Array  # int32


def init(item: Any, capacity: int) -> Replay:
    """An empty ring for items of the shapes and dtypes of `item`, which has no leading axis."""
    items = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), item)
    return Replay(items, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def add(replay: Replay, items: Any, valid: jax.Array) -> Replay:
    """With the valid rows of `items` [B, ...] inserted, over the oldest once it is full."""
    capacity = capacity_of(replay)
    num_added = jnp.sum(valid, dtype=jnp.int32)
    rows = destinations(replay, valid)
    return Replay(
        items=jax.tree.map(lambda x, new: x.at[rows].set(new, mode="drop"), replay.items, items),
        size=jnp.minimum(replay.size + num_added, capacity),
        cursor=(replay.cursor + num_added) % capacity,
    )


def destinations(replay: Replay, valid: jax.Array) -> jax.Array:
    """[B] int32: where `add` puts each of the rows; the capacity for one that it drops."""
    capacity = capacity_of(replay)
    offset = jnp.cumsum(valid, dtype=jnp.int32) - 1
    # Of more rows than places only the last stay: a scatter leaves open which duplicate wins.
    kept = valid & (offset >= jnp.sum(valid, dtype=jnp.int32) - capacity)
    return jnp.where(kept, (replay.cursor + offset) % capacity, capacity)


def draw(replay: Replay, shape: tuple[int, ...], key: jax.Array, skip: int = 0) -> jax.Array:
    """Filled rows, int32 of that shape, drawn uniformly, with replacement; 0 while it is empty.

    Args:
      skip: once the ring is full, leave out so many of the oldest rows.
    """
    capacity = capacity_of(replay)
    skipped = jnp.where(replay.size == capacity, skip, 0)
    nth = jax.random.randint(key, shape, 0, jnp.maximum(replay.size - skipped, 1))
    oldest = replay.cursor - replay.size + skipped
    return (oldest + nth) % capacity


def sample(replay: Replay, shape: tuple[int, ...], key: jax.Array) -> Any:
    """Items [*shape, ...] drawn uniformly, with replacement. Zeros while the ring is empty."""
    rows = draw(replay, shape, key)
    return jax.tree.map(lambda x: x[rows], replay.items)


def capacity_of(replay: Replay) -> int:
    """The number of rows."""
    return jax.tree.leaves(replay.items)[0].shape[0]
