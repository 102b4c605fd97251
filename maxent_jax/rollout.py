"""Whole episodes of the mixture, one policy each."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.envs import base
from maxent_jax.envs.base import Env, State


class Trajectories(NamedTuple):
    """E episodes side by side. A step counts while `alive`: its state was reached before the end.

    A program that leaves a field unread does not keep it.
    """

    states: jax.Array  # [T, E, D] the state reached by each step
    actions: jax.Array  # [T, E, A] that led there, in [-1, 1]
    alive: jax.Array  # [T, E] bool
    terminated: jax.Array  # [T, E] bool: the state ended its episode, as the environment says
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
        action = act(current.obs, key_step)
        after = jax.vmap(env.step)(current, action)
        valid = base.finite_rows(after)
        reached = alive & valid
        states = jnp.where(valid[:, None], after.obs, current.obs)
        goes_on = reached & (after.done == 0)
        # An ended episode waits at its start: whatever became of its physics is never stepped.
        current = base.select_rows(goes_on, after, starts)
        num_invalid = jnp.sum(alive & ~valid, dtype=jnp.int32)
        found = Trajectories(states, action, reached, reached & ~goes_on, num_invalid)
        return (current, goes_on), found

    everyone = jnp.ones(starts.done.shape[0], bool)
    keys = jax.random.split(key, episode_length)
    _, found = jax.lax.scan(step, (starts, everyone), keys)
    return found._replace(num_invalid=jnp.sum(found.num_invalid))
