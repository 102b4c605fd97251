"""Skills: each episode is given a random unit vector, which its states carry to their end.

A policy that sees it is a policy for each vector. Features, cells and tasks do not see it. Source:
Park et al. 2024, "METRA: scalable unsupervised RL with metric-aware abstraction", arXiv 2310.08887.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper

from maxent_jax.density.histogram import Grid
from maxent_jax.envs.physics import Work
from maxent_jax.precision import in_32_bits
from maxent_jax.types import Features


class WithSkill(Wrapper):
    """An environment whose observations end with the episode's skill, [D + Z]."""

    def __init__(self, env: Env, size: int):
        """Wraps an environment with skills of Z = `size` entries."""
        super().__init__(env)
        self._size = size

    @in_32_bits
    def reset(self, rng: jax.Array) -> State:
        """Draws a start, and a skill uniformly from the unit sphere."""
        key_start, key_skill = jax.random.split(rng)
        direction = jax.random.normal(key_skill, (self._size,))
        skill = direction / jnp.linalg.norm(direction)
        return _with(self.env.reset(key_start), skill)

    def step(self, state: State, action: jax.Array) -> State:
        """Takes one control step with an action [A] in [-1, 1]; the skill stays."""
        bare, skill = self._parts(state)
        return _with(self.env.step(bare, action), skill)

    def step_beside(
        self, state: State, action: jax.Array, work: Work, key: jax.Array
    ) -> tuple[State, Any]:
        """Steps N episodes as the environment's `step_beside` does, actions [N, A] in [-1, 1]."""
        bare, skill = self._parts(state)
        after, result = self.env.step_beside(bare, action, work, key)
        return _with(after, skill), result

    @property
    def observation_size(self) -> int:
        """D + Z."""
        return self.env.observation_size + self._size

    def _parts(self, state: State) -> tuple[State, jax.Array]:
        bare = state.replace(obs=without_skill(state.obs, self._size))
        return bare, state.obs[..., -self._size :]


def _with(state: State, skill: jax.Array) -> State:
    return state.replace(obs=jnp.concatenate([state.obs, skill], axis=-1))


def without_skill(states: jax.Array, size: int) -> jax.Array:
    """Returns states [..., D + Z] without the skill of Z = `size` entries that ends them."""
    return states[..., :-size]


@dataclasses.dataclass(frozen=True)
class BareFeatures:
    """A feature map that does not see the skill, [..., D + Z] -> [..., F]."""

    phi: Features
    size: int

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the features, [F]."""
        return self.phi.names

    def __call__(self, observation: jax.Array, /) -> jax.Array:
        """Returns the features [..., F] of states [..., D + Z]."""
        return self.phi(without_skill(observation, self.size))


def bare_grid(grid: Grid, size: int) -> Grid:
    """Returns the grid for states that end with a skill, which its cells do not see."""
    transform = grid.transform
    if transform is None:  # it reads the first entries
        return grid
    return grid._replace(transform=lambda states: transform(without_skill(states, size)))


def bare_reward(reward: Callable, size: int) -> Callable:
    """Returns the reward for transitions whose states end with a skill, which it does not see."""

    def paid(observation, action, next_observation):
        bare, next_bare = (without_skill(x, size) for x in (observation, next_observation))
        return reward(bare, action, next_bare)

    return paid
