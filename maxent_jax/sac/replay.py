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
    capacity = _capacity(replay)
    offset = jnp.cumsum(valid, dtype=jnp.int32) - 1
    num_added = jnp.sum(valid, dtype=jnp.int32)
    # Of more rows than places only the last stay: a scatter leaves open which duplicate wins.
    kept = valid & (offset >= num_added - capacity)
    rows = jnp.where(kept, (replay.cursor + offset) % capacity, capacity)
    return Replay(
        items=jax.tree.map(lambda x, new: x.at[rows].set(new, mode="drop"), replay.items, items),
        size=jnp.minimum(replay.size + num_added, capacity),
        cursor=(replay.cursor + num_added) % capacity,
    )


def sample(replay: Replay, shape: tuple[int, ...], key: jax.Array) -> Any:
    """Items [*shape, ...] drawn uniformly, with replacement. Zeros while the ring is empty."""
    rows = jax.random.randint(key, shape, 0, jnp.maximum(replay.size, 1))
    return jax.tree.map(lambda x: x[rows], replay.items)


def _capacity(replay: Replay) -> int:
    return jax.tree.leaves(replay.items)[0].shape[0]
