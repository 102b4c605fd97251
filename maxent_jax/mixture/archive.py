"""The archive: every policy of the mixture, as one pytree."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.sac.agent import Parameters


class Archive(NamedTuple):
    """The first `size` of P slots hold a policy; the others are masked by weight 0."""

    parameters: Parameters  # [P, ...]
    size: jax.Array  # int32


def init(parameters: Parameters, capacity: int) -> Archive:
    """An empty archive for agents of that shape."""
    empty = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), parameters)
    return Archive(empty, jnp.zeros((), jnp.int32))


def append(archive: Archive, parameters: Parameters, due: jax.Array | bool = True) -> Archive:
    """With one more policy if `due`, [] bool. Beyond the last slot nothing is stored."""
    capacity = jax.tree.leaves(archive.parameters)[0].shape[0]
    slot = jnp.where(due, archive.size, capacity)
    stored = jax.tree.map(
        lambda slots, x: slots.at[slot].set(x, mode="drop"), archive.parameters, parameters
    )
    return Archive(stored, jnp.minimum(archive.size + due, capacity))


def policy(archive: Archive, index: jax.Array) -> Parameters:
    """The agent in the slots `index` [...], with those axes in front of each leaf."""
    return jax.tree.map(lambda slots: slots[index], archive.parameters)
