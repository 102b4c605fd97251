"""Plays whole episodes of the mixture, each with one policy."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.envs import base
from maxent_jax.envs.base import Env, State


class Trajectories(NamedTuple):
    """E episodes in parallel. A step counts where `alive` is true.

    The compiler drops the fields that a program does not read.
    """

    states: jax.Array  # [T, E, D] the state that each step reached
    actions: jax.Array  # [T, E, A] in [-1, 1]
    alive: jax.Array  # [T, E] bool: the episode had not ended, and the state is finite
    terminated: jax.Array  # [T, E] bool: the environment ended the episode at this state
    num_invalid: jax.Array  # [] int32, steps to a physics state that is not finite
    env: State  # [T, E, ...] what the environment needs to go on from each state


def episodes(
    env: Env,
    starts: State,
    act: Callable[[jax.Array, jax.Array], jax.Array],
    episode_length: int,
    key: jax.Array,
) -> Trajectories:
    """Plays one episode from each start, to its end or the time limit.

    Args:
      env: the environment.
      starts: [E, ...].
      act: observation [E, D], key -> action [E, A].
      episode_length: T.
    """

    def step(carry, key_step):
        current, alive = carry
        action = act(current.obs, key_step)
        after = jax.vmap(env.step)(current, action)
        valid = base.finite_rows(after)
        reached = alive & valid
        states = jnp.where(valid[:, None], after.obs, current.obs)
        goes_on = reached & (after.done == 0)
        # An ended episode waits at its start, so that broken physics is never stepped again.
        current = base.select_rows(goes_on, after, starts)
        num_invalid = jnp.sum(alive & ~valid, dtype=jnp.int32)
        found = Trajectories(states, action, reached, reached & ~goes_on, num_invalid, after)
        return (current, goes_on), found

    everyone = jnp.ones(starts.done.shape[0], bool)
    keys = jax.random.split(key, episode_length)
    _, found = jax.lax.scan(step, (starts, everyone), keys)
    return found._replace(num_invalid=jnp.sum(found.num_invalid))
