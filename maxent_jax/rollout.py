"""Whole episodes of the mixture, one policy each."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.envs import base
from maxent_jax.envs.base import Env, State


class Trajectories(NamedTuple):
    """E episodes side by side. A state counts while `alive`: it was reached before the end."""

    states: jax.Array  # [T, E, D] the state reached by each step
    alive: jax.Array  # [T, E] bool
    num_invalid: jax.Array  # [] int32, steps at which the physics left the finite numbers


def episodes(
    env: Env,
    starts: State,
    act: Callable[[jax.Array, jax.Array], jax.Array],
    episode_length: int,
    key: jax.Array,
) -> Trajectories:
    """One episode from each start, to its end or the time limit.

    Args:
      starts: [E, ...].
      act: observation [E, D], key -> action [E, A].
      episode_length: T.
    """

    def step(carry, key_step):
        current, alive = carry
        after = jax.vmap(env.step)(current, act(current.obs, key_step))
        valid = base.finite_rows(after)
        reached = alive & valid
        states = jnp.where(valid[:, None], after.obs, current.obs)
        goes_on = reached & (after.done == 0)
        # An ended episode waits at its start: whatever became of its physics is never stepped.
        current = base.select_rows(goes_on, after, starts)
        return (current, goes_on), (states, reached, jnp.sum(alive & ~valid, dtype=jnp.int32))

    everyone = jnp.ones(starts.done.shape[0], bool)
    keys = jax.random.split(key, episode_length)
    _, (states, alive, invalid) = jax.lax.scan(step, (starts, everyone), keys)
    return Trajectories(states, alive, jnp.sum(invalid))
