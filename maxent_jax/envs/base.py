"""Many episodes side by side, over any brax Env.

Adds what a single Env leaves out: a time limit kept apart from termination, a fresh random start
for each episode, the true last state of each, and a guard against non-finite physics.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from maxent_jax.types import Transition

Tree = TypeVar("Tree")
__all__ = ["Env", "Episodes", "State", "draw_starts", "finite_rows", "init", "select_rows", "step"]


class Episodes(NamedTuple):
    """N episodes under way, and the starts from which the next ones are drawn."""

    env: State  # [N, ...]
    age: jax.Array  # [N] int32, control steps since the episode's start
    start: jax.Array  # [N] int32, the start from which each began
    starts: State  # [R, ...] random starts, R far larger than N: one cached start biases entropy


def init(env: Env, num_envs: int, num_starts: int, key: jax.Array) -> Episodes:
    """N fresh episodes and a pool of `num_starts` random starts."""
    key_starts, key_draw = jax.random.split(key)
    starts = jax.vmap(env.reset)(jax.random.split(key_starts, num_starts))
    start = _draw_rows(starts, num_envs, key_draw)
    return Episodes(
        env=_rows(starts, start),
        age=jnp.zeros(num_envs, jnp.int32),
        start=start,
        starts=starts,
    )


def draw_starts(starts: State, num: int, key: jax.Array) -> State:
    """[num, ...] of the pool's starts, each drawn on its own."""
    return _rows(starts, _draw_rows(starts, num, key))


def step(
    env: Env, episodes: Episodes, action: jax.Array, episode_length: int, key: jax.Array
) -> tuple[Episodes, Transition]:
    """One control step of every episode; those that end start anew.

    Args:
      action: [N, A], in [-1, 1].
      episode_length: the time limit, control steps.
    Returns:
      the episodes after it, and what happened, [N, ...].
    """
    before = episodes.env
    after = jax.vmap(env.step)(before, action)
    valid = finite_rows(after)
    age = episodes.age + 1
    terminated = ~valid | (after.done > 0)
    truncated = ~terminated & (age >= episode_length)
    transition = Transition(
        observation=before.obs,
        action=action,
        next_observation=select_rows(valid, after.obs, before.obs),
        terminated=terminated,
        truncated=truncated,
        valid=valid,
    )
    ended = terminated | truncated
    start = _draw_rows(episodes.starts, age.shape[0], key)
    return Episodes(
        env=select_rows(ended, _rows(episodes.starts, start), after),
        age=jnp.where(ended, 0, age),
        start=jnp.where(ended, start, episodes.start),
        starts=episodes.starts,
    ), transition


def select_rows(mask: jax.Array, on_true: Tree, on_false: Tree) -> Tree:
    """Row by row, from one of two trees of equal shapes; `mask` is [N]."""

    def select(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(select, on_true, on_false)


def finite_rows(state: State) -> jax.Array:
    """[N] bool: every number of the row is finite."""
    rows = state.done.shape[0]
    floats = [x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(x).reshape(rows, -1).all(-1) for x in floats]).all(0)


def _draw_rows(starts: State, num: int, key: jax.Array) -> jax.Array:
    return jax.random.randint(key, (num,), 0, starts.done.shape[0])


def _rows(states: State, rows: jax.Array) -> State:
    return jax.tree.map(lambda x: x[rows], states)
