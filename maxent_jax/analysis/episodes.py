"""Occupancies as episodes of single policies."""

from typing import NamedTuple

import numpy as np

from maxent_jax.mixture.occupancy import Occupancy


class Paths(NamedTuple):
    """Episodes of single policies."""

    states: np.ndarray  # [E, T, D]
    alive: np.ndarray  # [E, T] bool: reached before the episode's end
    policy: np.ndarray  # [E] int, ascending; -1 if policies were drawn at each step


def paths(visited: Occupancy) -> Paths:
    """Returns the episodes of an occupancy."""
    num_episodes = visited.episode_policy.shape[0]
    states = np.asarray(visited.states).reshape(-1, num_episodes, visited.states.shape[-1])
    alive = np.asarray(visited.alive).reshape(-1, num_episodes)
    return Paths(np.moveaxis(states, 0, 1), alive.T, np.asarray(visited.episode_policy))
