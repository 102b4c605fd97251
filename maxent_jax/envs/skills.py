"""Skills: each episode is given a random unit vector, which its states carry to their end.

A policy that sees it is a policy for each vector. Source: Park et al. 2024, "METRA: scalable
unsupervised RL with metric-aware abstraction", arXiv 2310.08887.
"""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper

from maxent_jax.envs.physics import Work


class WithSkill(Wrapper):
    """An environment whose observations end with the episode's skill, [D + Z]."""

    def __init__(self, env: Env, size: int):
        """Wraps an environment with skills of Z = `size` entries."""
        super().__init__(env)
        self._size = size

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
        return state.replace(obs=state.obs[..., : -self._size]), state.obs[..., -self._size :]


def _with(state: State, skill: jax.Array) -> State:
    return state.replace(obs=jnp.concatenate([state.obs, skill], axis=-1))
