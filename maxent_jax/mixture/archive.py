"""The archive: all policies of the mixture, as one pytree."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.sac.agent import Parameters


class Archive(NamedTuple):
    """P slots: the first `size` hold a policy, and the others have weight 0."""

    parameters: Parameters  # [P, ...]
    size: jax.Array  # int32


def init(parameters: Parameters, capacity: int) -> Archive:
    """Returns an empty archive with `capacity` slots for agents of this shape."""
    empty = jax.tree.map(lambda x: jnp.zeros((capacity, *x.shape), x.dtype), parameters)
    return Archive(empty, jnp.zeros((), jnp.int32))


def append(archive: Archive, parameters: Parameters, due: jax.Array | bool = True) -> Archive:
    """Adds a policy if `due`, [] bool; a full archive stays as it is."""
    capacity = jax.tree.leaves(archive.parameters)[0].shape[0]
    slot = jnp.where(due, archive.size, capacity)
    stored = jax.tree.map(
        lambda slots, x: slots.at[slot].set(x, mode="drop"), archive.parameters, parameters
    )
    return Archive(stored, jnp.minimum(archive.size + due, capacity))


def policy(archive: Archive, index: jax.Array) -> Parameters:
    """Returns the agents in the slots `index` [...]; each leaf becomes [..., *its shape]."""
    return jax.tree.map(lambda slots: slots[index], archive.parameters)
