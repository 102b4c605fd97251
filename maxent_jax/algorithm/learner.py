"""The state that training within an iteration changes."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from maxent_jax.algorithm import experience
from maxent_jax.algorithm.experience import Reference
from maxent_jax.components import Components
from maxent_jax.config import Config
from maxent_jax.density import histogram, plane, reservoir
from maxent_jax.density.reservoir import Reservoir
from maxent_jax.envs import base
from maxent_jax.envs.base import Episodes
from maxent_jax.sac import agent as sac_agent
from maxent_jax.sac.agent import Agent
from maxent_jax.sac.replay import Replay

NUM_RESTARTS = 1024  # at most, see base.Restarts


class Visits(NamedTuple):
    """Counts of every state visited so far."""

    cells: jax.Array  # [bins, bins] int32
    off_grid: jax.Array  # [] int32


class Learner(NamedTuple):
    """All that training within an iteration changes."""

    agent: Agent
    replay: Replay
    place: jax.Array  # [N] int32, where the replay finds each env's state: see experience.Step
    episodes: Episodes  # [N] of the agent, then [N] of the random baseline if there is one
    memory: jax.Array | None  # [N, T, F] states of each episode so far, for an episodic term
    bonus: Any  # the bonus's state; None without one
    reference: Reference
    history: Reservoir
    visits: Visits
    random_visits: Visits
    env_steps: jax.Array  # [] int32, of the agent
    gradient_steps: jax.Array  # [] int32
    first_steps: jax.Array | None = None  # [] int32, env steps before training, see finetune
    plane: jax.Array | None = None  # visited unit cells; None where positions are not metres


def init_learner(components: Components, key: jax.Array) -> Learner:
    """Returns a new learner with new episodes, an empty replay and an empty reference."""
    config, sac = components.config, components.sac
    zero = jnp.zeros((), jnp.int32)
    key_agent, key_episodes, key_bonus = jax.random.split(key, 3)
    num_rows = config.budget.num_envs * (2 if config.evaluation.random_baseline else 1)
    dims = len(components.phi.names)
    episodes = base.init(components.env, num_rows, config.environment.num_starts, key_episodes)
    if config.downstream.restart_share:  # until finetune puts others in their place
        restarts = jax.tree.map(lambda x: x[:NUM_RESTARTS], episodes.starts)
        no_age = jnp.zeros(restarts.done.shape, jnp.int32)
        none_restarts = base.Restarts(of_agent(config, episodes, 0.0), no_age)
        episodes = base.with_restarts(episodes, restarts, none_restarts)
    if config.environment.cell_restarts:
        share = of_agent(config, episodes, config.environment.cell_restarts)
        episodes = base.with_cells(episodes, components.grid.num_cells, share)
    episodic = components.bonus and components.bonus.episodic
    remembered = episodic.size if episodic else dims
    memory = None
    if config.intrinsic.episodic_weight > 0 or episodic:
        memory = jnp.zeros((config.budget.num_envs, config.environment.episode_length, remembered))
    unvisited = Visits(jnp.zeros(components.grid.bins, jnp.int32), zero)
    return Learner(
        agent=sac_agent.init(sac, key_agent),
        replay=experience.init(components),
        place=-1 - episodes.start[: config.budget.num_envs],
        episodes=episodes,
        memory=memory,
        bonus=components.bonus.init(key_bonus) if components.bonus else None,
        reference=Reference(jnp.zeros((config.mixture.reference_size, dims)), zero),
        history=reservoir.init(config.mixture.reference_size, dims),
        visits=unvisited,
        random_visits=unvisited,
        env_steps=zero,
        gradient_steps=zero,
        first_steps=None if components.task is None else zero,
        plane=plane.empty() if components.in_metres else None,
    )


def of_agent(config: Config, episodes: Episodes, share: float) -> jax.Array:
    """Returns the share for the agent's episodes and 0 for the random baseline's, [N] or [2N]."""
    num_rows = episodes.age.shape[0]
    return share * (jnp.arange(num_rows) < config.budget.num_envs).astype(jnp.float32)


def visit(components: Components, visits: Visits, states: jax.Array, counts: jax.Array) -> Visits:
    """Adds states to the counts.

    Args:
      states: [B, D] states.
      counts: [B] bool, the states that count.
    Returns:
      The new counts.
    """
    number = counts.astype(jnp.int32)
    cells = histogram.count(states, components.grid, number)
    return Visits(visits.cells + cells, visits.off_grid + jnp.sum(number) - jnp.sum(cells))


def visit_plane(
    components: Components, visited: jax.Array | None, states: jax.Array, counts: jax.Array
) -> jax.Array | None:
    """Adds states to the visited unit cells.

    Args:
      visited: [SIDE, SIDE] bool, see plane.empty; None where positions are not metres.
      states: [B, D] states.
      counts: [B] bool, the states that count.
    Returns:
      [SIDE, SIDE] bool, or None.
    """
    if visited is None:
        return None
    return plane.visit(visited, histogram.locate(states, components.grid), counts)
