"""Steps many episodes of any brax Env in parallel.

Adds what a single Env lacks: a time limit separate from termination, a random start for each
episode, the true last state of each episode, and a guard against physics that is not finite.
"""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper

from maxent_jax.envs import cells
from maxent_jax.envs.cells import Cells
from maxent_jax.envs.physics import Work
from maxent_jax.envs.task import MujocoEnv
from maxent_jax.types import Transition

Tree = TypeVar("Tree")
__all__ = [
    "Env",
    "Episodes",
    "Restarts",
    "State",
    "begin_again",
    "draw_rows",
    "draw_starts",
    "fill_cells",
    "finite_rows",
    "init",
    "only_starts",
    "rows_of",
    "select_rows",
    "step",
    "step_beside",
    "steps_taken",
    "with_cells",
    "with_restarts",
]


class Restarts(NamedTuple):
    """States within earlier episodes, at which some episodes begin instead of at a start."""

    share: jax.Array  # [N] of the episodes that begin at one
    age: jax.Array  # [Q] int32, of each: the pool's last Q rows


class Episodes(NamedTuple):
    """N episodes in progress, and the pool from which their starts are drawn."""

    env: State  # [N, ...]
    age: jax.Array  # [N] int32, control steps since the start of the episode
    start: jax.Array  # [N] int32, row of its start in the pool
    starts: State  # [R, ...] the pool, R far larger than N: a single start biases entropy
    restarts: Restarts | Cells | None = None  # with states in the pool's last rows


def init(env: Env, num_envs: int, num_starts: int, key: jax.Array) -> Episodes:
    """Begins N episodes, from a pool of `num_starts` random starts."""
    key_starts, key_draw = jax.random.split(key)
    starts = jax.vmap(env.reset)(jax.random.split(key_starts, num_starts))
    start = draw_rows(starts, num_envs, key_draw)
    return Episodes(
        env=rows_of(starts, start),
        age=jnp.zeros(num_envs, jnp.int32),
        start=start,
        starts=starts,
    )


def draw_rows(starts: State, num: int, key: jax.Array) -> jax.Array:
    """Draws `num` rows of a pool of starts, independently of each other, [num] int32."""
    return jax.random.randint(key, (num,), 0, starts.done.shape[0])


def rows_of(states: State, rows: jax.Array) -> State:
    """Returns the states in these rows, [R, ...] and [N] -> [N, ...]."""
    return jax.tree.map(lambda x: x[rows], states)


def draw_starts(starts: State, num: int, key: jax.Array) -> State:
    """Draws `num` starts from the pool, independently of each other, [num, ...]."""
    return rows_of(starts, draw_rows(starts, num, key))


def step(
    env: Env, episodes: Episodes, action: jax.Array, episode_length: int, key: jax.Array
) -> tuple[Episodes, Transition]:
    """Takes one control step in every episode. Episodes that end begin again from a new start.

    Args:
      env: the environment.
      episodes: N episodes.
      action: [N, A], in [-1, 1].
      episode_length: the time limit, in control steps.
      key: draws the new starts.
    Returns:
      The episodes after the step, and the transitions [N, ...].
    """
    after = jax.vmap(env.step)(episodes.env, action)
    return _goes_on(episodes, after, action, episode_length, key)


def step_beside(
    env: Env,
    episodes: Episodes,
    action: jax.Array,
    episode_length: int,
    key: jax.Array,
    work: Work,
    key_work: jax.Array,
) -> tuple[Episodes, Transition, Any]:
    """Takes the step of `step` while something else is computed, where the environment allows it.

    Args: as `step`, and
      work: what else to compute, see `envs.physics.Work`.
      key_work: the key that it is called with.
    Returns:
      The episodes after the step, the transitions [N, ...], and the result of `work`.
    """
    if _steps_beside(env):
        after, result = env.step_beside(episodes.env, action, work, key_work)
    else:
        after, (result, _) = jax.vmap(env.step)(episodes.env, action), work(key_work)
    return *_goes_on(episodes, after, action, episode_length, key), result


def _steps_beside(env: Env) -> bool:
    """Whether the environment's `step_beside` does what `step` does, in each of its layers.

    A brax Wrapper passes on what it lacks: one that changes `step` alone would be left out.
    """
    while isinstance(env, Wrapper) and _has_both(env):
        env = env.env
    return isinstance(env, MujocoEnv) and _has_both(env)


def _has_both(env: Env) -> bool:
    """Whether the class that defines `step` defines `step_beside` too, or a subclass of it does."""
    nearest = next(
        kind for kind in type(env).__mro__ if {"step", "step_beside"} & vars(kind).keys()
    )
    return "step_beside" in vars(nearest)


def _goes_on(
    episodes: Episodes, after: State, action: jax.Array, episode_length: int, key: jax.Array
) -> tuple[Episodes, Transition]:
    """The episodes after a step to `after` [N, ...], and the transitions [N, ...]."""
    before = episodes.env
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
        reward=jnp.where(valid, after.reward, 0.0),
    )
    ended = terminated | truncated
    start, first_age = _draw_beginnings(episodes, age.shape[0], key)
    return episodes._replace(
        env=select_rows(ended, rows_of(episodes.starts, start), after),
        age=jnp.where(ended, first_age, age),
        start=jnp.where(ended, start, episodes.start),
    ), transition


def _draw_beginnings(
    episodes: Episodes, num: int, key: jax.Array
) -> tuple[jax.Array, jax.Array | int]:
    """Draws rows of the pool at which episodes begin [num], and their ages."""
    if episodes.restarts is None:
        return draw_rows(episodes.starts, num, key), 0
    restarts = episodes.restarts
    key_which, key_start, key_restart = jax.random.split(key, 3)
    start = draw_rows(only_starts(episodes), num, key_start)
    again = jax.random.uniform(key_which, (num,)) < restarts.share
    if isinstance(restarts, Cells):
        restart, has_state = cells.draw(restarts, num, key_restart)
        again &= has_state
    else:
        restart = jax.random.randint(key_restart, (num,), 0, restarts.age.shape[0])
    start = jnp.where(again, _first_restart(episodes) + restart, start)
    return start, jnp.where(again, restarts.age[restart], 0)


def with_restarts(episodes: Episodes, states: State, restarts: Restarts | Cells) -> Episodes:
    """Adds states [Q, ...] to the pool, at which a share of the episodes begins from now on."""
    pool = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), only_starts(episodes), states)
    return episodes._replace(starts=pool, restarts=restarts)


def with_cells(episodes: Episodes, num_cells: int, share: jax.Array) -> Episodes:
    """Adds a row for each cell to the pool, without visits; `fill_cells` stores a state in it.

    Args:
      episodes: N episodes.
      num_cells: Q.
      share: [N] of the episodes that begin at a cell from now on.
    Returns:
      The episodes.
    """
    pool = only_starts(episodes)
    rows = jnp.arange(num_cells) % pool.done.shape[0]
    return with_restarts(episodes, rows_of(pool, rows), cells.init(num_cells, share))


def fill_cells(episodes: Episodes, cell: jax.Array) -> Episodes:
    """Visits the cells that the episodes are in, and stores the first state of each.

    A stored state is never replaced, because the replay refers to it. No terminal state is stored,
    and none at the time limit: no episode stays in one.

    Args:
      episodes: N episodes, with `Cells`.
      cell: [N] int32, the cell of each episode; Q for a state off the grid.
    Returns:
      The episodes with the cells after the visit.
    """
    assert isinstance(episodes.restarts, Cells)
    visited, new = cells.visit(episodes.restarts, cell, episodes.age)
    into = _first_restart(episodes) + new  # beyond the pool's end nothing is stored
    store = lambda pool, states: pool.at[into].set(states, mode="drop")
    pool = jax.tree.map(store, episodes.starts, episodes.env)
    return episodes._replace(starts=pool, restarts=visited)


def begin_again(episodes: Episodes, key: jax.Array) -> Episodes:
    """Begins every episode anew."""
    num = episodes.age.shape[0]
    start, age = _draw_beginnings(episodes, num, key)
    return episodes._replace(
        env=rows_of(episodes.starts, start), start=start, age=jnp.broadcast_to(age, (num,))
    )


def only_starts(episodes: Episodes) -> State:
    """Returns the pool without restarts, [R, ...]."""
    if episodes.restarts is None:
        return episodes.starts
    num = _first_restart(episodes)
    return jax.tree.map(lambda x: x[:num], episodes.starts)


def steps_taken(episodes: Episodes) -> jax.Array:
    """Returns the steps of each episode since it began, at a start or at a restart, [N] int32."""
    if episodes.restarts is None:
        return episodes.age
    restart = episodes.start - _first_restart(episodes)
    first_age = jnp.where(restart >= 0, episodes.restarts.age[jnp.maximum(restart, 0)], 0)
    return episodes.age - first_age


def _first_restart(episodes: Episodes) -> int:
    """The pool's first row that is not a start."""
    assert episodes.restarts is not None
    return episodes.starts.done.shape[0] - episodes.restarts.age.shape[0]


def select_rows(mask: jax.Array, on_true: Tree, on_false: Tree) -> Tree:
    """Selects each row from one of two trees of equal shapes, by `mask` [N]."""

    def select(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(select, on_true, on_false)


def finite_rows(state: State) -> jax.Array:
    """Returns whether all numbers of each row are finite, [N] bool."""
    rows = state.done.shape[0]
    floats = [x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.stack([jnp.isfinite(x).reshape(rows, -1).all(-1) for x in floats]).all(0)
